"""Pages made from run folders, and the diagnosis of a model that predicts worse than it did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import AgentError, Console, InputError, write_atomically
from agent.diagnosis import diagnose
from agent.link import trajectories
from agent.model import IdentifiedModel, standstill_speed
from agent.pages import (
    About,
    LogHealth,
    RunContent,
    ShownLoop,
    calibration_report,
    diagnosis_summary,
    index_page,
    recalibration_report,
    torque_plot,
)
from agent.pipeline.ending import current_model_text, next_steps
from agent.pipeline.planning.plan import Plan
from agent.pipeline.planning.plan_files import shown_loop
from agent.recipe import Recipe
from agent.recording import FILTERED, PREDICTED, RESIDUAL, Log, write_log
from agent.runs import History, RunFolder, current_runs, last_accepted, parameter_trends, watch
from agent.validation import Comparison, Prediction, pooled_rmse, predict_log

#: A joint is worse if its error exceeds this multiple of that at the model's own calibration, plus this share of
#: nominal torque.
_WORSE, _TOLERANCE = 1.25, 1e-3
#: The multiple without a nominal torque: the model's own error scatters from run to run.
_WORSE_UNSCALED = 1.5
_ASKED = {
    "calibrate": "How well does a model from the arm's own motion predict its torque in the sub-region?",
    "recalibrate": "Is the model still true? If not, what changed?",
}


def worse_joints(model: IdentifiedModel, rmse: np.ndarray) -> list[str]:
    """Joints whose error (n,) [N·m] is above that of the model on its own data."""
    nominal, own = model.robot.nominal_torque, model.held_out_rmse
    limit = np.where(np.isnan(nominal), _WORSE_UNSCALED * own, _WORSE * own + _TOLERANCE * nominal)
    return [name for name, above in zip(model.robot.joint_names, rmse > limit, strict=True) if above]


def against_last(run: RunFolder, log: Log, console: Console) -> dict[str, Any]:
    """`reference` and `diagnosis` of a result: the last accepted run of the same loop, and why its model is worse."""
    last = last_accepted(run.path)
    try:
        before = None if last is None else IdentifiedModel.load(last / "model.json")
    except InputError as error:  # this run is complete without it
        console.warn(f"not compared with the last accepted run: {error}")
        before = None
    if last is None or before is None:
        return {"reference": "", "diagnosis": None}
    prediction = predict_log(before, log)
    worse = worse_joints(before, _rmse(prediction, slice(None)))
    return {"reference": last.name, "diagnosis": diagnose_if_worse(before, worse, [log], run, console)[0]}


def diagnose_if_worse(
    model: IdentifiedModel,
    worse: Sequence[str],
    logs: Sequence[Log],
    run: RunFolder,
    console: Console,
    ask: Callable[[], tuple[dict[str, Any], BaseException | None]] | None = None,
) -> tuple[dict[str, Any] | None, BaseException | None]:
    """Why the last accepted model predicts the joints `worse` worse than it did; None where there are none.

    Parameters
    ----------
    ask : the result of a diagnosis with further motions, and what cut these short; None: that of the `logs`.

    Returns
    -------
    `summary`, a sentence or two, and `result`, as in docs/diagnosis.md (None where it could not be diagnosed), which
    the run folder gets as `diagnosis.json`; and what cut the further motions short.
    """
    if not worse:
        return None, None
    opening = f"The last model predicts {', '.join(worse)} worse than it did."
    console.step(f"{opening} Diagnosing")
    try:
        diagnosis, cut_short = (diagnose(model.robot, logs, model).result, None) if ask is None else ask()
    except AgentError as error:
        return {"summary": f"{opening} It could not be diagnosed: {error}", "result": None}, None
    run.write_json("diagnosis.json", diagnosis)
    return {"summary": f"{opening} {diagnosis_summary(diagnosis)}", "result": diagnosis}, cut_short


def about_run(kind: str, recipe: Recipe, result: dict[str, Any], run: Path) -> About:
    """First screen of the page of a calibration or recalibration, from the content of its `result.json`."""
    accepted, current, provenance = result["accepted"] is not False, result["current_model"], result["provenance"]
    steps = next_steps(kind, accepted, run, recipe, recipe.path.resolve(), current)
    identity = [
        ("robot", result["robot"]),
        ("serial", result["serial"] or "not reported"),
        ("tool", "none" if recipe.tool is None else recipe.tool.text()),
        ("controller", f"{recipe.controller.driver} {recipe.controller.public_address}"),
        ("date", provenance["started"].replace("T", " ").removesuffix("+00:00")[:16] + " UTC"),
        ("run", run.name),
        ("current model", current_model_text(current, run.name)),
        ("program", f"calibration-agent {provenance.get('version of calibration-agent', '')}".strip()),
    ]
    return About(asked=_ASKED[kind], next=steps, identity=identity)


def calibration_page(
    recipe: Recipe,
    plan: Plan,
    result: dict[str, Any],
    predictions: Sequence[Prediction],
    health: Sequence[LogHealth],
    log: Log,
    run: Path,
) -> str:
    """HTML of the report of a calibration in its folder; `health` is that of the validation logs."""
    prediction = predict_log(predictions[0].model, log.middle_part())
    return calibration_report(
        RunContent(
            run=run,
            result=result,
            about=about_run("calibrate", recipe, result, run),
            predictions=predictions,
            health=health,
            excitation=log,
            loop=_coloured(shown_loop(recipe, plan.excitation), log, prediction),
            rmse=np.array([p.rmse(moving=True) for p in predictions]),
            shown=torque_plot(typical_motion(predictions), pooled_rmse(predictions)),
            search=plan.search,
            validation_paths=np.array([_thinned(motion.loop.trajectory.tcp) for motion in plan.validation]),
        )
    )


def _thinned(poses: np.ndarray, points: int = 120) -> np.ndarray:
    """(points, 3) positions of poses (S, 4, 4), evenly chosen."""
    return poses[np.linspace(0, len(poses) - 1, points).round().astype(int), :3, 3]


def typical_motion(predictions: Sequence[Prediction]) -> Prediction:
    """The motion of median error, for the plot."""
    rmse = np.array([p.rmse(moving=True) for p in predictions])
    nominal = predictions[0].model.robot.nominal_torque
    usual = np.maximum(np.nanmedian(rmse, axis=0), 1e-300)
    worst = np.nanmax(rmse / np.where(np.isfinite(nominal), nominal, usual), axis=1)
    return predictions[int(np.argsort(worst)[len(worst) // 2])]


def recalibration_page(
    recipe: Recipe,
    program: str,
    result: dict[str, Any],
    comparison: Comparison,
    log: Log,
    prediction: Prediction,
    run: Path,
) -> str:
    """HTML of a recalibration's report; `program` is the text of the loop, `prediction` is of its `log` in `run`."""
    statements = recipe.dialect.read(program, "program", recipe.robot).run()
    *_, (_, cycle) = trajectories(recipe, statements, log.position[0])
    loop = ShownLoop(recipe, cycle, np.array(result["loop"]["via_points"]), len(log.cycle_starts))
    ends = [*log.cycle_starts, float(log.t[-1])] if log.cycle_starts else [0.0, float(log.t[-1])]
    cycles = [slice(*np.searchsorted(prediction.time, pair)) for pair in pairwise(ends)]
    # confidence bounds need a regressor for every sample, so they are computed for the cycle that is shown
    cycle_prediction = predict_log(prediction.model, log.middle_part())
    content = RunContent(
        run=run,
        result=result,
        about=about_run("recalibrate", recipe, result, run),
        predictions=[prediction],
        health=[LogHealth.of(log)],
        excitation=log,
        loop=_coloured(loop, log, prediction),
        rmse=np.array([_rmse(prediction, part) for part in cycles if _moves(prediction)[part].any()]),
        shown=torque_plot(cycle_prediction, prediction.rmse(moving=True), *log.middle_cycle()),
    )
    return recalibration_report(content, comparison)


