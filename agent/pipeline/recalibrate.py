"""Calibrating again by the clock: the stored loop, the parameters that wear, a gate against the last accepted model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, ControllerError, error_text, sha256_file
from agent.link import Recording, RobotLink, open_link
from agent.pipeline.calibrate import step
from agent.pipeline.drift_check import diagnose_if_worse, worse_joints
from agent.pipeline.ending import current_run, ending_text
from agent.pipeline.record_plan import EXCITATION, record_program
from agent.pipeline.reference import Reference, find_reference, last_accepted
from agent.pipeline.reports import refresh_index, watch_lines
from agent.pipeline.result import RecordingFigures, provenance
from agent.recipe import Recipe
from agent.robot import not_judged_text, outcome_text, torque_units, without_nominal
from agent.runs import RunFolder, apply_run, approve, register_run, robot_lock, run_key, too_early, wrong_clock
from agent.safety import Authorisation

if TYPE_CHECKING:
    from agent.estimation import Refit
    from agent.model import IdentifiedModel
    from agent.pipeline.until_sure import Found, Rounds
    from agent.recording import Log
    from agent.runs import StoredLoop
    from agent.validation import Comparison, Prediction

_SIGNIFICANT = 3.0


@dataclass(frozen=True)
class RecalibrationOutcome:
    """What came of it: `skipped` says why nothing was done; else run folder, `result.json` and what comes next."""

    skipped: str = ""
    run: Path | None = None
    result: dict[str, Any] | None = None
    ending: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the gate let it through, or there was nothing to do."""
        return self.result is None or bool(self.result["accepted"])

    def summary(self) -> str:
        """A few lines."""
        if self.result is None:
            return f"skipped: {self.skipped}"
        validation = self.result["validation"]
        axes = [
            f"{name} {error_text(share, torque, unit)} (was {error_text(share_before, torque_before, unit)})"
            for name, share, torque, share_before, torque_before, unit in zip(
                *(validation[k] for k in ("joints", "normalised_rmse", "rmse")),
                *(validation[k] for k in ("normalised_rmse_before", "rmse_before", "units")),
                strict=True,
            )
        ]
        rows = ["  ".join(axes[k : k + 3]) for k in range(0, len(axes), 3)]
        lines = ["prediction error    " + f"\n{'':20}".join(rows), f"change              {self.result['comparison']}"]
        if self.result["diagnosis"]:
            lines.append(f"diagnosis           {self.result['diagnosis']['summary']}")
        lines.append(f"compared with       {self.result['reference']}")
        word = outcome_text(
            self.accepted, self.result["reason"], self.result["gate"]["not_judged"], validation["joints"]
        )
        lines += [f"result              {word}", f"report              {self.run}/report.html", self.ending]
        return "\n".join(lines)


