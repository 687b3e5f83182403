"""From files to files: import, estimate, validate."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from agent.core import Console, InputError, RejectedError, error_text
from agent.data_quality import check_quality, fitted_doubts
from agent.diagnosis import with_healthy_effects, with_structure
from agent.estimation import EstimationSettings, beyond_fit, estimate
from agent.model import PAYLOAD, IdentifiedModel
from agent.pipeline.checked_logs import (
    check_one_machine,
    check_plausible,
    load_arm,
    read_logs,
    say_spoiled,
    say_used,
)
from agent.pipeline.declared_effort import check_torque, with_declared_effort
from agent.recording import (
    DATASET_PRESETS,
    Log,
    check_effort,
    import_dataset,
    import_log,
    is_dataset,
    read_log,
)
from agent.robot import RobotDescription, is_gripper, load_robot
from agent.runs import check_output
from agent.simulators import export_model, is_simulator, load_arm as load, load_arm_of
from agent.validation import (
    Validation,
    predict_log,
    summary,
    torque_scales,
)

MAP_OR_PRESET = "import: describe the columns with either --map MAP.yaml or --preset NAME"


def import_files(
    robot: str,
    mapping: Path | str | None,
    inputs: list[Path],
    out: Path,
    topic: str | None = None,
    effort: str | None = None,
) -> list[str]:
    """Turn recordings into logs; returns what there is to say about it.

    `mapping` is a mapping file for columns of tables, the name of a preset, or None for a dataset of a known format,
    whose episodes become a log each. `topic` chooses one of its two arms. `effort` is what the log's effort is.

    Args:
        robot: name, robot.yaml or URDF of the arm.
        mapping: file that maps columns, name of a preset, or None for a dataset of a known format.
        inputs: tables, or the dataset.
        out: log to write; a folder where there are several.
        topic: of the joint states, where a recording has several.
        effort: what the effort is: current, torque, torque-without-gravity or load.

    Raises:
        InputError: a recording, the mapping or the output is not usable.
        RejectedError: the numbers contradict the `effort`; nothing is written.
    """
    check_effort(effort)
    for path in inputs:
        if not path.exists():
            raise InputError(f"{path}: no such file")
    if mapping is None and not is_dataset(inputs[0]):
        if inputs[0].is_dir():
            raise InputError(f"{inputs[0]}: is no dataset of a known format; a LeRobot dataset has meta/info.json")
        raise InputError(MAP_OR_PRESET)
    if out.exists():
        raise InputError(f"{out}: exists already; name another log, or move it away")
    check_output(out, inputs)
    if mapping is None or mapping in DATASET_PRESETS:
        if len(inputs) > 1:
            raise InputError(f"import: one dataset at a time; given were {', '.join(map(str, inputs))}")
        known = is_dataset(inputs[0])
        arm = load_arm(robot, inputs if known else (), topic)
        return list(import_dataset(arm, inputs[0], out, topic, None if known else str(mapping)))
    of_simulator = is_simulator(Path(robot))
    description = partial(load_arm_of, Path(robot)) if of_simulator else load_robot(robot)
    if effort is None:
        return list(import_log(description, mapping, inputs, out))
    with TemporaryDirectory(dir=out.absolute().parent, prefix=f".{out.name}.") as folder:
        unchecked = Path(folder) / out.name
        notes = import_log(description, mapping, inputs, unchecked, effort)
        arm = load_arm(robot, [unchecked])
        with_declared_effort(arm, [read_log(unchecked, arm)], None, False, Console(-1))
        os.rename(unchecked, out)
    return list(notes)


@dataclass(frozen=True)
class FitQuestion:
    """How logs become a model.

    Attributes
    ----------
    cutoff : cut-off frequency of the torque filter [Hz].
    method : estimator; None: the best on held-out data.
    structure : `rigid`, or `auto` to add the effects that these logs clearly show (`agent.diagnosis.structure`).
    topic : topic of the joint states in the logs.
    effort : what the effort of the logs is (`agent.recording.EFFORTS`); None: as their driver says it, or torque.
    allow_mixed : logs may be of several machines or tools.
    force : continue although a log is implausible.
    """

    cutoff: float | None = None
    method: str | None = None
    structure: str = "rigid"
    topic: str | None = None
    effort: str | None = None
    allow_mixed: bool = False
    force: bool = False


def check_structure(structure: str) -> None:
    """Raise InputError if there is no such structure of a model."""
    if structure not in ("rigid", "auto"):
        raise InputError(f"--structure {structure!r} is not known; choose rigid or auto")


def estimate_files(
    robot: str | RobotDescription,
    paths: list[Path],
    out: Path,
    question: FitQuestion,
    console: Console,
    export: Path | None = None,
) -> tuple[dict[str, Any], str]:
    """Fit a model to logs and write its file; returns its content and a summary for people, or all of it (-v).

    With a folder to `export` to, the links have to be bodies that could exist: the method is then `consistent` unless
    another is named.

    Args:
        robot: description, its name or file.
        paths: of the logs.
        out: file of the model.
        question: method, cut-off and structure.
        console: where progress and warnings are shown.
        export: folder for the model as files of simulators.
    """
    check_output(out, paths)
    if export is not None and question.method is None:
        question = replace(question, method="consistent")
    model, _ = fit_files(robot, paths, question, console)
    model.save(out)
    written = [out, *(() if export is None else export_model(model, export, console.warn))]
    name = robot if isinstance(robot, str) else robot.name
    lacks = f"What the model lacks: {what_a_model_lacks(name, [str(path) for path in paths])}"
    check = f"Check the model on another motion: agent validate --model {shlex.quote(str(out))} LOG"
    text = model.text() if console.verbosity > 0 else f"{model.summary(check)}\nAll parameters and the method: -v"
    return model.to_dict(), "\n".join([text, *map(str, written), lacks])


def what_a_model_lacks(robot: str, logs: Sequence[str]) -> str:
    """Return the command that finds in the logs of a fit what the fitted model cannot explain."""
    return shlex.join(["agent", "diagnose", "--robot", robot, *logs])


def _not_recorded(robot: str, description: RobotDescription) -> list[str]:
    """Joints of the arm in a simulator's file, grippers apart, that a description made for a log of it lacks."""
    if not is_simulator(Path(robot)):
        return []
    own = load(Path(robot)).joint_names
    if not set(description.joint_names) < set(own):
        return []
    return [name for name in own if name not in description.joint_names and not is_gripper(name)]


