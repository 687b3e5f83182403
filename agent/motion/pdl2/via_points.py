"""A program as via-points, for a controller that takes those: what each move says, as joint positions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion.interpolator import Trajectory
from agent.motion.path_settings import FlyTrajectory, FlyType, SpeedOption
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.program import (
    CartesianTarget,
    Move,
    MoveType,
    Statement,
    pose_in_robot_base,
    stop_to_stop,
    tool_frame,
)
from drivers.protocol import ViaPoint

if TYPE_CHECKING:
    from agent.robot import RobotDescription, Tool

#: A MOVE JOINT becomes straight lines between points of its plan, no joint turning further in one of them [rad, m].
JOINT_STEP = np.radians(5.0)
#: So far may the arm pass by those points [m], so slowly at least [m/s].
JOINT_TOLERANCE, SLOWEST = 0.005, 0.01
_SAME = 1e-6  # of poses [m] and joints [rad] that are written with nine decimals


def via_points(
    name: str,
    statements: Iterable[Statement],
    chains: Sequence[Trajectory],
    robot: RobotDescription,
    tool: Tool | None,
) -> tuple[ViaPoint, ...]:
    """The points of a program: where its moves lead, `fly_tolerance` their $FLY_DIST, `linear_speed` their $LIN_SPD.

    A MOVE JOINT, which the controller does not have for points, is taken from its plan, one of the `chains` from stop
    to stop.

    Args:
        name: of the program.
        statements: in order.
        chains: plans from stop to stop.
        robot: description of the arm.
        tool: at the flange; None: none.

    Raises:
        InputError: a move that points cannot say.
    """
    remaining = [*chains]
    points: list[ViaPoint] = []
    own = tool_frame(tool)
    for moves in stop_to_stop(statements):
        for move in moves:
            if move.settings.tool is not None and np.abs(np.array(move.settings.tool) - own).max() > _SAME:
                raise InputError(_cannot(name, move, "one tool, the recipe's"))
        if remaining and _is_plan_of(remaining[0], moves):
            chain = remaining.pop(0)
            if len(moves) == 1 and moves[0].type is MoveType.JOINT:
                points += _along(chain)
            else:
                points += [_point(move, index, chain, name, robot, tool) for index, move in enumerate(moves)]
    if remaining:
        raise InputError(f"program {name}: its plan and its moves do not belong together; plan again")
    return tuple(points)


def _point(
    move: Move, index: int, chain: Trajectory, name: str, robot: RobotDescription, tool: Tool | None
) -> ViaPoint:
    from agent.robot import kinematics_for

    settings = Pdl2Settings.of(move.settings)
    if move.type is not MoveType.LINEAR or settings.speed_option is not SpeedOption.SPD_LIN:
        raise InputError(_cannot(name, move, "only MOVE LINEAR at a linear speed, and single MOVE JOINT to a stop"))
    if move.fly and (settings.fly_type, settings.fly_trajectory) != (FlyType.FLY_CART, FlyTrajectory.FLY_TOL):
        raise InputError(_cannot(name, move, "FLY_CART with FLY_TOL"))
    if isinstance(move.target, CartesianTarget):
        seed = chain.q[np.flatnonzero(chain.move == index)[-1]]
        position = kinematics_for(robot, tool).solve(pose_in_robot_base(move.target, move.settings), seed)
    else:
        position = np.asarray(move.target.position, dtype=float)
    speed = settings.linear_speed * settings.speed_override * settings.arm_override
    return ViaPoint(position, settings.fly_distance if move.fly else 0.0, speed)


def _along(chain: Trajectory) -> list[ViaPoint]:
    """Points of a plan, near enough for straight lines between them to be it; the last is a stop."""
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(chain.q, axis=0)).max(axis=1))])
    count = max(1, int(np.ceil(turned[-1] / JOINT_STEP)))
    ends = np.searchsorted(turned, np.linspace(0.0, turned[-1], count + 1)[1:])
    ends[-1] = len(turned) - 1
    points = []
    start = 0
    for end in ends:
        speed = max(SLOWEST, float(chain.path_speed[start : end + 1].max()))
        points.append(ViaPoint(chain.q[end], JOINT_TOLERANCE if end < len(turned) - 1 else 0.0, speed))
        start = end
    return points


def _is_plan_of(chain: Trajectory, moves: list[Move]) -> bool:
    """Whether a plan is that of these moves; a group that moves nothing has none."""
    if int(chain.move.max()) + 1 != len(moves):
        return False
    target = moves[-1].target
    if isinstance(target, CartesianTarget):
        return bool(np.abs(chain.tcp[-1] - pose_in_robot_base(moves[-1].target, moves[-1].settings)).max() < _SAME)
    return bool(np.abs(chain.q[-1] - target.position).max() < _SAME)


def _cannot(name: str, move: Move, allowed: str) -> str:
    return (
        f"program {name}, line {move.line}: this link sends via-points, which can say {allowed}; leave mode=points out "
        "of controller.address, or change the program"
    )
