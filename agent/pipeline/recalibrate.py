"""Recalibration: the stored loop again, the parameters that wear, and a gate against the last accepted model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, ControllerError, InputError, error_text, read_json, sha256_file
from agent.diagnosis import diagnose
from agent.estimation import Refit, refit
from agent.excitation import Candidates
from agent.link import Recording, open_link
from agent.model import IdentifiedModel
from agent.motion import Move, Target
from agent.pipeline.checked_logs import check_run, read_logs
from agent.pipeline.ending import current_run
from agent.pipeline.gap.diagnosis_run import DiagnosisRun
from agent.pipeline.gap.until_sure import until_sure
from agent.pipeline.job import EXCITATION, Job, Outcome
from agent.pipeline.planning.loop_program import LoopMotion
from agent.pipeline.planning.plan import loop_problem
from agent.pipeline.reports import diagnose_if_worse, recalibration_page, worse_joints, write_analysis
from agent.pipeline.result import conditions, gate_decision, gate_figures, provenance_of, temperatures
from agent.recipe import Recipe
from agent.recording import Log, read_log
from agent.robot import outcome_text, torque_units, without_nominal
from agent.runs import (
    FOLDER,
    History,
    PastRun,
    StoredLoop,
    apply_run,
    approved_parts,
    current_model,
    differences,
    find_loop,
    problem,
    register_run,
    robot_lock,
    run_key,
    too_early,
    watch,
    wrong_clock,
)
from agent.safety import Authorisation
from agent.validation import Comparison, compare_models, predict_log

_SIGNIFICANT = 3.0
#: Tolerance of poses [m] and joints [rad] that are written with nine decimals.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Reference:
    """The last accepted run of the same loop, the model to compare with and the run it is of, and the loop."""

    past: PastRun
    run: str
    model: IdentifiedModel
    loop: StoredLoop


def run_recalibration(
    recipe: Recipe,
    console: Console,
    logs: Path,
    yes: bool = False,
    authorisation: Authorisation | None = None,
    now: datetime | None = None,
) -> Outcome:
    """Run the stored loop again, estimate, judge, record, and make the model current if it is accepted.

    Args:
        recipe: of the calibration that is repeated.
        console: where progress is shown.
        logs: folder of runs.
        yes: whether motion may begin without a question.
        authorisation: what allows motion while nobody is there.
        now: time of the run; None: of the clock.

    Raises:
        InputError: never calibrated, no stored loop, or motion that nobody allowed.
        AgentError, DriverError: as in `calibrate`, with their exit codes.
    """
    now = now or datetime.now(UTC)
    past = last_accepted(recipe, logs, now)
    if early := too_early(past, recipe.recalibrate.every, now):
        return Outcome(None, {"schema": "recalibration/1", "skipped": early}, f"skipped: {early}")
    if warning := wrong_clock(past, now):
        console.warn(warning)
    with robot_lock(recipe.controller.driver, recipe.controller.address):
        reference = find_reference(recipe, logs, past)
        if authorisation is not None:
            authorisation.check_problem(reference.loop.key)
        facts = _facts(recipe, reference, authorisation)
        job = Job.start("recalibrate", recipe, console, logs, facts, yes, authorisation)
        job.announce()
        run = job.run
        with job.step("record"):
            recording = _record(job, reference)
        with job.step("estimate"):
            log, refitted, comparison = _estimate(job, reference)
        with job.step("validate"):
            prediction = predict_log(refitted.model, log)
            met = conditions(log, refitted.model, prediction) | temperatures(recording)
            result = _result(job, reference, recording, refitted, comparison, met)
            cut_short = _diagnose(job, reference, log, result)
            current = current_run(logs, recipe.robot.name, run.state["serial"])
            result["current_model"] = run.path.name if result["accepted"] else current
        with job.step("report"):
            write_analysis(run.file("analysis.mcap"), log, prediction)
            run.write_json("result.json", result)
            run.write_json("comparison.json", comparison.to_dict())
            page = recalibration_page(recipe, reference.loop.program, result, comparison, log, prediction, run.path)
            run.write_text("report.html", page)
            run.complete(result["accepted"])
        outcome, trend_warnings = _enter_into_history(job, result)
    for line in trend_warnings:
        console.warn(line)
    if cut_short is not None:
        raise cut_short
    return outcome


def _facts(recipe: Recipe, reference: Reference, authorisation: Authorisation | None) -> dict[str, Any]:
    """What the state of the run says of its question: the loop, what it is compared with, and the options."""
    compared = {"reference": reference.run, "program": reference.loop.checksum, "serial": reference.past.serial}
    options = [] if authorisation is None else ["--authorisation", str(authorisation.path)]
    return {**run_key(recipe), **compared, "options": options}


def _diagnose(job: Job, reference: Reference, log: Log, result: dict[str, Any]) -> BaseException | None:
    """Put a diagnosis into the result if the reference model predicts worse than before; returns what cut it short."""
    permitted = job.allowed is not None and job.allowed.document.new_motions is not None
    ask = partial(_with_further_motions, job, reference.model, log) if permitted else None
    worse = result["validation"]["worse_before"]
    result["diagnosis"], cut_short = diagnose_if_worse(reference.model, worse, [log], job.run, job.console, ask)
    return cut_short


def _enter_into_history(job: Job, result: dict[str, Any]) -> tuple[Outcome, list[str]]:
    """Register the run, make its model current if it was accepted, and say what the trends of the machine warn of."""
    run, logs = job.run, job.logs
    register_run(run, job.console)
    if result["accepted"]:
        apply_run(logs, run.path)
    runs = History(logs).runs(job.recipe.robot.name, run.state["serial"])
    trend_warnings = [line for machine in watch(runs) for line in machine.lines()]
    run.note(watch=trend_warnings)
    return job.end(result, recalibration_text(result, run.path)), trend_warnings


def recalibration_text(result: dict[str, Any], run: Path) -> str:
    """A few lines about a recalibration."""
    validation = result["validation"]
    keys = ("joints", "normalised_rmse", "rmse", "normalised_rmse_before", "rmse_before", "units")
    axes = [
        f"{name} {error_text(share, torque, unit)} (was {error_text(share_before, torque_before, unit)})"
        for name, share, torque, share_before, torque_before, unit in zip(*(validation[k] for k in keys), strict=True)
    ]
    rows = ["  ".join(axes[k : k + 3]) for k in range(0, len(axes), 3)]
    word = outcome_text(result["accepted"], result["reason"], result["gate"]["not_judged"], validation["joints"])
    lines = ["prediction error    " + f"\n{'':20}".join(rows), f"change              {result['comparison']}"]
    if result["diagnosis"]:
        lines.append(f"diagnosis           {result['diagnosis']['summary']}")
    lines += [f"compared with       {result['reference']}", f"result              {word}"]
    return "\n".join([*lines, f"report              {run}/report.html"])


def last_accepted(recipe: Recipe, logs: Path, now: datetime) -> PastRun:
    """The newest accepted run with the recipe's robot, tool, cell, sub-region and motion settings, up to now.

    Raises:
        InputError: there is none; what differs from the newest of this robot is named.
    """
    against = ""
    if logs.is_dir():
        history, key = History(logs), run_key(recipe)
        past = history.last_accepted(recipe.robot.name, key["loop"], key["controller"], now)
        if past is not None:
            return past
        others = [run for run in history.runs(recipe.robot.name) if run.accepted]
        against = _against(recipe, logs / others[-1].run) if others else ""
    raise InputError(
        f"{recipe.path}: no accepted calibration with this robot, tool, sub-region and motion settings in {logs}"
        f"{against}: run `agent calibrate {recipe.path}` first, with somebody watching"
    )


def _against(recipe: Recipe, run: Path) -> str:
    """What differs from an accepted run of a robot of this name, if that can be read."""
    try:
        then = approved_parts(run, read_json(run / "state.json"))
    except InputError:
        return ""
    return f"; against {run.name}: {differences(then, problem(recipe))}"


def find_reference(recipe: Recipe, logs: Path, past: PastRun) -> Reference:
    """The model and the loop that belong to an accepted run.

    Raises:
        InputError: the loop is not kept here, was changed, or does not lie in the recipe's sub-region; or no model.
    """
    loop = find_loop(recipe, program=past.program)
    if loop is None:
        raise InputError(
            f"{recipe.path}: {Path.cwd() / FOLDER} has no stored loop for this robot, tool, sub-region and motion "
            f"settings with the program that was accepted in {past.run} ({past.program[:12]}); call from the folder "
            "where it was calibrated, or calibrate again"
        )
    check_loop(recipe, loop)
    current = current_model(logs, past.robot, past.serial)
    if current is not None and current.run != past.run:
        loops = {run.run: run.loop for run in History(logs).runs()}
        if loops.get(current.run, "") == past.loop:
            return Reference(past, current.run, IdentifiedModel.load(current.model), loop)
    return Reference(past, past.run, IdentifiedModel.load(logs / past.run / "model.json"), loop)


def check_loop(recipe: Recipe, loop: StoredLoop) -> None:
    """Check move by move that a stored program is the one its genome gives in the recipe's sub-region.

    The number of cycles is the program's. Limits and the cell are checked later, from the arm's position.

    Raises:
        InputError: it was changed since it was stored, or is no loop for this recipe.
    """

    def moves(text: str) -> list[Move]:
        program = recipe.dialect.read(text, f"{loop.program_name}{recipe.dialect.suffix}", recipe.robot)
        return [statement for statement in program.run() if isinstance(statement, Move)]

    refused = f"the stored loop {loop.checksum[:12]} is not one that this recipe allows"
    advice = f"move it away from {FOLDER}, then calibrate again"
    try:
        own = Candidates(loop_problem(recipe, recipe.motion.speed)).loop(np.array(loop.genome))
    except InputError as error:
        raise InputError(f"{recipe.path}: {refused}: {error}; {advice}") from None
    motion = LoopMotion(recipe, loop.program_name, "excitation", own, recipe.motion.speed, 1)
    approach, *cycle = moves(motion.program)
    planned_moves = moves(loop.program)
    expected = chain([approach], chain.from_iterable(repeat(cycle)))
    for number, (move, wanted) in enumerate(zip(planned_moves, islice(expected, len(planned_moves)), strict=True)):
        if (what := _difference(move, wanted)) is not None:
            raise InputError(
                f"{recipe.path}: {refused}: {what} of its move {number + 1} (line {move.line} of its program) is not "
                f"the one that was searched for in motion.via_points; {advice}"
            )
    if len(planned_moves) < 1 + len(cycle) or (len(planned_moves) - 1) % len(cycle):
        raise InputError(f"{recipe.path}: {refused}: its program does not end where a cycle ends; {advice}")


def _difference(move: Move, wanted: Move) -> str | None:
    """Differences between two moves."""
    if (move.type, move.fly, move.via) != (wanted.type, wanted.fly, None):
        return "the kind"
    if move.settings != wanted.settings:
        return "a speed, frame or FLY setting"
    return None if _same_target(move.target, wanted.target) else "the target"


def _same_target(first: Target, other: Target) -> bool:
    if type(first) is not type(other) or getattr(first, "configuration", "") != getattr(other, "configuration", ""):
        return False
    first_values, second_values = (
        np.asarray(getattr(t, "pose", getattr(t, "position", None)), dtype=float) for t in (first, other)
    )
    return first_values.shape == second_values.shape and bool(np.all(np.abs(first_values - second_values) <= _SAME))


def _record(job: Job, reference: Reference) -> Recording:
    loop, known, suffix = reference.loop, reference.past.serial, job.recipe.dialect.suffix
    with open_link(job.recipe, job.console, job.yes, job.logs, job.allowed) as link:
        serial = link.identity.serial
        if known and known != serial:
            raise ControllerError(
                f"{link.address}: this machine has serial {serial}; the last accepted model is of {known}, another one "
                "of the same type. Calibrate this one first: `agent calibrate`"
            )
        job.run.note(serial=serial)
        if job.allowed is not None and (soon := job.allowed.ends_soon()):
            job.console.warn(soon)
        job.run.write_text(f"program{suffix}", loop.program)
        what, path = f"the stored loop {loop.checksum[:12]}", f"{loop.program_name}{suffix}"
        return job.record_program(link, loop.program, path, "excitation", EXCITATION, what)


def _with_further_motions(job: Job, model: IdentifiedModel, log: Log) -> tuple[dict[str, Any], BaseException | None]:
    """Diagnose with further motions, as far as the authorisation releases them; what cut them short, if anything."""

    def find(further: Sequence[Path]) -> DiagnosisRun:
        return DiagnosisRun(diagnose(model.robot, [log, *(read_log(path, model.robot) for path in further)], model))

    assert job.allowed is not None
    assert job.allowed.document.new_motions is not None
    rounds = until_sure(find, [], replace(job, yes=False), job.allowed.document.new_motions.duration)
    return {**rounds.last.result, **rounds.to_dict()}, rounds.cut_short


def _estimate(job: Job, reference: Reference) -> tuple[Log, Refit, Comparison]:
    recipe, run, what = job.recipe, job.run, job.recipe.recalibrate.parameters
    job.console.step("estimating friction again" if what == "friction" else "estimating all parameters again")
    (log,) = read_logs([run.file(EXCITATION)], recipe.robot, job.console)
    check_run(recipe.robot, [log], reference.model, job.console)
    refitted = refit(reference.model, [log], what, recipe.tool)
    refitted.model.save(run.file("model.json"))
    run.note(model_sha256=sha256_file(run.file("model.json")))
    return log, refitted, compare_models(reference.model, refitted.model, log, reference.run, run.path.name)


def _result(
    job: Job, reference: Reference, recording: Recording, refitted: Refit, comparison: Comparison, met: dict[str, Any]
) -> dict[str, Any]:
    """The document `recalibration/1`, with the gate's decision and the reason for a rejection."""
    recipe, loop = job.recipe, reference.loop
    faults = gate_faults(recipe.gate.normalised_rmse, reference.model, refitted, met, comparison)
    nominal = refitted.model.robot.nominal_torque
    moved = [change.name for change in comparison.parameters if change.moved]
    return {
        "schema": "recalibration/1",
        "robot": recipe.robot.name,
        "serial": job.run.state["serial"],
        "reference": reference.run,
        "parameters": recipe.recalibrate.parameters,
        "accepted": not faults,
        "reason": "; ".join(faults),
        "gate": gate_figures(recipe),
        "validation": {
            "joints": list(recipe.robot.joint_names),
            "units": list(torque_units(recipe.robot)),
            "rmse": refitted.held_out,
            "rmse_before": refitted.before,
            "normalised_rmse": refitted.held_out / nominal,
            "normalised_rmse_before": refitted.before / nominal,
            "worse_before": worse_joints(reference.model, refitted.before),
        },
        "comparison": (
            f"{len(moved)} of {len(comparison.parameters)} parameters moved by more than their uncertainty"
            + (f": {', '.join(moved)}" if moved else "")
        ),
        "loop": {"created": loop.created, "fitness": loop.fitness, "via_points": np.array(loop.poses)[:, :3, 3]},
        "conditions": met,
        **provenance_of(job.run, [recording]),
    }