def fit_files(
    robot: str | RobotDescription, paths: list[Path], question: FitQuestion, console: Console
) -> tuple[IdentifiedModel, list[Log]]:
    """`fit_logs` of files; the robot is a description or its name.

    Args:
        robot: description or its name.
        paths: of the logs.
        question: cut-off, method and tool.
        console: told what is being done.
    """
    check_structure(question.structure)
    description = load_arm(robot, paths, question.topic) if isinstance(robot, str) else robot
    if isinstance(robot, str) and (missing := _not_recorded(robot, description)):
        console.warn(
            f"{paths[0]}: {', '.join(missing)} of {Path(robot).name} not recorded, so taken as fixed at zero: if it "
            "moves or stands elsewhere, record its position too"
        )
    logs = read_logs(paths, description, console, question.topic, question.effort, question.force)
    check_torque(logs)
    return fit_logs(description, logs, question, console)


def fit_logs(
    description: RobotDescription, recorded: Sequence[Log], question: FitQuestion, console: Console
) -> tuple[IdentifiedModel, list[Log]]:
    """A model fitted to logs of one machine, and those that it was fitted to, without velocities.

    Args:
        description: of the arm.
        recorded: logs of one machine.
        question: method, cut-off and structure.
        console: where progress and warnings are shown.

    Raises:
        InputError, RejectedError: as `check_one_machine`, `check_plausible` and `estimate`, or too little motion.
    """
    bare = [log for log in recorded if not log.metadata.get(PAYLOAD)]
    check_one_machine(recorded, None, question.allow_mixed, payload_counts=bool(bare))
    logs, loaded = bare or list(recorded), [log for log in recorded if log.metadata.get(PAYLOAD)]
    check_plausible(description, logs, question.force, console)
    say_spoiled(description, logs, console)
    # the fit needs neither, and they take much memory
    logs = [replace(log, velocity=None, planned_position=None) for log in logs]
    del recorded, bare
    model = estimate(description, logs, EstimationSettings.create(cutoff=question.cutoff, method=question.method))
    doubts, usable = list(fitted_doubts(model, logs)), bool(np.all(np.diag(model.covariance) >= 0))
    if any(doubt.refuses for doubt in doubts) and not (question.force and usable):
        names, advice = ", ".join(log.name for log in logs), ", or continue with --force" if usable else ""
        raise RejectedError(f"{names}: {'; '.join(map(str, doubts))}. Nothing is written. Record more{advice}")
    if question.structure == "auto":
        console.step("searching for effects beyond links and friction")
        model = with_structure(description, logs, model, console.progress)
    for doubt in (*model.too_little_motion, *map(str, doubts)):
        console.warn(doubt)
    console.step("measuring each effect on the healthy arm")
    model = with_healthy_effects(model, logs)
    say_used(logs, model.cutoff, model.order, console)
    for scale in torque_scales(model, [*logs, *loaded]) if loaded else ():
        console.say(f"  {scale.text()}")
    return model, logs


