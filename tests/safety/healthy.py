"""Healthy motions on one wire at the real-time clock: `python tests/safety/healthy.py WIRE FIRST LAST`.

For each seed an emulator of its own starts as a process, and `agent record` runs a program of a few seconds on it that
is drawn from the seed: a loop of via-points, or joint moves with stops and rests. Every fourth emulator has the second
interpolator where its wire knows one, and runs loops alone (docs/security.md: stopped without need). One JSON line a
motion tells how it ended.
"""

import contextlib
import io
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agent.cli import main as agent
from agent.core.errors import InputError
from agent.excitation import Candidates
from agent.motion.program import Delay, JointTarget, Move, MoveType, Statement, with_frames
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe, load_recipe
from tests.conftest import Broker, Emulator, free_loopback

RECIPE = """
robot: {robot}
controller: {{driver: {driver}, address: "{address}"}}
motion:
  speed: {speed} m/s
  fly: {fly}
  via_points:
    count: 3
    box:
      {{centre: {centre}, size: {size}, orientation: [0 deg, 180 deg, 0 deg], cone: 20 deg}}
record: {{rate: 500 Hz, cycles: 1}}
"""


@dataclass(frozen=True)
class Arm:
    """A robot, where it works, and the range of its speeds [m/s] and of its blends [m]."""

    robot: str
    fly: str
    centre: str
    size: str
    start: tuple[float, ...]
    speeds: tuple[float, float]
    blends: tuple[float, ...]


COMAU = Arm(
    "comau_ns16",
    "{{type: FLY_CART, trajectory: FLY_TOL, distance: {} m}}",
    "[1.0 m, 0 m, 0.8 m]",
    "[0.3 m, 0.3 m, 0.3 m]",
    (0.0, 0.0, -90.0, 0.0, 60.0, 0.0),
    (0.2, 1.2),
    (0.005, 0.02, 0.05),
)
UR = Arm(
    "ur5e",
    "{{distance: {} m}}",
    "[0.45 m, 0 m, 0.35 m]",
    "[0.4 m, 0.8 m, 0.4 m]",
    (0.0, -90.0, -90.0, -90.0, 90.0, 0.0),
    (0.1, 0.2),
    (0.03, 0.05),
)


def has_second_interpolator(wire: str, seed: int) -> bool:
    """Whether the emulator of a seed plans by a law of another family."""
    return seed % 4 == 3 and wire != "ur"


def drawn_recipe(wire: str, seed: int, address: str) -> str:
    """The recipe of a seed."""
    rng, arm = np.random.default_rng(seed), UR if wire == "ur" else COMAU
    fly = arm.fly.format(float(rng.choice(arm.blends)))
    speed = round(float(rng.uniform(*arm.speeds)), 3)
    return RECIPE.format(
        robot=arm.robot, driver=wire, address=address, speed=speed, fly=fly, centre=arm.centre, size=arm.size
    )


def drawn(wire: str, seed: int, recipe: Recipe) -> tuple[str, list[Statement]]:
    """What kind of program of this recipe a seed gives, and its statements."""
    rng = np.random.default_rng([seed, 1])
    settings = with_frames(recipe.motion.settings_at(recipe.motion.speed), recipe.tool)
    start = np.radians((UR if wire == "ur" else COMAU).start)
    if rng.uniform() < 0.3 and not has_second_interpolator(wire, seed):
        moves: list[Statement] = []
        for _ in range(int(rng.integers(2, 5))):
            target = JointTarget(start + np.radians(rng.uniform(-12, 12, 6)))
            slower = settings.changed(speed_override=round(float(rng.uniform(0.3, 1.0)), 2))
            moves.append(Move(MoveType.JOINT, target, slower, fly=bool(rng.uniform() < 0.5) and wire != "ur"))
        return "joints", [*moves, Delay(0.2), Move(MoveType.JOINT, JointTarget(start), settings)]
    candidates = Candidates(replace(loop_problem(recipe, recipe.motion.speed), settings=settings))
    while True:
        try:
            loop = candidates.loop(rng.uniform(size=candidates.problem.genes))
        except InputError:
            continue
        return "loop", [Move(MoveType.JOINT, JointTarget(loop.start), settings), *loop.moves]


def run(wire: str, seed: int, folder: Path, broker: Broker | None) -> dict[str, object]:
    """One motion: how `agent record` ended, and what it said last."""
    interpolator = "second" if has_second_interpolator(wire, seed) else "ours"
    options = ["--clock", "real", "--watchdog", "0.05", "--seed", str(seed), "--driver", wire]
    if broker is not None:
        options += ["--broker", ":".join(map(str, broker.address))]
    if wire == "ur":
        options += ["--robot", UR.robot, "--address", free_loopback()]
    emulator = Emulator(*options, "--interpolator", interpolator)
    try:
        path = folder / f"{seed}.yaml"
        path.write_text(drawn_recipe(wire, seed, emulator.address), encoding="utf-8")
        recipe = load_recipe(path)
        kind, statements = drawn(wire, seed, recipe)
        program = folder / f"{seed}{recipe.dialect.suffix}"
        program.write_text(recipe.dialect.write("healthy", statements, recipe.robot), encoding="utf-8")
        log = folder / f"{seed}.mcap"
        said, code = io.StringIO(), 0
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            sys.argv = ["agent", "record", str(path), "--program", str(program), "-o", str(log), "--yes"]
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
