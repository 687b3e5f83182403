"""The one list of checks of recorded data, which `estimate`, `validate` and `diagnose` share.

Checks run in stages, the surest first: signals for themselves, then signals against each other and the description,
then fits of a rigid arm. What one stage refuses would mislead the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from agent.data_quality.alignment import late_velocity
from agent.data_quality.channels import (
    dead_channels,
    discontinuous_positions,
    spoiled_samples,
    static_postures,
    stuck_joints,
    unsigned_channels,
    velocity_mismatch,
)
from agent.data_quality.description_fit import (
    compared_weight,
    described_weight,
    excessive_torque,
    excessive_weight,
    position_units,
)
from agent.data_quality.description_units import description_units
from agent.data_quality.faults import QualityFinding, Recordings
from agent.data_quality.mechanics import implausible_mechanics, wrong_lengths
from agent.recording import Log
from agent.robot import RobotDescription

#: Every check in stages. One that refuses, or finds another unit, ends the list.
CHECKS: tuple[tuple[Callable[[Recordings], Iterator[QualityFinding]], ...], ...] = (
    (discontinuous_positions,),
    (static_postures,),
    (description_units,),
    (dead_channels, position_units, excessive_torque, unsigned_channels),
    (velocity_mismatch,),
    (late_velocity,),
    (stuck_joints,),
    (described_weight,),
    (implausible_mechanics,),
    (wrong_lengths, excessive_weight),
)


def check_quality(
    robot: RobotDescription,
    logs: Sequence[Log],
    others: Sequence[Log] = (),
    predicted: Callable[[], bool] = lambda: False,
) -> list[QualityFinding]:
    """What is wrong with logs, the likeliest reason first; empty where nothing speaks against them.

    Parameters
    ----------
    robot : description that the logs are read with
    logs : recorded motions; those without torque are ignored
    others : further motions of the same recorder. A mistake that only fits better has to do so with them as well: a few
        seconds of slow motion do not distinguish it from chance.
    predicted : whether a fitted model predicts the logs, asked once a search for mistakes would be next: none is there
    """
    findings: list[QualityFinding] = []
    recordings = Recordings(robot, [log for log in logs if log.effort is not None], others, predicted)
    for stage in CHECKS if recordings.logs else ():
        findings += [finding for check in stage for finding in check(recordings)]
        if any(finding.refuses or finding.scale for finding in findings):
            break
    return findings


def contradicted(robot: RobotDescription, logs: Sequence[Log], declared: str) -> str | None:
    """What in the torques of logs contradicts what they are said to be; None: nothing.

    Torque itself is checked by `check_quality`.

    Args:
        robot: description of the arm.
        logs: with torque.
        declared: `current` or `torque-without-gravity`.
    """
    measured = [log for log in logs if log.effort is not None]
    if declared not in ("current", "torque-without-gravity") or not measured:
        return None
    weight = compared_weight(Recordings(robot, measured))
    if weight is None:
        return None
    if declared == "torque-without-gravity" and weight.alike.any():
        sizes = zip(weight.joints[weight.alike], weight.times[weight.alike], strict=True)
        listed = ", ".join(f"{robot.joint_names[k]} {times:.2g}" for k, times in sizes)
        return f"they carry gravity, as a multiple of what the described masses weigh: {listed}"
    if declared == "current" and weight.absent.all():
        return "currents carry gravity, and these show none"
    return None


def spoiled(robot: RobotDescription, logs: Sequence[Log]) -> list[QualityFinding]:
    """Samples whose torque cannot be used, joint by joint; none of it refuses a log."""
    return list(spoiled_samples(Recordings(robot, [log for log in logs if log.effort is not None])))
