"""What the effort of a log is, and the joint torque that follows from it."""

from __future__ import annotations

from dataclasses import replace

from agent.core import InputError
from agent.recording.log import EFFORT, Log
from agent.robot import RobotDescription, torque_per_ampere

TORQUE, CURRENT, WITHOUT_GRAVITY, LOAD = "torque", "current", "torque-without-gravity", "load"
#: What the effort of a log may be declared to be, and why it is no joint torque.
EFFORTS = {
    TORQUE: "",
    CURRENT: "motor currents become torque by a torque_constant for every joint in robot.yaml",
    WITHOUT_GRAVITY: (
        "the controller took gravity off with masses that only it knows: record the total torque or the motor currents"
    ),
    LOAD: (
        "a share of the stall torque says no torque; import it with the unit % or ‰ of effort where robot.yaml has "
        "nominal torques"
    ),
}


def check_effort(declared: str | None) -> None:
    """Raise InputError if an effort cannot be declared to be this."""
    if declared is not None and declared not in EFFORTS:
        raise InputError(f"--effort {declared!r} is not known; choose {', '.join(EFFORTS)}")


def effort_of(log: Log, declared: str | None) -> str | None:
    """What the effort of a log is: as declared, else as its driver says it; None: nobody says it.

    Raises:
        InputError: the driver says something else than the user.
    """
    recorded = log.metadata.get(EFFORT)
    if recorded in EFFORTS and declared is not None and declared != recorded:
        raise InputError(f"{log.path}: its effort is {recorded}, as its driver says; leave out --effort {declared}")
    return declared or (recorded if recorded in EFFORTS else None)


def with_joint_torque(log: Log, robot: RobotDescription, meaning: str | None) -> Log:
    """The log with joint torque as effort, or without any where it is no torque; its metadata say what it was.

    Args:
        log: as it was recorded.
        robot: with torque constants k, motor currents i become τ = Cᵀ diag(g k) i.
        meaning: what the log's effort is; None: the log stays as it is.
    """
    if log.effort is None or meaning is None:
        return log
    metadata = log.metadata | {EFFORT: meaning}
    if meaning == CURRENT and all(joint.torque_constant for joint in robot.joints):
        return replace(log, effort=log.effort @ torque_per_ampere(robot).T, metadata=metadata)
    return replace(log, effort=log.effort if meaning == TORQUE else None, metadata=metadata)
