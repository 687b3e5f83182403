"""The second world as a process.

`python -m second_world draw --cases N --seed S --laws development --out DIR --truth FILE` makes whole runs, the truth
apart. For `agent blind-check`, `… draw N SEED [MIX]` prints cases and `… run` makes the logs of one, given as JSON on
stdin.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
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
    if arguments[:1] == ["run"]:
        print(json.dumps(run(json.load(sys.stdin))))
    elif arguments[:1] == ["draw"] and arguments[1:2] and arguments[1].isdigit():
        from second_world.draw import draw_cases

        mix = json.loads(arguments[3]) if len(arguments) > 3 else None
        print(json.dumps(draw_cases(int(arguments[1]), int(arguments[2]), mix)))
    else:
        return _draw(arguments)
    return 0


def _draw(arguments: list[str]) -> int:
    from second_world.world import LAWS

    parser = argparse.ArgumentParser("python -m second_world", description="Runs on drawn machines, the truth apart.")
    parser.add_argument("command", choices=["draw"])
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--seed", type=int, help="a secret one of 128 bits if absent")
    parser.add_argument("--laws", choices=LAWS, default="development")
    parser.add_argument("--cycle", type=float, default=10.0, help="one way round of every motion [s]")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--truth", type=Path, required=True, help="JSON Lines file, outside of the folder")
    given = parser.parse_args(arguments)
    if given.truth.resolve().is_relative_to(given.out.resolve()):
        parser.error(f"--truth {given.truth}: it lies in {given.out}, where a diagnosis would see it")
    write_draw(given.cases, given.seed, given.laws, given.out, given.truth, given.cycle)
    return 0


def write_draw(count: int, seed: int | None, laws: str, out: Path, truth: Path, cycle: float) -> None:
    """Write `out`/runs/<id>/ with the description, baseline/*.mcap and logs/*.mcap, and a line of `truth` for each."""
    from second_world.draw import draw_runs
    from second_world.world import LAWS, draw_world

    seed = secrets.randbits(128) if seed is None else seed
    rng = np.random.default_rng(np.random.SeedSequence([LAWS.index(laws), seed, 3]))
    serials: dict[int, str] = {}
    truth.parent.mkdir(parents=True, exist_ok=True)
    with truth.open("w", encoding="utf-8") as lines:
        for number, drawn in enumerate(draw_runs(count, seed, laws)):
            name = f"{int(rng.integers(2**32)):08x}"
            folder, world = out / "runs" / name, draw_world(drawn.machine)
            serial = serials.setdefault(drawn.machine, f"{int(rng.integers(2**48)):012X}")
            job = {"machine": drawn.machine, "cycle": cycle, "serial": serial}
            run({**job, "motion": drawn.machine, "effects": [], "folder": folder / "baseline", "describe": folder})
            found = run({**job, "motion": drawn.motion, "effects": drawn.effects, "folder": folder / "logs"})
            for path in folder.rglob("*"):
                os.utime(path, (_STAMP, _STAMP))
            line = {"run": name, "kind": drawn.kind, "effects": found["effects"], "size": found["size"]}
            line["machine"], line["motion"] = drawn.machine, drawn.motion
            line["world"] = {
                "arm": world.arm.kind.name,
                "friction": world.friction,
                "servo": world.servo,
                "velocity": world.velocity,
                "rate": world.rate,
                "motions": world.motions,
                "recorder": list(world.faults),
                "set_points": world.tracking,
            }
            lines.write(json.dumps(line) + "\n")
            lines.flush()
            print(f"{number + 1} of {count}", end="\r", file=sys.stderr)


def run(job: dict[str, Any]) -> dict[str, Any]:
    """Logs of one run in `folder`, its effects with their sizes, and how much they change the torque together.

    With `describe` the robot is written as well, and the motions are those of a baseline. Motions are drawn, or come
    as `set_points`: by name a file of (S, n) at 1 kHz, and when their `cycles` begin [s]. Effects are sized along the
    drawn ones in any case.
    """
    from second_world.arms import write_description
    from second_world.machine import largest_change
    from second_world.motions import BASELINE, RATE, Motions, draw_motions
    from second_world.recorder import Take, write_take
    from second_world.sizing import build, sized
    from second_world.world import draw_world

    world, day, folder = draw_world(job["machine"]), job["motion"], Path(job["folder"])
    if job.get("describe"):
        write_description(world.arm, Path(job["describe"]))
    kinds = world.motions | (BASELINE if job.get("describe") else {})
    motions: Motions = draw_motions(kinds, day, world.arm.range, world.arm.speed, job.get("cycle", 10.0))
    effects = [sized(world, effect, day, motions) for effect in job["effects"]]
    given = "set_points" in job
    if given:
        cycles = job.get("cycles", {})
        motions = {name: (np.load(path), tuple(cycles.get(name, ()))) for name, path in job["set_points"].items()}
    machine = build(world, effects, day)
    reported = machine.run(motions)
    folder.mkdir(parents=True, exist_ok=True)
    began = _STAMP + np.random.default_rng(np.random.SeedSequence([day, 4])).uniform(0, 1e6)
    for number, (name, (planned, cycle_starts)) in enumerate(motions.items()):
        executed = machine.executed(planned)
        take = Take(name, reported[name], executed, planned, cycle_starts, began, job.get("serial", ""))
        write_take(folder / f"{name}.mcap", world, take, 10 * day + number)
        began += reported[name].shape[1] / RATE + _PAUSE
    size = None
    if effects and not given:
        paths = [effect for effect in effects if effect["effect"] == "interpolator_mismatch"]
        size = largest_change(reported, build(world, paths, day).run(motions), world.arm.torque)[0]
    return {"logs": [str(folder / f"{name}.mcap") for name in motions], "size": size, "effects": effects}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
