"""Runs of the fake controller, recorded over the real link: motions, recording, and the size of an effect."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, InputError
from agent.link import check_cell, moving_segments, open_link
from agent.motion import JointTarget, Move, MoveType, Pdl2Settings, Termination, create_interpolator, with_frames
from agent.motion.pdl2 import write_program
from agent.recipe import Recipe, load_recipe
from agent.recording import Log
from agent.robot import RobotDescription
from fake_controller.build import build_controller
from fake_controller.servers import open_server

#: Motions of every run: part of the joint speeds, part of half the joint range, and whether corners are flown.
MOTIONS = {"excite": (1.0, 0.6, True), "moves": (0.6, 0.5, False), "slow": (0.06, 0.5, False)}
CYCLES = 2
REST = 3  # samples of equal set-points that make a stop

_MOST_DRAWS = 200
_WIDEST = 2.5  # rad
_MEAN = 25  # samples, against noise
_WATCHDOG = 5.0  # s; of an arm that is simulated as fast as the machine can go
#: The guard needs to know how far corners between joint moves may be cut. At full speed two interpolators differ there
#: by a tenth of a metre at times, in one draw by 0.2 m.
_RECIPE = """\
robot: {robot}
controller: {{driver: tcp, address: "127.0.0.1:9"}}
motion:
  speed: 1 m/s
  fly: {{distance: 300 mm}}
  via_points: {{count: 2, box: {{centre: [1, 0, 1], size: [1, 1, 1], orientation: [0, 0, 0], cone: 0}}}}
"""


def link_recipe(robot: str) -> Recipe:
    """What `agent record` would be told about such a controller."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.yaml"
        path.write_text(_RECIPE.format(robot=robot), encoding="utf-8")
        return load_recipe(path)


def draw_programs(recipe: Recipe, seed: int, cycle: float) -> dict[str, str]:
    """Draw the PDL2 text of each of MOTIONS: two cycles of about `cycle` [s], free of the arm's own links.

    The moves go joint by joint, so that any arm can make them.

    Raises:
        InputError: no draw keeps the limits.
    """
    return {
        name: _draw_program(recipe, name, np.random.default_rng([seed, k]), cycle) for k, name in enumerate(MOTIONS)
    }


def _draw_program(recipe: Recipe, name: str, rng: np.random.Generator, cycle: float) -> str:
    interpolator = create_interpolator(recipe.interpolator, recipe.robot, recipe.tool, period=1.0 / recipe.record.rate)
    reason = ""
    for _ in range(_MOST_DRAWS):
        moves, home = _draw_cycle(recipe, name, rng, cycle)
        try:
            check_cell(recipe, interpolator.plan(moves, home))
        except InputError as error:
            reason = str(error)
            continue
        # The tool shapes corners between joint moves; a controller has that of its last program.
        calm = with_frames(Pdl2Settings(speed_override=0.3), recipe.tool).changed(termination=Termination.FINE)
        approach = Move(MoveType.JOINT, moves[-1].target, calm)
        return write_program(name, [approach, *moves * CYCLES], recipe.robot)
    raise InputError(f"blind check: none of {_MOST_DRAWS} drawn motions {name!r} keeps all limits; the last: {reason}")


def _draw_cycle(recipe: Recipe, name: str, rng: np.random.Generator, cycle: float) -> tuple[list[Move], np.ndarray]:
    """Moves from a position and back to it, and that position (n,)."""
    robot = recipe.robot
    speed, share, flying = MOTIONS[name]
    settings = with_frames(Pdl2Settings(speed_override=speed), recipe.tool)
    lower, upper = (np.clip(limit, -_WIDEST, _WIDEST) for limit in robot.position_limits)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    home = at = middle + rng.uniform(-0.3, 0.3, robot.dof) * half
    remaining = cycle
    targets: list[np.ndarray] = []
    reach = 3.0 * speed * robot.max_velocity  # of one move that takes about three seconds

    def seconds(distance: np.ndarray) -> float:
        """About what a move takes, ramps and settling included."""
        return float(np.max(np.abs(distance) / (speed * robot.max_velocity))) + 0.6

    while True:
        target = middle + share * rng.uniform(-1, 1, robot.dof) * half
        target = at + np.clip(target - at, -reach, reach)
        remaining -= seconds(target - at)
        if remaining < seconds(home - target) and targets:
            break
        targets.append(target)
        at = target
    moves = [Move(MoveType.JOINT, JointTarget(target), settings, fly=flying) for target in targets]
    closing = Move(MoveType.JOINT, JointTarget(home), settings.changed(termination=Termination.FINE))
    return [*moves, closing], home


def record_motions(
    robot: str,
    machine: int,
    effects: Sequence[Mapping[str, Any]],
    programs: Mapping[str, str],
    folder: Path,
    recipe: Recipe | None = None,
) -> list[Path]:
    """Start a controller, run the programs one after the other, and record a log of each; returns their paths.

    `recipe`: of another sub-region than `link_recipe` has.

    Raises:
        ControllerError, SafetyError, DriverError: the arm did not do it.
        InputError: a program that cannot be planned, or an effect that cannot be simulated.
    """
    folder.mkdir(parents=True, exist_ok=True)
    recipe, logs = recipe or link_recipe(robot), []
    controller = build_controller(robot, machine, "fast", effects)
    with closing(open_server("tcp", controller, watchdog=_WATCHDOG)) as server:
        at_server = replace(recipe, controller=recipe.controller.model_copy(update={"address": server.address}))
        with open_link(at_server, Console(verbosity=-1), True, folder) as link:
            for name, text in programs.items():
                log = folder / f"{name}.mcap"
                log.unlink(missing_ok=True)  # of a check that was stopped in the middle of it
                link.run(link.plan(text, f"{name}.pdl"), log, name)
                logs.append(log)
    return logs


def torque_change(robot: RobotDescription, logs: Sequence[Log], others: Sequence[Log]) -> float:
    """Largest root mean square change of torque over nominal (over N·m without one), by motion and joint.

    Both are aligned from stop to stop; noise of the sensors leaves a few tenths of a percent at most.
    """
    unit = np.nan_to_num(robot.nominal_torque, nan=1.0)
    largest = 0.0
    for log, other in zip(logs, others, strict=True):
        assert log.effort is not None
        assert other.effort is not None
        squares, count = np.zeros(robot.dof), 0
        for (a, b), (c, d) in zip(between_stops(log), between_stops(other), strict=False):
            length = min(b - a, d - c)
            if length < 2 * _MEAN:
                continue
            change = np.cumsum((log.effort[a : a + length] - other.effort[c : c + length]) / unit, axis=0)
            smooth = (change[_MEAN:] - change[:-_MEAN]) / _MEAN
            squares += np.sum(smooth**2, axis=0)
            count += len(smooth)
        if count:
            largest = max(largest, float(np.sqrt(np.max(squares / count))))
    return largest


def between_stops(log: Log) -> Sequence[tuple[int, int]]:
    """First and past-last sample of each stretch from one stop of the set-points to the next."""
    assert log.reference_position is not None
    return moving_segments(log.reference_position, REST)
