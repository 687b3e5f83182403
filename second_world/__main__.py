"""`python -m second_world draw N SEED [MIX]` prints the runs; `… run` makes the logs of one, given as JSON on stdin."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

_PAUSE = 5.0  # s between motions, in which nothing cools down


def main(arguments: list[str]) -> int:
    """Returns the exit code: 0, or 2 with a message where MuJoCo is missing."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        print("MuJoCo is not installed: pip install 'calibration-agent[mujoco]'", file=sys.stderr)
        return 2
    if arguments[0] == "draw":
        from second_world.draw import draw_cases

        mix = json.loads(arguments[3]) if len(arguments) > 3 else None
        print(json.dumps(draw_cases(int(arguments[1]), int(arguments[2]), mix)))
    else:
        print(json.dumps(run(json.load(sys.stdin))))
    return 0


def run(job: dict[str, Any]) -> dict[str, Any]:
    """Logs of one run in `folder`, and how much its effects change the torque; with `describe` the robot as well.

    Its motions are drawn, or come as `set_points`: by name a file of (S, n) at the servo's rate, and when their
    `cycles` begin [s].
    """
    from second_world.arms import PLACEHOLDERS, draw_arm, write_description
    from second_world.draw import recorder
    from second_world.faults import build_in
    from second_world.motions import RATE, Motions, draw_motions
    from second_world.plant import largest_change, simulate
    from second_world.recorder import write_motion

    machine, effects, folder = job["machine"], job["effects"], Path(job["folder"])
    as_recorded = recorder(machine) == "as recorded"
    arm = draw_arm(machine)
    given = "set_points" in job
    motions: Motions
    if given:
        cycles = job.get("cycles", {})
        motions = {name: (np.load(path), tuple(cycles.get(name, ()))) for name, path in job["set_points"].items()}
    else:
        motions = draw_motions(job["motion"], arm.range, arm.speed, job["cycle"])
    if job.get("describe"):
        rng = np.random.default_rng([machine, 7])
        write_description(arm, Path(job["describe"]), float(rng.choice(PLACEHOLDERS)) if as_recorded else None)
    faults = build_in(arm, effects)
    out, reported = simulate(arm, faults, machine, motions)
    folder.mkdir(parents=True, exist_ok=True)
    began = 0.0
    for number, (name, (_, cycles)) in enumerate(motions.items()):
        seed = 10 * job["motion"] + number
        write_motion(folder / f"{name}.mcap", arm, out[name], reported[number], cycles, seed, as_recorded, began)
        began += len(reported[number]) / RATE + _PAUSE
    size = None
    if effects and not given:
        whole = draw_arm(machine)
        _, plain = simulate(whole, build_in(whole, ()), machine, motions)
        size = largest_change(reported, plain, arm.torque)
    return {"logs": [str(folder / f"{name}.mcap") for name in motions], "size": size}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
