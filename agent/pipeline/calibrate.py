"""The whole job, as in the paper's Fig. 2: plan, program, send, record, filter, estimate, validate, report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from agent.core import AgentError, Console, counted, error_text, sha256_file
from agent.link import Recording, answering
from agent.pipeline import planning
from agent.pipeline.ending import current_run, ending_text, going_on
from agent.pipeline.record_plan import EXCITATION, record_plan, validation_logs
from agent.pipeline.reports import refresh_index
from agent.pipeline.result import CalibrationResult, build_result, provenance, run_data, typical_motion
from agent.recipe import Recipe
from agent.robot import not_judged_text, outcome_text
from agent.runs import RunFolder, approve, check_approved, register_run, robot_lock, run_key
from agent.safety import check_period

#: Validation motions that a doubt about the excitation alone has to stand up to.
_BESIDE = 2


@dataclass(frozen=True)
class CalibrationOutcome:
    """Run folder, the content of its `result.json`, and what comes next."""

    run: Path
    result: CalibrationResult
    ending: str = ""

    @property
    def accepted(self) -> bool:
        """Whether no gate rejected the model: one that can judge no joint rejects none."""
        return self.result.accepted is not False

    def summary(self) -> str:
        """One screen."""
        from agent.model import judged_condition

        result, validation = self.result, self.result.validation
        axes = "  ".join(
            f"{name} {error_text(share, torque, unit)}"
            for name, share, torque, unit in zip(
                validation.joints,
                validation.normalised_rmse,
                validation.rmse,
                validation.units,
                strict=True,
            )
        )
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
            plan = planning.plan_once(recipe, run, console)
        with step(run, "record", console):
            recordings = record_plan(recipe, plan, run, console, logs, yes)
        with step(run, "estimate", console):
            model = _estimate(recipe, run, console)
        with step(run, "validate", console):
            validation, health = _validate(recipe, run, model, console)
        with step(run, "report", console):
            outcome = _report(recipe, plan, run, recordings, model, validation, health, console)
        register_run(run, console)
        refresh_index(run.path.parent, console)
        return replace(outcome, ending=ending_text(run, recipe))


def _greet(recipe: Recipe, console: Console) -> None:
    """Ask the controller who it is before the search: a wrong address is reported at once, not minutes later."""
    with answering(recipe) as (_, identity):
        if not identity.watch_only:
            check_period(identity, recipe.record.rate, recipe.controller.place)
    console.say(f"{identity.robot}, serial {identity.serial}, answers at {recipe.controller.place}")


def _estimate(recipe: Recipe, run: RunFolder, console: Console) -> Any:
    from agent.diagnosis import with_healthy_effects
    from agent.estimation import EstimationSettings, estimate
    from agent.model import IdentifiedModel
    from agent.pipeline.identify import check_run, read_logs
    from agent.recording import read_log

    if run.finished("estimate"):
        run.check_file("model.json", run.state.get("model_sha256"))
        return IdentifiedModel.load(run.file("model.json"))
    console.step("estimating")
    logs = read_logs([run.file(EXCITATION)], recipe.robot, console)
    beside = [read_log(path, recipe.robot) for path in validation_logs(run)[:_BESIDE]]
    check_run(recipe.robot, logs, None, console, beside)
    model = estimate(
        recipe.robot,
        logs,
        EstimationSettings.create(
            cutoff=recipe.estimate.filter.cutoff, method=recipe.estimate.method, order=recipe.estimate.filter.order
        ),
        tool=recipe.tool,
    )
    model = with_healthy_effects(model, (), beside)
    model.save(run.file("model.json"))
    run.note(model_sha256=sha256_file(run.file("model.json")))
    return model


def _validate(recipe: Recipe, run: RunFolder, model: Any, console: Console) -> tuple[list[Any], list[Any]]:
    from agent.pipeline.identify import check_one_machine, read_logs
    from agent.report import LogHealth
    from agent.validation import predict_log

    console.step("validating on unseen motions")
    logs = read_logs(validation_logs(run), recipe.robot, console)
    check_one_machine(logs, model, allow_mixed=False)
    return [predict_log(model, log) for log in logs], [LogHealth.of(log) for log in logs]


def _report(
    recipe: Recipe,
    plan: planning.Plan,
    run: RunFolder,
    recordings: list[Recording],
    model: Any,
    predictions: list[Any],
    health: list[Any],
    console: Console,
) -> CalibrationOutcome:
    from agent.pipeline.analysis_log import write_analysis
    from agent.pipeline.conditions import conditions
    from agent.pipeline.reports import against_last
    from agent.recording import read_log
    from agent.report import RunContent, further_sections, run_report
    from agent.validation import predict_log

    sources = provenance(run.path, run.state, [run.file(EXCITATION), *validation_logs(run)])
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
    further = further_sections(RunContent(run.path, recipe, model, predictions, health))
    shown = run_data(recipe, plan, result.to_dict(), model, predictions, further, run.path)
    run.write_text("report.html", run_report(shown))
    run.complete(not result.rejected)
    return CalibrationOutcome(run.path, result)


@contextmanager
def step(run: RunFolder, name: str, console: Console) -> Iterator[None]:
    """Whatever ends the run inside is noted in the run folder, and reported with how to go on.

    A step that an earlier start finished stays as it is.
    """
    try:
        yield
    except BaseException as error:
        try:
            run.stopped(name, str(error) or type(error).__name__)
        except AgentError as unsaved:  # a full disk: what ended the run is still what is said last
            console.warn(f"that it was stopped could not be noted: {unsaved}")
        console.warn(going_on(run, name, error))
        raise
    if run.finished(name) is None:
        run.finish(name)