def run_recalibration(
    recipe: Recipe,
    console: Console,
    logs: Path,
    yes: bool = False,
    authorisation: Authorisation | None = None,
    now: datetime | None = None,
) -> RecalibrationOutcome:
    """Run the stored loop again, estimate, judge, record, and make the model current if it is accepted.

    Raises:
        InputError: never calibrated, no stored loop, or motion that nobody allowed.
        AgentError, DriverError: as in `calibrate`, with their exit codes.
    """
    now = now or datetime.now(UTC)
    past = last_accepted(recipe, logs, now)
    if early := too_early(past, recipe.recalibrate.every, now):
        return RecalibrationOutcome(skipped=early)
    if warning := wrong_clock(past, now):
        console.warn(warning)
    with robot_lock(recipe.controller.driver, recipe.controller.address):
        reference = find_reference(recipe, logs, past)
        if authorisation is not None:
            authorisation.check_problem(reference.loop.key)
        run = RunFolder.create(logs, recipe.robot.name, recipe.path)
        facts = {"reference": reference.run, "program": reference.loop.checksum, "serial": past.serial}
        options = [] if authorisation is None else ["--authorisation", str(authorisation.path)]
        run.note(kind="recalibrate", options=options, **facts, **run_key(recipe))
        approve(run, recipe)
        console.say(f"run {run.path}")
        if not_judged := not_judged_text(recipe.robot, recipe.gate.normalised_rmse):
            console.warn(not_judged)
        with step(run, "record", console):
            recording = _record(recipe, reference, run, console, yes, logs, authorisation)
        with step(run, "estimate", console):
            log, found, comparison = _estimate(recipe, reference, run, console)
        with step(run, "validate", console):
            from agent.pipeline.conditions import conditions
            from agent.validation import predict_log

            prediction = predict_log(found.model, log)
            met = conditions(log, prediction, recording)
            result = _judge(recipe, reference, run, recording, found, comparison, met)
            worse = result["validation"]["worse_before"]
            asked: list[Rounds] = []

            def ask(find: Callable[[Sequence[Path]], Found]) -> Rounds:
                asked.append(_further(find, recipe, run, console, logs, authorisation))
                return asked[-1]

            released = authorisation is not None and authorisation.document.new_motions is not None
            result["diagnosis"] = diagnose_if_worse(
                reference.model, worse, log, run, console, ask if released else None
            )
            current = current_run(logs, recipe.robot.name, run.state["serial"])
            result["current_model"] = run.path.name if result["accepted"] else current
        with step(run, "report", console):
            _report(recipe, reference.loop, run, result, comparison, log, prediction)
        register_run(run, console)
        if result["accepted"]:
            apply_run(logs, run.path)
        watched = watch_lines(logs, recipe.robot.name, run.state["serial"])
        run.note(watch=watched)
        refresh_index(logs, console)
    for line in watched:
        console.warn(line)
    if asked and asked[0].cut_short is not None:
        raise asked[0].cut_short
    return RecalibrationOutcome(run=run.path, result=result, ending=ending_text(run, recipe))


def _record(
    recipe: Recipe,
    reference: Reference,
    run: RunFolder,
    console: Console,
    yes: bool,
    logs: Path,
    allowed: Authorisation | None,
) -> Recording:
    loop = reference.loop
    with open_link(recipe, console, yes, logs, allowed) as link:
        _check_machine(reference, link)
        run.note(serial=link.identity.serial)
        if allowed is not None and (soon := allowed.ends_soon()):
            console.warn(soon)
        suffix = recipe.dialect.suffix
        run.write_text(f"program{suffix}", loop.program)
        what, path = f"the stored loop {loop.checksum[:12]}", f"{loop.program_name}{suffix}"
        return record_program(link, run, recipe, console, loop.program, path, "excitation", EXCITATION, what)


def _further(
    find: Callable[[Sequence[Path]], Found],
    recipe: Recipe,
    run: RunFolder,
    console: Console,
    logs: Path,
    allowed: Authorisation | None,
) -> Rounds:
    """Motions that are planned for what the diagnosis leaves open, as far as they are released."""
    from agent.pipeline.until_sure import until_sure

    assert allowed is not None
    assert allowed.document.new_motions is not None
    return until_sure(find, [], recipe, run, console, logs, False, allowed.document.new_motions.duration, allowed)


def _check_machine(reference: Reference, link: RobotLink) -> None:
    known, here = reference.past.serial, link.identity.serial
    if known and known != here:
        raise ControllerError(
            f"{link.address}: this machine has serial {here}; the last accepted model is of {known}, another one of "
            "the same type. Calibrate this one first: `agent calibrate`"
        )


def _estimate(recipe: Recipe, reference: Reference, run: RunFolder, console: Console) -> tuple[Log, Refit, Comparison]:
    from agent.estimation import refit
    from agent.pipeline.identify import check_run, read_logs
    from agent.validation import compare_models

    what = recipe.recalibrate.parameters
    console.step("estimating friction again" if what == "friction" else "estimating all parameters again")
    (log,) = read_logs([run.file(EXCITATION)], recipe.robot, console)
    check_run(recipe.robot, [log], reference.model, console)
    found = refit(reference.model, [log], what, recipe.tool)
    found.model.save(run.file("model.json"))
    run.note(model_sha256=sha256_file(run.file("model.json")))
    return log, found, compare_models(reference.model, found.model, log, reference.run, run.path.name)


