"""The second world as a process: `python -m second_world draw` prints runs, `… run` makes logs.

`draw` takes an object on stdin, as JSON: `count`, `seed` and `laws` ("development" or "judgement"). `run` takes a list.
No secret stands in the arguments, which everybody on a machine can read.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

_PAUSE = 5.0  # s between motions, in which nothing cools down
_STAMP = 1.7e9  # s


def main(arguments: list[str]) -> int:
    """Returns the exit code: 0, or 2 with a message where something is missing or wrong."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        print("MuJoCo is not installed: pip install 'calibration-agent[mujoco]'", file=sys.stderr)
        return 2
    if arguments not in (["draw"], ["run"]):
        print("python -m second_world: draw or run, with JSON on stdin", file=sys.stderr)
        return 2
    question = json.load(sys.stdin)
    if arguments == ["draw"]:
        from second_world.draw import draw_cases

        print(json.dumps(draw_cases(**question)))
    else:
        print(json.dumps([run(job) for job in question]))
    return 0


def run(job: dict[str, Any]) -> dict[str, Any]:
    """Logs of one run in `folder`, its effects with their sizes, and how much they change the torque together.

    The last is `size`, None without effects. A path that is not the planned one changes no torque at a set-point and
    has none. With `describe` the robot is written as well, and the motions are those of a baseline.
    """
    from second_world.arms import write_description
    from second_world.machine import largest_change
    from second_world.motions import BASELINE, RATE, draw_motions
    from second_world.recorder import Take, write_take
    from second_world.sizing import build, sized
    from second_world.world import draw_world

    world, day, folder = draw_world(job["machine"]), job["motion"], Path(job["folder"])
    if job.get("describe"):
        write_description(world.arm, Path(job["describe"]))
    kinds = world.motions | (BASELINE if job.get("describe") else {})
    motions = draw_motions(kinds, day, world.arm.range, world.arm.speed, job.get("cycle", 10.0))
    effects = [sized(world, effect, day, motions) for effect in job["effects"]]
    machine = build(world, effects, day)
    reported = machine.run(motions)
    folder.mkdir(parents=True, exist_ok=True)
    began = _STAMP + np.random.default_rng(np.random.SeedSequence([day, 4])).uniform(0, 1e6)
    for number, (name, (planned, cycle_starts)) in enumerate(motions.items()):
        take = Take(name, reported[name], machine.executed(planned), planned, cycle_starts, began)
        write_take(folder / f"{name}.mcap", world, take, 10 * day + number)
        began += reported[name].shape[1] / RATE + _PAUSE
    paths = [effect for effect in effects if effect["effect"] == "interpolator_mismatch"]
    size = None
    if len(paths) < len(effects):
        size = largest_change(reported, build(world, paths, day).run(motions), world.arm.torque)
    return {"logs": [str(folder / f"{name}.mcap") for name in motions], "size": size, "effects": effects}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