def validate_files(
    model_path: Path,
    paths: list[Path],
    cutoff: float | None,
    console: Console,
    allow_mixed: bool = False,
    topic: str | None = None,
    effort: str | None = None,
) -> Validation:
    """Prediction of logs by a model.

    Args:
        model_path: file of the model.
        paths: of logs that took no part in the fit.
        cutoff: of the torque filter [Hz]; None: the model's.
        console: where warnings are shown.
        allow_mixed: take logs of several machines or tools.
        topic: of the joint states, if a log has several.
        effort: what their effort is, where no driver says it.
    """
    model = IdentifiedModel.load(model_path)
    logs = read_logs(paths, model.robot, console, topic, effort)
    check_torque(logs)
    check_one_machine(logs, model, allow_mixed)
    say_spoiled(model.robot, logs, console)
    predictions = [predict_log(model, log, cutoff) for log in logs]
    result = summary(predictions)
    say_used(logs, result.cutoff_hz, model.order, console)
    beyond = beyond_fit(model, [(each.position, each.velocity) for each in predictions])
    for comment in (*_comments(model, logs, result), *beyond):
        console.warn(comment)
    return result


def _comments(model: IdentifiedModel, logs: Sequence[Log], result: Validation) -> Iterator[str]:
    """Doubts about the figures of a validation."""
    fitted = {entry.get("sha256") for entry in model.provenance.get("logs", ())} - {None, ""}
    known = [log.name for log in logs if log.sha256 in fitted]
    if known:
        yield f"the model was fitted to {', '.join(known)}: its error there says little about other motions"
    error = result.overall.relative_error_all_joints
    if error is not None and error > 1:
        reasons = [finding.text for finding in check_quality(model.robot, logs)] or [
            "the model is of another robot, tool or unit than the logs"
        ]
        yield (
            f"the error is {100 * error:.0f} % of the torque itself: predicting no torque at all would be better. "
            f"Most likely: {'; '.join(reasons)}"
        )


def validation_text(result: Validation) -> str:
    """A validation as a table for people."""
    overall = result.overall
    width = max(12, *map(len, result.joints))
    lines = [f"{'joint':{width}} {'RMSE':>10}     {'of nominal':>12} {'of measured torque':>19}"]
    for k, name in enumerate(result.joints):
        nominal, relative = (error_text(of[k], None) for of in (overall.normalised_rmse, overall.relative_error))
        figures = f"{overall.rmse[k]:10.4g} {result.units[k]:3} {nominal:>12} {relative:>19}"
        lines.append(f"{name:{width}} {figures}")
    logs = ", ".join(log.log for log in result.logs)
    error = error_text(overall.relative_error_all_joints, None)
    lines.append(f"all joints: {error} of measured torque, at {result.cutoff_hz:g} Hz ({logs})")
    return "\n".join(lines)
