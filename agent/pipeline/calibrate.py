"""The whole job, as in the paper's Fig. 2: plan, program, send, record, filter, estimate, validate, report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from agent.core import Console, counted, error_text, sha256_file
from agent.diagnosis import with_healthy_effects
from agent.estimation import EstimationSettings, estimate
from agent.link import answering
from agent.model import IdentifiedModel, judged_condition
from agent.pages import LogHealth
from agent.pipeline.checked_logs import check_one_machine, check_run, read_logs
from agent.pipeline.ending import current_run
from agent.pipeline.job import EXCITATION, Job, Outcome, validation_logs
from agent.pipeline.planning.plan import plan_once
from agent.pipeline.reports import against_last, calibration_page, typical_motion, write_analysis
from agent.pipeline.result import calibration_result, conditions, temperatures
from agent.recipe import Recipe
from agent.recording import read_log
from agent.robot import outcome_text
from agent.runs import RunFolder, check_approved, register_run, robot_lock, run_key
from agent.safety import check_period
from agent.validation import predict_log

#: Validation motions on which a doubt about the excitation has to be confirmed.
_CONFIRMING = 2


def run_calibration(recipe: Recipe, console: Console, logs: Path, resume: Path | None, yes: bool) -> Outcome:
    """Run the job; with `resume`, go on after the last finished step of a stopped run.

    Args:
        recipe: what is calibrated, and how.
        console: where progress is shown.
        logs: folder of runs.
        resume: run that is continued; None: a new one.
        yes: whether motion may begin without a question.

    Raises:
        AgentError, DriverError: with their exit codes; the run folder says where and why it stopped.
    """
    with robot_lock(recipe.controller.driver, recipe.controller.address):
        if resume is None:
            job = Job.start("calibrate", recipe, console, logs, run_key(recipe), yes)
        else:
            opened = RunFolder.open(resume, recipe.sha256, check=lambda run: check_approved(run, recipe))
            job = Job(recipe, opened, console, yes)
        job.announce()
        run = job.run
        with job.step("plan"):
            if run.finished("plan") is None:
                _ask_who_answers(job)
            plan = plan_once(recipe, run, console)
        with job.step("record"):
            recordings = job.record(plan)
        with job.step("estimate"):
            model = _estimate(job)
        with job.step("validate"):
            console.step("validating on unseen motions")
            unseen = read_logs(validation_logs(run.path), recipe.robot, console)
            check_one_machine(unseen, model, allow_mixed=False)
            predictions, health = [predict_log(model, log) for log in unseen], [LogHealth.of(log) for log in unseen]
            del unseen
        with job.step("report"):
            log = read_log(run.file(EXCITATION), recipe.robot)
            met = conditions(log, model) | temperatures(recordings[0])
            result = calibration_result(recipe, run, plan, recordings, model, predictions, met)
            result |= against_last(run, log, console)
            rejected = result["accepted"] is False
            current = current_run(job.logs, recipe.robot.name, run.state["serial"])
            result["current_model"] = current if rejected or current is not None else run.path.name
            run.write_json("result.json", result)
            typical = typical_motion(predictions)
            write_analysis(run.file("analysis.mcap"), read_log(run.file(typical.log), recipe.robot), typical)
            page = calibration_page(recipe, plan, result, predictions, health, log, run.path)
            run.write_text("report.html", page)
            run.complete(not rejected)
        register_run(run, console)
        return job.end(result, calibration_text(result, run.path))


def calibration_text(result: dict[str, Any], run: Path) -> str:
    """One screen about a calibration."""
    validation, gate = result["validation"], result["gate"]
    joints, not_judged = validation["joints"], gate["not_judged"]
    figures = zip(joints, *(validation[key] for key in ("normalised_rmse", "rmse", "units")), strict=True)
    axes = "  ".join(f"{name} {error_text(share, torque, unit)}" for name, share, torque, unit in figures)
    of = "RMSE" if len(not_judged) == len(joints) else "of nominal torque"
    outcome = outcome_text(result["accepted"] is not False, result["reason"], not_judged, joints)
    motions, limit = counted(validation["motions"], "unseen motion"), 100 * gate["normalised_rmse"]
    return "\n".join(
        [
            "",
            f"fitness             {result['search']['fitness']:.2f}  (log10 det(HᵀH/M), higher is better)",
            f"condition number    {judged_condition(result['estimation']['condition_number'])}",
            f"prediction error    {axes}",
            f"                    {of}, {motions} at {validation['speed']:g} m/s",
            f"result              {outcome}  (gate {limit:g} % of nominal torque on every axis)",
            f"report              {run / 'report.html'}",
        ]
    )


def _ask_who_answers(job: Job) -> None:
    """Ask the controller who it is before the search: a wrong address is reported at once, not minutes later."""
    recipe = job.recipe
    with answering(recipe) as (_, identity):
        if not identity.watch_only:
            check_period(identity, recipe.record.rate, recipe.controller.public_address)
    job.console.say(f"{identity.robot}, serial {identity.serial}, answers at {recipe.controller.public_address}")


def _estimate(job: Job) -> IdentifiedModel:
    recipe, run, console = job.recipe, job.run, job.console
    if run.finished("estimate"):
        run.check_file("model.json", run.state.get("model_sha256"))
        return IdentifiedModel.load(run.file("model.json"))
    console.step("estimating")
    logs = read_logs([run.file(EXCITATION)], recipe.robot, console)
    confirming = [read_log(path, recipe.robot) for path in validation_logs(run.path)[:_CONFIRMING]]
    check_run(recipe.robot, logs, None, console, confirming)
    settings = EstimationSettings.create(
        cutoff=recipe.estimate.filter.cutoff, method=recipe.estimate.method, order=recipe.estimate.filter.order
    )
    model = with_healthy_effects(estimate(recipe.robot, logs, settings, tool=recipe.tool), (), confirming)
    for warning in model.too_little_motion:
        console.warn(warning)
    model.save(run.file("model.json"))
    run.note(model_sha256=sha256_file(run.file("model.json")))
    return model