def _coloured(loop: ShownLoop, log: Log, prediction: Prediction) -> ShownLoop:
    """With the error of the worst joint at each time of a cycle, in % of nominal torque if all joints have one."""
    start, stop = log.middle_cycle()
    nominal = prediction.model.robot.nominal_torque
    shares = bool(np.isfinite(nominal).all())
    worst = np.abs(100 * prediction.error / nominal if shares else prediction.error).max(axis=1)
    inside = (prediction.time >= start) & (prediction.time <= stop)
    time = np.linspace(0.0, loop.duration, len(loop.cycle.t))
    error = np.interp(time, prediction.time[inside] - start, worst[inside])
    return replace(loop, left=error, left_unit="% of nominal torque" if shares else "N·m")


def write_analysis(path: Path, log: Log, prediction: Prediction) -> None:
    """Write a log with its prediction as further topics; an existing file is replaced.

    /joint_states is as measured. /filtered_joint_states, /predicted_joint_states and /residual_joint_states have the
    torque that the model is judged by: filtered alike, edges dropped, on the stamps of the measurement.

    Raises:
        RecordingError: the file cannot be written.
    """
    position = np.stack([np.interp(prediction.time, log.t, q) for q in log.position.T], axis=1)
    torques = {FILTERED: prediction.measured, PREDICTED: prediction.predicted, RESIDUAL: prediction.error}
    states = {topic: (prediction.time, position, prediction.velocity, torque) for topic, torque in torques.items()}
    write_log(path, replace(log, reference_position=None, planned_position=None), states)


def write_index(logs: Path, robot: str | None = None, serial: str | None = None) -> Path:
    """Write `index.html` over all runs of a folder, or of one robot in it; returns its path.

    Args:
        logs: folder of runs.
        robot: name of the only one that is shown.
        serial: of the only machine that is shown.

    Raises:
        InputError: there is no such folder, or nothing in it.
    """
    history = History(logs)
    runs = history.runs(robot, serial)
    if not runs:
        raise InputError(f"{logs}: {history.why_none(robot, serial)}")
    watched = watch(runs)
    parameters = history.parameters({figures.run for machine in watched for figures in machine.figures})
    courses = [parameter_trends(machine.figures, parameters) for machine in watched]
    return write_atomically(logs / "index.html", index_page(runs, watched, courses, current_runs(logs)[0]))


def refresh_index(logs: Path, console: Console) -> None:
    """Write the page over all runs after a run; a failure is a warning only."""
    try:
        write_index(logs)
    except AgentError as error:  # the run itself is complete, and `agent report --index` makes the page again
        console.warn(str(error))


def _moves(prediction: Prediction) -> np.ndarray:
    """(S, n) whether each joint itself moves."""
    slowest = standstill_speed([prediction.velocity], prediction.model.robot.max_velocity)
    return np.abs(prediction.velocity) > slowest


def _rmse(prediction: Prediction, part: slice) -> np.ndarray:
    """(n,) RMSE [N·m] over the samples of a part in which each joint moves."""
    moving = _moves(prediction)[part]
    return np.sqrt(np.sum(prediction.error[part] ** 2 * moving, axis=0) / np.maximum(1, moving.sum(axis=0)))
