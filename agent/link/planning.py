"""Planning of programs: from a text to set-points that were checked. What a robot runs comes from `plan_program`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, InputError
from agent.recipe import Recipe
from agent.safety import PlannedProgram, pauses

if TYPE_CHECKING:
    from agent.motion import Interpolator, Move, Statement, Trajectory
    from agent.robot import CellReport, Tool, TorqueLimits

#: Share of the joint speeds at which the arm goes to the first point, and from one piece of motion to the next.
APPROACH_SPEED = 0.1
#: Rad or m by which an arm that comes round again may start elsewhere on the same way: joints written in a program, and
#: those that inverse kinematics gives for a pose, differ in their last digits.
_SAME = 1e-6


def plan_program(
    recipe: Recipe,
    text: str,
    path: str,
    start: np.ndarray,
    limits: TorqueLimits | None = None,
    stands_for: str = "",
) -> PlannedProgram:
    """Plan a program of the recipe's dialect for an arm that stands at `start` (n,), and check all that it moves.

    The set-points are those of the text, whatever it was written from. Each different one of the trajectories, the way
    from `start` included, is checked once against the cell, and against torque `limits` where a mass is at the flange.

    Args:
        path: of the text, for messages.
        stands_for: checksum of the program that this one is the slow version of.

    Raises:
        InputError: the text is not the motion subset of its dialect, or it breaks a limit.
    """
    from agent.motion import left_open

    program = recipe.dialect.read(text, path, recipe.robot)
    statements = tuple(program.run())
    chains: list[Trajectory] = []
    ways: list[list[Move]] = []
    for moves, chain in trajectories(recipe, statements, start):
        if all(chain is not planned for planned in chains):
            if (violation := _in_cell(recipe, chain).collision) is not None:
                line = moves[int(chain.move[violation.index])].line
                violation = replace(
                    violation, time=(violation.time or 0.0) + sum(planned.duration for planned in chains)
                )
                raise InputError(
                    f"{path}:{line}: {violation}: change this move, or move the arm to another start position"
                )
            check_load(limits, chain)
        chains.append(chain)
        ways.append(moves)
    approaches = sum(moves is ways[0] for moves in ways)
    frames = left_open(statements, recipe.tool, recipe.dialect.frame_names)
    return PlannedProgram(
        program.name, text, tuple(chains), stands_for, (), pauses(statements), frames, statements, approaches
    )


def trajectories(
    recipe: Recipe, statements: Iterable[Statement], start: np.ndarray
) -> Iterator[tuple[list[Move], Trajectory]]:
    """Moves and set-points of a program from stop to stop, for an arm that stands at `start` (n,): unchecked.

    Where it makes the same way again, the trajectory is the same object. What moves nothing is left out. A move that
    takes several goals comes as often, with a part of its way each time.

    Args:
        recipe: whose interpolator, robot and tool plan.
        statements: of the program.
        start: joint positions (n,) [rad or m] before the first.

    Raises:
        MotionError: a limit of the arm is broken.
    """
    from agent.motion import parted, stop_to_stop, way_key

    interpolator = interpolator_of(recipe)
    known: dict[tuple[object, ...], list[Trajectory]] = {}
    for moves in stop_to_stop(statements):
        for part in parted(moves, start):
            alike = known.setdefault(way_key(part), [])
            chain = next((other for other in alike if np.allclose(other.q[0], start, rtol=0, atol=_SAME)), None)
            if chain is None:
                chain = interpolator.plan(part, start)
                alike.append(chain)
            if np.ptp(chain.q, axis=0).any():
                yield moves, chain
                start = chain.q[-1]


@lru_cache(maxsize=4)
def interpolator_of(recipe: Recipe) -> Interpolator:
    """The recipe's interpolation law at its controller's period."""
    from agent.motion import create_interpolator

    return create_interpolator(recipe.interpolator, recipe.robot, recipe.tool, period=1.0 / recipe.record.rate)


def check_cell(recipe: Recipe, trajectory: Trajectory) -> None:
    """The arm keeps clear of itself and of the keep-out boxes along a planned loop, and could stop on its way.

    Raises:
        InputError: names where, what touches what, and how deep.
    """
    if (collision := _in_cell(recipe, trajectory).collision) is not None:
        raise InputError(f"{collision}: move or shrink motion.via_points")


def _in_cell(recipe: Recipe, trajectory: Trajectory) -> CellReport:
    return _cell(recipe).check_with_stopping(trajectory, margin=recipe.motion.settings.fly_distance)


def torque_limits(recipe: Recipe, load: Tool, console: Console) -> TorqueLimits:
    """Torque limits of the drives with a known mass at the flange; reports drives without known limits.

    Args:
        recipe: whose robot and tool carry the load.
        load: mass at the flange.
        console: where drives without known limits are named.
    """
    from agent.robot import TorqueLimits

    if unknown := [joint.name for joint in recipe.robot.joints if joint.max_torque is None]:
        console.warn(
            f"robot {recipe.robot.name} has no max_torque for {', '.join(unknown)}: nothing checks there whether it "
            "can bear the mass"
        )
    if recipe.robot.rated_payload is None:
        console.warn(
            f"robot {recipe.robot.name} has no rated_payload: nothing checks whether it may carry {load.mass:g} kg"
        )
    return TorqueLimits(recipe.robot, recipe.tool, load)


def check_load(limits: TorqueLimits | None, trajectory: Trajectory) -> None:
    """Every joint stays within its max_torque along a trajectory; nothing is asked without a mass (None).

    Raises:
        InputError: names the joint, what it would need and what it has.
    """
    if limits is not None and (overload := limits.overload(*trajectory.thinned())) is not None:
        raise InputError(f"with the mass at the flange {overload[1]}: mount a lighter one, or move more slowly")


@lru_cache(maxsize=4)
def _cell(recipe: Recipe) -> Any:
    from agent.robot import Cell

    return Cell(recipe.robot, recipe.tool, recipe.cell.keep_out, recipe.cell.joint_ranges)
