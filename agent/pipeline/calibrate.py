"""The whole job, as in the paper's Fig. 2: plan, program, send, record, filter, estimate, validate, report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from agent.core import Console, counted, error_text, sha256_file
from agent.diagnosis import with_healthy_effects
from agent.estimation import EstimationSettings, estimate
from agent.link import Recording, answering
from agent.model import IdentifiedModel, judged_condition
from agent.pipeline.ending import current_run, ending_text, step
from agent.pipeline.identify import check_one_machine, check_run, read_logs
from agent.pipeline.plan import Plan, plan_once
from agent.pipeline.record_plan import EXCITATION, record_plan, validation_logs
from agent.pipeline.reports import against_last, refresh_index, write_analysis
from agent.pipeline.result import (
    CalibrationResult,
    build_result,
    calibration_page,
    conditions,
    provenance,
    typical_motion,
)
from agent.recipe import Recipe
from agent.recording import read_log
from agent.report import LogHealth
from agent.robot import not_judged_text, outcome_text
from agent.runs import RunFolder, approve, check_approved, register_run, robot_lock, run_key
from agent.safety import check_period
from agent.validation import Prediction, predict_log

#: Validation motions on which a doubt about the excitation has to be confirmed.
_CONFIRMING = 2


@dataclass(frozen=True)
class CalibrationOutcome:
    """Run folder, the content of its `result.json`, and what comes next."""

    run: Path
    result: CalibrationResult
    ending: str = ""

    @property
    def accepted(self) -> bool:
        """Whether no gate rejected the model; a gate that can judge no joint rejects none."""
        return self.result.accepted is not False

    def summary(self) -> str:
        """One screen."""
        result, validation = self.result, self.result.validation
        errors = zip(validation.joints, validation.normalised_rmse, validation.rmse, validation.units, strict=True)
        axes = "  ".join(f"{name} {error_text(share, torque, unit)}" for name, share, torque, unit in errors)
        not_judged = result.gate.not_judged
        of = "RMSE" if len(not_judged) == len(validation.joints) else "of nominal torque"
        return "\n".join(
            [
                "",
                f"fitness             {result.search.fitness:.2f}  (log10 det(HᵀH/M), higher is better)",
                f"condition number    {judged_condition(result.estimation.condition_number)}",
                f"prediction error    {axes}",
                f"                    {of}, {counted(validation.motions, 'unseen motion')} at {validation.speed:g} m/s",
                "result              "
                + outcome_text(self.accepted, result.reason, not_judged, validation.joints)
                + f"  (gate {100 * result.gate.normalised_rmse:g} % of nominal torque on every axis)",
                f"report              {self.run / 'report.html'}",
                self.ending,
                "",
            ]
        )


def run_calibration(recipe: Recipe, console: Console, logs: Path, resume: Path | None, yes: bool) -> CalibrationOutcome:
    """Run the job; with `resume`, go on after the last finished step of a stopped run.

    Raises:
        AgentError, DriverError: with their exit codes; the run folder says where and why it stopped.
    """
    with robot_lock(recipe.controller.driver, recipe.controller.address):
        if resume is None:
            run = RunFolder.create(logs, recipe.robot.name, recipe.path)
            run.note(kind="calibrate", **run_key(recipe))
            approve(run, recipe)
        else:
            run = RunFolder.open(resume, recipe.sha256, check=lambda opened: check_approved(opened, recipe))
        console.say(f"run {run.path}")
        if not_judged := not_judged_text(recipe.robot, recipe.gate.normalised_rmse):
            console.warn(not_judged)

        with step(run, "plan", console):
            if run.finished("plan") is None:
                _greet(recipe, console)
            plan = plan_once(recipe, run, console)
        with step(run, "record", console):
            recordings = record_plan(recipe, plan, run, console, logs, yes)
        with step(run, "estimate", console):
            model = _estimate(recipe, run, console)
        with step(run, "validate", console):
            console.step("validating on unseen motions")
            unseen = read_logs(validation_logs(run.path), recipe.robot, console)
            check_one_machine(unseen, model, allow_mixed=False)
            predictions, health = [predict_log(model, log) for log in unseen], [LogHealth.of(log) for log in unseen]
            del unseen
        with step(run, "report", console):
            result = _report(recipe, plan, run, recordings, model, predictions, health, console)
        register_run(run, console)
        refresh_index(run.path.parent, console)
        return CalibrationOutcome(run.path, result, ending_text(run, recipe))


def _greet(recipe: Recipe, console: Console) -> None:
    """Ask the controller who it is before the search: a wrong address is reported at once, not minutes later."""
    with answering(recipe) as (_, identity):
        if not identity.watch_only:
            check_period(identity, recipe.record.rate, recipe.controller.place)
    console.say(f"{identity.robot}, serial {identity.serial}, answers at {recipe.controller.place}")


def _estimate(recipe: Recipe, run: RunFolder, console: Console) -> IdentifiedModel:
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
    model.save(run.file("model.json"))
    run.note(model_sha256=sha256_file(run.file("model.json")))
    return model


def _report(
    recipe: Recipe,
    plan: Plan,
    run: RunFolder,
    recordings: list[Recording],
    model: IdentifiedModel,
    predictions: list[Prediction],
    health: list[LogHealth],
    console: Console,
) -> CalibrationResult:
    sources = provenance(run.path, run.state, [run.file(EXCITATION), *validation_logs(run.path)])
    log = read_log(run.file(EXCITATION), recipe.robot)
    result = build_result(
        recipe,
        plan,
        recordings,
        model,
        predictions,
        provenance=sources,
        serial=run.state["serial"],
        conditions=conditions(log, predict_log(model, log), recordings[0]),
        **against_last(run, log, console),
    )
    current = current_run(run.path.parent, recipe.robot.name, result.serial)
    result = replace(result, current_model=current if result.rejected or current is not None else run.path.name)
    run.write_json("result.json", result.to_dict())
    typical = typical_motion(predictions)
    write_analysis(run.file("analysis.mcap"), read_log(run.file(typical.log), recipe.robot), typical)
    page = calibration_page(recipe, plan, result.to_dict(), model, predictions, health, run.path)
    run.write_text("report.html", page)
    run.complete(not result.rejected)
    return result
