"""The three motions of every run, as PDL2: fast and flying, with stops, and slow. Joint by joint, so any arm can."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.core import InputError
from agent.link import check_cell
from agent.motion import (
    JointTarget,
    MotionSettings,
    Move,
    MoveType,
    Termination,
    create_interpolator,
    with_frames,
    write_program,
)
from agent.recipe import Recipe
from agent.robot import RobotDescription

MOTIONS = ("excite", "moves", "slow")
CYCLES = 2

#: Part of the joint speeds, part of half the joint range that points are drawn in, and whether corners are flown.
_STYLE = {"excite": (1.0, 0.6, True), "moves": (0.6, 0.5, False), "slow": (0.06, 0.5, False)}
_MOST_DRAWS = 200
_WIDEST = 2.5  # rad


def draw_programs(recipe: Recipe, seed: int, cycle: float) -> dict[str, str]:
    """PDL2 text of each of MOTIONS, two cycles of about `cycle` [s] each; free of the arm's own links.

    Raises:
        InputError: no draw keeps the limits.
    """
    return {
        name: _draw_program(recipe, name, np.random.default_rng([seed, k]), cycle) for k, name in enumerate(MOTIONS)
    }


def _draw_program(recipe: Recipe, name: str, rng: np.random.Generator, cycle: float) -> str:
    reason = ""
    for _ in range(_MOST_DRAWS):
        try:
            moves = _draw_cycle(recipe, name, rng, cycle)
        except InputError as error:
            reason = str(error)
            continue
        calm = _settings(recipe, 0.3).changed(termination=Termination.FINE)
        approach = Move(MoveType.JOINT, moves[-1].target, calm)
        return write_program(name, [approach, *moves * CYCLES], recipe.robot)
    raise InputError(f"blind check: none of {_MOST_DRAWS} drawn motions {name!r} keeps all limits; the last: {reason}")


def _draw_cycle(recipe: Recipe, name: str, rng: np.random.Generator, cycle: float) -> list[Move]:
    """Moves from and back to the last one's target."""
    robot = recipe.robot
    speed, range_, flying = _STYLE[name]
    settings = _settings(recipe, speed)
    lower, upper = (np.clip(limit, -_WIDEST, _WIDEST) for limit in robot.position_limits)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    at = middle + rng.uniform(-0.3, 0.3, robot.dof) * half
    home, left = at, cycle
    targets: list[np.ndarray] = []
    reach = 3.0 * speed * robot.max_velocity  # of one move that takes about three seconds
    while True:
        target = middle + range_ * rng.uniform(-1, 1, robot.dof) * half
        target = at + np.clip(target - at, -reach, reach)
        left -= _seconds(robot, target - at, speed)
        if left < _seconds(robot, home - target, speed) and targets:
            break
        targets.append(target)
        at = target
    moves = [Move(MoveType.JOINT, JointTarget(target), settings, fly=flying) for target in targets]
    moves.append(Move(MoveType.JOINT, JointTarget(home), settings.changed(termination=Termination.FINE)))
    _check(recipe, moves, home)
    return moves


def _settings(recipe: Recipe, speed: float) -> MotionSettings:
    """With the tool, on whose path a corner between joint moves is flown: a controller has that of its last program."""
    return with_frames(MotionSettings(speed_override=speed), recipe.tool)


def _seconds(robot: RobotDescription, way: np.ndarray, speed: float) -> float:
    """About what a move joint by joint takes, ramps and settling included."""
    return float(np.max(np.abs(way) / (speed * robot.max_velocity))) + 0.6


def _check(recipe: Recipe, moves: Sequence[Move], start: np.ndarray) -> None:
    """Raises:
    InputError: a limit, or the arm's own links.
    """
    interpolator = create_interpolator(recipe.interpolator, recipe.robot, recipe.tool, period=1.0 / recipe.record.rate)
    check_cell(recipe, interpolator.plan(moves, start))
