"""An error of torque as people read it: a share of the joint's nominal torque, or a torque where it has none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agent.core import error_text

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Unit of a figure that is a share of nominal torque.
SHARE = "of nominal"


def torque_units(robot: RobotDescription) -> tuple[str, ...]:
    """Unit of every joint's torque: N·m, on a prismatic joint N."""
    return tuple(joint.torque_unit for joint in robot.joints)


def position_units(robot: RobotDescription) -> tuple[str, ...]:
    """Unit of every joint's position: rad, on a prismatic joint m."""
    return tuple(joint.position_unit for joint in robot.joints)


def error_units(robot: RobotDescription) -> list[str]:
    """What a figure of each joint is in: "of nominal" torque, or the unit of its torque where it has no nominal one."""
    return [
        unit if joint.nominal_motor_torque is None else SHARE
        for joint, unit in zip(robot.joints, torque_units(robot), strict=True)
    ]


def figure_text(value: float, unit: str, digits: int = 2) -> str:
    """A figure in one of `error_units`: shares in percent.

    Args:
        value: share, or torque.
        unit: one of `error_units`.
        digits: that are significant.
    """
    return error_text(value, None, digits=digits) if unit == SHARE else error_text(None, value, unit)


def without_nominal(robot: RobotDescription) -> tuple[str, ...]:
    """Names of the joints whose description has no nominal torque: a gate on shares of it cannot judge them."""
    return tuple(joint.name for joint in robot.joints if joint.nominal_motor_torque is None)


def not_judged_text(robot: RobotDescription, gate: float) -> str:
    """Which joints the gate (a share of nominal torque) will not judge, and what to do; empty where it judges all."""
    names = without_nominal(robot)
    if not names:
        return ""
    which = "no joint" if len(names) == robot.dof else f"{', '.join(names)} not"
    return (
        f"the gate of {100 * gate:g} % of nominal torque judges {which}: robot {robot.name} has no "
        f"nominal_motor_torque {'' if len(names) == robot.dof else 'there '}(errors are given in N·m instead); give it "
        "in robot.yaml to have them judged"
    )


def outcome_text(accepted: bool, reason: str, not_judged: Sequence[str], joints: Sequence[str]) -> str:
    """The gate's word on a run.

    Args:
        accepted: whether the gate passed.
        reason: why.
        not_judged: joints without a limit.
        joints: all of them.
    """
    if not accepted:
        return f"REJECTED: {reason}"
    if len(not_judged) == len(joints):
        return "done, not judged: the robot description has no nominal torques"
    if not_judged:
        return f"accepted, without {', '.join(not_judged)}: no nominal torque to judge them by"
    return "accepted"