def gate_faults(
    gate: float, last: IdentifiedModel, refitted: Refit, met: dict[str, Any], comparison: Comparison
) -> list[str]:
    """Reasons to reject a refitted model; none if it is accepted.

    Parameters
    ----------
    gate : largest normalised RMSE of any axis.
    last : the last accepted model; `comparison` is of it with the new one.
    met : the run's conditions, with the friction found.
    """
    robot = refitted.model.robot
    _, reason = gate_decision(gate, robot.joint_names, refitted.held_out / robot.nominal_torque, without_nominal(robot))
    faults = [reason] if reason else []
    for name in worse_joints(last, refitted.held_out):
        k = robot.joint_names.index(name)
        faults.append(
            f"{name}: held-out error {refitted.held_out[k]:.3g} N·m, {last.held_out_rmse[k]:.3g} N·m at the last "
            "accepted run: something has changed that these parameters do not describe"
        )
    for level in met["friction"]:
        if level["value"] + _SIGNIFICANT * level["standard_deviation"] < 0:
            faults.append(f"{level['joint']}: its friction at {level['speed']:.3g} rad/s comes out negative")
    inertial = set(last.names[: len(last.independent)])
    rigid = [change.name for change in comparison.parameters if change.moved and change.name in inertial]
    torque = comparison.torque
    far = (torque.rmse > gate * robot.nominal_torque) & (torque.rmse > _SIGNIFICANT * torque.standard_deviation)
    if rigid and np.any(far):
        names = ", ".join(np.array(robot.joint_names)[far])
        faults.append(
            f"{names}: links or payload ({', '.join(rigid[:4])}) differ from the last accepted model "
            "by more than the gate; links do not wear, look for another tool or load, then calibrate"
        )
    return faults