def _judge(
    recipe: Recipe,
    reference: Reference,
    run: RunFolder,
    recording: Recording,
    found: Refit,
    comparison: Comparison,
    met: dict[str, Any],
) -> dict[str, Any]:
    """The content of `result.json`, with the gate's word and the reason if it is no."""
    faults = gate_faults(recipe.gate.normalised_rmse, reference.model, found, met, comparison)
    nominal = found.model.robot.nominal_torque
    moved = [change for change in comparison.parameters if change.moved]
    return {
        "schema": "recalibration/1",
        "robot": recipe.robot.name,
        "serial": run.state["serial"],
        "reference": reference.run,
        "parameters": recipe.recalibrate.parameters,
        "accepted": not faults,
        "reason": "; ".join(faults),
        "gate": {
            "normalised_rmse": recipe.gate.normalised_rmse,
            "not_judged": list(without_nominal(recipe.robot)),
        },
        "validation": {
            "joints": list(recipe.robot.joint_names),
            "units": list(torque_units(recipe.robot)),
            "rmse": found.held_out,
            "rmse_before": found.before,
            "normalised_rmse": found.held_out / nominal,
            "normalised_rmse_before": found.before / nominal,
            "worse_before": worse_joints(reference.model, found.before),
        },
        "comparison": (
            f"{len(moved)} of {len(comparison.parameters)} parameters moved by more than their uncertainty"
            + (f": {', '.join(change.name for change in moved)}" if moved else "")
        ),
        "loop": {
            "created": reference.loop.created,
            "fitness": reference.loop.fitness,
            "via_points": np.array(reference.loop.poses)[:, :3, 3],
        },
        "conditions": met,
        "recordings": [asdict(RecordingFigures.of(recording))],
        "provenance": provenance(run.path, run.state, [recording.path]),
    }


def gate_faults(
    gate: float, last: IdentifiedModel, found: Refit, met: dict[str, Any], comparison: Comparison
) -> list[str]:
    """What speaks against making a refitted model the current one; nothing if it is accepted.

    Args:
        gate: largest normalised RMSE of any axis.
        last: the last accepted model; `comparison` is of it with the new one.
        met: the run's conditions, with the friction found.
    """
    robot = found.model.robot
    faults = []
    figures = found.held_out / robot.nominal_torque
    for k in np.flatnonzero(figures > gate).tolist():
        faults.append(
            f"{robot.joint_names[k]}: prediction error {100 * figures[k]:.2f} %, the gate is {100 * gate:.2f} %"
        )
    for name in worse_joints(last, found.held_out):
        k = robot.joint_names.index(name)
        faults.append(
            f"{name}: held-out error {found.held_out[k]:.3g} N·m, {last.held_out_rmse[k]:.3g} N·m at the last accepted "
            "run: something has changed that these parameters do not describe"
        )
    for level in met["friction"]:
        if level["value"] + _SIGNIFICANT * level["standard_deviation"] < 0:
            faults.append(f"{level['joint']}: its friction at {level['speed']:.3g} rad/s comes out negative")
    inertial = set(last.names[: len(last.independent)])
    rigid = [c for c in comparison.parameters if c.moved and c.name in inertial]
    far = (comparison.torque.rmse > gate * robot.nominal_torque) & (
        comparison.torque.rmse > _SIGNIFICANT * comparison.torque.standard_deviation
    )
    if rigid and np.any(far):
        names = ", ".join(np.array(robot.joint_names)[far])
        faults.append(
            f"{names}: links or payload ({', '.join(c.name for c in rigid[:4])}) differ from the last accepted model "
            "by more than the gate; links do not wear, look for another tool or load, then calibrate"
        )
    return faults


def _report(
    recipe: Recipe,
    loop: StoredLoop,
    run: RunFolder,
    result: dict[str, Any],
    comparison: Comparison,
    log: Log,
    prediction: Prediction,
) -> None:
    from agent.pipeline.analysis_log import write_analysis
    from agent.pipeline.reports import recalibration_page

    write_analysis(run.file("analysis.mcap"), log, prediction)
    run.write_json("result.json", result)
    run.write_json("comparison.json", comparison.to_dict())
    page = recalibration_page(recipe, loop.program, result, comparison, log, prediction, run.path)
    run.write_text("report.html", page)
    run.complete(result["accepted"])
