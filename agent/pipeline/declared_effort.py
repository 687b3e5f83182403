"""The effort of logs as the user or the driver declares it, checked against the numbers."""

from __future__ import annotations

from collections.abc import Sequence

from agent.core import Console, RejectedError
from agent.data_quality import contradicted
from agent.recording import EFFORTS, Log, check_effort, effort_of, with_joint_torque
from agent.robot import RobotDescription


def with_declared_effort(
    robot: RobotDescription, logs: Sequence[Log], declared: str | None, force: bool, console: Console
) -> list[Log]:
    """Logs with joint torque, or with none where their effort is something else; `declared` counts for all of them.

    Raises:
        InputError: no such meaning, or the driver says another one.
        RejectedError: the numbers contradict it; with `force` only a warning.
    """
    check_effort(declared)
    meanings = [effort_of(log, declared) for log in logs]
    for meaning in sorted({stated for stated in meanings if stated is not None}):
        these = [log for log, own in zip(logs, meanings, strict=True) if own == meaning]
        against = contradicted(robot, these, meaning)
        if against is None:
            continue
        names = ", ".join(log.name for log in these)
        text = f"{names}: the numbers contradict that the effort is {meaning}: {against}"
        if not force:
            raise RejectedError(f"{text}. Nothing is written. Declare what it is with --effort, or go on with --force")
        console.warn(text)
    return [with_joint_torque(log, robot, meaning) for log, meaning in zip(logs, meanings, strict=True)]


def check_torque(logs: Sequence[Log]) -> None:
    """Refuse logs whose effort is no joint torque where torque is needed.

    Raises:
        RejectedError: with the meaning of the effort, and what gives torque.
    """
    for log in logs:
        meaning = effort_of(log, None)
        if log.effort is None and meaning is not None and EFFORTS[meaning]:
            raise RejectedError(
                f"{log.name}: the effort is {meaning} and no joint torque: {EFFORTS[meaning]}. Nothing is written"
            )
