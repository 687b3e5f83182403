"""Healthy motions on one wire at the real-time clock: `python tests/safety/healthy.py WIRE FIRST LAST`.

For each seed an emulator of its own starts as a process, and `agent record` runs a program of a few seconds on it that
is drawn from the seed: a loop of via-points, or joint moves with stops and rests. Every fourth emulator has the second
interpolator, and runs loops alone (docs/security.md: stopped without need). One JSON line a motion tells how it ended.
"""

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from agent.cli import main as agent
from agent.core.errors import InputError
from agent.excitation import Candidates, LoopProblem
from agent.motion import FlyTrajectory, FlyType, Pdl2Settings, ViaRegions
from agent.motion.pdl2 import write_program
from agent.motion.program import NO_FRAME, Delay, JointTarget, Move, MoveType, Statement
from agent.robot import load_robot
from tests.conftest import Broker, Emulator

ROBOT = load_robot("comau_ns16")
START = np.radians([0.0, 0.0, -90.0, 0.0, 60.0, 0.0])
RECIPE = """
robot: comau_ns16
controller: {{driver: {driver}, address: "{address}"}}
motion:
  speed: {speed} m/s
  fly: {{type: FLY_CART, trajectory: FLY_TOL, distance: {distance} m}}
  via_points:
    count: 3
    box:
      {{centre: [1.0 m, 0 m, 0.8 m], size: [0.3 m, 0.3 m, 0.3 m], orientation: [0 deg, 180 deg, 0 deg], cone: 20 deg}}
record: {{rate: 500 Hz, cycles: 1}}
"""


def has_second_interpolator(seed: int) -> bool:
    """Whether the emulator of a seed plans by a law of another family."""
    return seed % 4 == 3


def drawn(seed: int) -> tuple[str, list[Statement], Pdl2Settings]:
    """What kind of program, its statements, and the settings of its recipe."""
    rng = np.random.default_rng(seed)
    settings = Pdl2Settings(
        fly_type=FlyType.FLY_CART,
        fly_trajectory=FlyTrajectory.FLY_TOL,
        fly_distance=float(rng.choice([0.005, 0.02, 0.05])),
        linear_speed=round(float(rng.uniform(0.2, 1.2)), 3),
        base=NO_FRAME,
        tool=NO_FRAME,
        uframe=NO_FRAME,
    )
    if rng.uniform() < 0.3 and not has_second_interpolator(seed):
        moves: list[Statement] = []
        for _ in range(int(rng.integers(2, 5))):
            target = JointTarget(START + np.radians(rng.uniform(-12, 12, 6)))
            slower = settings.changed(speed_override=round(float(rng.uniform(0.3, 1.0)), 2))
            moves.append(Move(MoveType.JOINT, target, slower, fly=bool(rng.uniform() < 0.5)))
        return "joints", [*moves, Delay(0.2), Move(MoveType.JOINT, JointTarget(START), settings)], settings
    regions = ViaRegions.from_box(
        3, np.array([1.0, 0.0, 0.8]), np.full(3, 0.3), np.radians([0, 180, 0]), np.radians(20)
    )
    candidates = Candidates(LoopProblem(ROBOT, regions, settings))
    while True:
        try:
            loop = candidates.loop(rng.uniform(size=candidates.problem.genes))
        except InputError:
            continue
        return "loop", [Move(MoveType.JOINT, JointTarget(loop.start), settings), *loop.moves], settings


def run(wire: str, seed: int, folder: Path, broker: Broker | None) -> dict[str, object]:
    """One motion: how `agent record` ended, and what it said last."""
    kind, statements, settings = drawn(seed)
    interpolator = "second" if has_second_interpolator(seed) else "ours"
    options = ["--clock", "real", "--watchdog", "0.05", "--seed", str(seed), "--driver", wire]
    if broker is not None:
        options += ["--broker", ":".join(map(str, broker.address))]
    emulator = Emulator(*options, "--interpolator", interpolator)
    try:
        recipe, program = folder / f"{seed}.yaml", folder / f"{seed}.pdl"
        speed, distance = settings.linear_speed, settings.fly_distance
        text = RECIPE.format(driver=wire, address=emulator.address, speed=speed, distance=distance)
        recipe.write_text(text, encoding="utf-8")
        program.write_text(write_program("healthy", statements, ROBOT), encoding="utf-8")
        log = folder / f"{seed}.mcap"
        said, code = io.StringIO(), 0
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            sys.argv = ["agent", "record", str(recipe), "--program", str(program), "-o", str(log), "--yes"]
            try:
                agent()
            except SystemExit as end:
                code = int(end.code or 0)
    finally:
        emulator.end()
    return {
        "wire": wire,
        "seed": seed,
        "kind": kind,
        "interpolator": interpolator,
        "code": code,
        "said": "" if code == 0 else said.getvalue().strip().splitlines()[-1],
    }


def main(wire: str, first: int, last: int) -> None:
    """The seeds `first` to `last`, one after the other."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        broker = stack.enter_context(contextlib.closing(Broker())) if wire == "cnr_comau" else None
        for seed in range(first, last + 1):
            print(json.dumps(run(wire, seed, Path(folder), broker)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
