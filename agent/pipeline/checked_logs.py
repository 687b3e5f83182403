"""Logs that fit together: read, of one machine, and such as this arm can have made."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from agent.core import Console, InputError, RejectedError, and_list
from agent.data_quality import check_quality, spoiled
from agent.estimation import FilterSettings, used_text
from agent.model import PAYLOAD, IdentifiedModel
from agent.pipeline.declared_effort import with_declared_effort
from agent.recording import (
    Log,
    read_recording,
    recorded_joints,
)
from agent.robot import RobotDescription, load_robot
from agent.simulators import is_simulator, load_arm as load
from agent.validation import (
    flipped_joints,
    is_of_another_robot,
    predicts,
    same_scale,
)

_ANOTHER_ROBOT = (
    "these torques are of an arm with another inertia on most joints than the model's, whatever hangs on the flange: "
    "name the model of that robot, or estimate it from these logs"
)


def load_arm(robot: str, logs: Sequence[Path] = (), topic: str | None = None) -> RobotDescription:
    """A robot by name or path; of a URDF or MJCF, the arm whose joints the logs have.

    Args:
        robot: name or path.
        logs: whose joints count.
        topic: of the logs, where they have several.

    Raises:
        InputError: no such robot, or a file that is wrong.
    """
    if not is_simulator(Path(robot)):
        return load_robot(robot)

    return load(Path(robot), joints_of(logs[0], Path(robot), topic) if logs else ())


def joints_of(recording: Path, simulator: Path, topic: str | None = None) -> tuple[str, ...]:
    """Joints of a recording; of one that names none, as many as it has of those of the simulator's arm.

    Raises:
        InputError: the recording cannot be read, or has more columns than the arm has joints.
    """
    recorded = recorded_joints(recording, topic)
    return load(simulator, most=recorded).joint_names if isinstance(recorded, int) else recorded


def read_logs(
    paths: Sequence[Path],
    robot: RobotDescription,
    console: Console,
    topic: str | None = None,
    effort: str | None = None,
    force: bool = False,
) -> list[Log]:
    """Read logs and warn of what was repaired.

    `topic` holds the joint states if a log has several; `effort` is what their effort is, where no driver says it.

    Args:
        paths: MCAP files or recordings of a known format.
        robot: whose joints the logs have.
        console: where repairs are shown.
        topic: of the joint states, if a log has several.
        effort: what their effort is, where no driver says it.
        force: take numbers that contradict the `effort`.

    Raises:
        InputError: a file cannot be read, or its driver says something else of its effort.
        RejectedError: the numbers contradict the `effort`, and there is no `force`.
    """
    logs: list[Log] = []
    for path in paths:
        recording, notes = read_recording(path, robot, topic)
        for note in notes:
            console.say(f"{path.name}: {note}")
        for log in recording:
            for repair in log.repairs:
                console.warn(f"{log.name}: {repair}")
        logs += recording
    return with_declared_effort(robot, logs, effort, force, console)


def check_one_machine(
    logs: Sequence[Log], model: IdentifiedModel | None, allow_mixed: bool, payload_counts: bool = False
) -> None:
    """Refuse logs of several machines or tools, or of others than the model's.

    With `payload_counts`, a mass that was mounted on purpose is taken into account, as by a diagnosis.

    Args:
        logs: of one diagnosis or estimate.
        model: to judge them by; None: none.
        allow_mixed: whether several machines are allowed.
        payload_counts: whether a mounted mass is taken into account.

    Raises:
        InputError: two serials or two tools differ (both are named), or a payload would not be taken into account.
    """
    loaded = [log for log in logs if log.metadata.get(PAYLOAD)]
    if loaded and not payload_counts:
        raise InputError(
            f"{loaded[0].name}: was recorded with a mass mounted on purpose ({loaded[0].metadata[PAYLOAD]}). Only "
            "agent diagnose takes the mass into account, and agent estimate with logs of the bare arm: leave it out"
        )
    if allow_mixed:
        return
    for key in ("serial", "tool"):
        log_by_value = {value: log.name for log in reversed(logs) if (value := log.metadata.get(key))}
        if model is not None:
            log_by_value |= {value: "the model" for value in model.provenance.get(key, ())}
        if len(log_by_value) > 1:
            listed = and_list([f"{value} ({where})" for value, where in sorted(log_by_value.items())])
            raise InputError(
                f"the logs are not of one {'machine' if key == 'serial' else 'tool'}: {key} {listed}. "
                "Name the logs of one, or allow both with --allow-mixed"
            )


def check_plausible(
    robot: RobotDescription,
    logs: Sequence[Log],
    force: bool,
    console: Console,
    advice: str = "Nothing is written. Fix it, or continue with --force",
    described: bool = True,
    model: IdentifiedModel | None = None,
    further: Sequence[Log] = (),
) -> None:
    """Refuse logs that no motion of this robot can have made; with `force` only warn.

    Parameters
    ----------
    described : the robot's name is that of a description, not of a simulator's file.
    model : logs that it predicts are plausible, and torques of the size it predicts are in the right unit, whatever
        the description's masses. Logs that name another robot are refused where a fitted model does not predict them.
    further : further motions, which have to confirm a doubt about few logs.

    Raises
    ------
    RejectedError : with the likeliest reason first.
    """
    predicted = cache(lambda: model is not None and predicts(model, logs))
    findings = check_quality(robot, logs, further, predicted)
    refusals = [str(finding) for finding in findings if finding.refuses]
    if findings and model is not None:
        if refusals and predicted():
            refusals = []
        elif same_scale(model, logs):
            findings = [finding for finding in findings if not finding.scale]
            refusals = [str(finding) for finding in findings if finding.refuses]
        flipped = {log.name: ", ".join(flipped_joints(model, log)) for log in logs} if not refusals else {}
        refusals = refusals or [
            f"{name}: the torque of {joints} has the opposite sign of the prediction"
            for name, joints in flipped.items()
            if joints
        ]
    others = sorted({log.metadata.get("robot", "") for log in logs} - {"", robot.name}) if described else []
    named = [f"the logs say that they are of robot {' and '.join(others)}, not of {robot.name}"] if others else []
    # a simulator without friction predicts no arm
    if named and not refusals and model is not None and not model.of_file and not predicted():
        refusals, named = [f"{named[0]}, and its model does not predict them"], []
    if not refusals and model is not None and not model.of_file and not predicted():
        refusals = [_ANOTHER_ROBOT] if is_of_another_robot(model, logs) else []
    if refusals and not force:
        names = ", ".join(log.name for log in logs)
        raise RejectedError(f"{names}: {'; '.join([*named, *refusals])}. {advice}")
    for warning in (*named, *refusals, *(str(finding) for finding in findings if not finding.refuses)):
        console.warn(warning)


def check_run(
    robot: RobotDescription,
    logs: Sequence[Log],
    model: IdentifiedModel | None,
    console: Console,
    further: Sequence[Log] = (),
) -> None:
    """Check what a run recorded for its fit with `check_one_machine` and `check_plausible`.

    Raises:
        InputError, RejectedError: as said there.
    """
    check_one_machine(logs, model, allow_mixed=False)
    advice = (
        "No model is written. Fix the description or what the controller sends, then start a new run. "
        "`agent estimate --force` fits these logs all the same"
    )
    check_plausible(robot, logs, False, console, advice, further=further)


def say_spoiled(robot: RobotDescription, logs: Sequence[Log], console: Console) -> None:
    """Warn of samples whose torque cannot be used."""
    for finding in spoiled(robot, logs):
        console.warn(str(finding))


def say_used(logs: Sequence[Log], cutoff: float, order: int, console: Console) -> None:
    """Say how many samples of each log remain after the filter; warn of segments that are too short for it."""
    for log in logs:
        text = used_text(log, FilterSettings(cutoff, order))
        (console.warn if "left out" in text else console.say)(text)
