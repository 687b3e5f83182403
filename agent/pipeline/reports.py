"""Reports from what lies in run folders: further sections of a new one, the page over all runs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import AgentError, Console, InputError, write_atomically
from agent.pipeline.drift_check import diagnose_if_worse, joint_moves, moving_rmse, worse_joints
from agent.recipe import Recipe
from agent.runs import History, RunFolder, current_runs, last_accepted

if TYPE_CHECKING:
    from agent.recording import Log
    from agent.report import Plot
    from agent.validation import Comparison, Prediction


def against_last(run: RunFolder, log: Log, console: Console) -> dict[str, Any]:
    """The last accepted run of the same loop, and why its model predicts a fresh log worse than it did, if it does."""
    from agent.model import IdentifiedModel
    from agent.validation import predict_log

    last = last_accepted(run.path)
    if last is None:
        return {"reference": "", "diagnosis": None}
    before = IdentifiedModel.load(last / "model.json")
    worse = worse_joints(before, moving_rmse(predict_log(before, log)))
    return {"reference": last.name, "diagnosis": diagnose_if_worse(before, worse, log, run, console)}


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
    from agent.link import plan_statements
    from agent.pipeline.first_screen import about_run
    from agent.pipeline.plan import left_over, motion_data
    from agent.report import (
        LogHealth,
        RunData,
        comparison_section,
        friction_section,
        log_section,
        observation_section,
        recalibration_report,
        residual_section,
    )

    model = prediction.model
    *_, cycle = plan_statements(recipe, program, "program", log.position[0])[1]
    via_points = np.array(result["loop"]["via_points"])
    motion = motion_data(recipe, cycle, via_points, len(log.cycle_starts))
    return recalibration_report(
        RunData(
            result=result,
            about=about_run("recalibrate", recipe, result, run),
            motion=left_over(motion, log, prediction),
            parameter_rows=model.rows(),
            rmse=_cycle_errors(log, prediction),
            nominal=model.robot.nominal_torque,
            prediction=_shown_cycle(log, prediction),
            further=(
                comparison_section(comparison),
                residual_section([prediction]),
                friction_section([prediction]),
                observation_section(model, log),
                log_section([LogHealth.of(log)]),
            ),
        )
    )


def write_index(logs: Path, robot: str | None = None, serial: str | None = None) -> Path:
    """Write `index.html` over all runs of a folder, or of one robot in it; returns its path.

    Raises:
        InputError: there is no such folder, or nothing in it.
    """
    from agent.report import IndexData, index_page
    from agent.runs import parameter_trends, watch

    history = History(logs)
    runs = history.runs(robot, serial)
    if not runs:
        raise InputError(f"{logs}: {history.why_none(robot, serial)}")
    watched = watch(runs)
    latest = {run for one in watched for trend in one.trends[:1] for run in trend.runs}
    parameters = history.parameters(latest)
    by_name = {run.run: run for run in runs}
    courses = [
        parameter_trends([by_name[name] for name in one.trends[0].runs], parameters) if one.trends else []
        for one in watched
    ]
    return write_atomically(logs / "index.html", index_page(IndexData(runs, watched, courses, current_runs(logs)[0])))


def refresh_index(logs: Path, console: Console) -> None:
    """The page over all runs, as a run that has just ended leaves it; a failure is a warning, and no more."""
    try:
        write_index(logs)
    except AgentError as error:  # the run itself is complete, and `agent report --index` makes the page again
        console.warn(str(error))


def watch_lines(logs: Path, robot: str, serial: str) -> list[str]:
    """Alarms and warnings of one machine's history, a sentence each."""
    from agent.runs import watch

    return [line for one in watch(History(logs).runs(robot, serial)) for line in one.lines()]


def _cycle_errors(log: Log, prediction: Prediction) -> np.ndarray:
    """(cycles, n) RMSE [N·m] of a cycle, while the joint moves; of the whole log where none repeats."""
    moving = joint_moves(prediction)
    ends = [*log.cycle_starts, float(log.t[-1])] if log.cycle_starts else [0.0, float(log.t[-1])]
    rows = []
    for start, stop in pairwise(ends):
        inside = slice(*np.searchsorted(prediction.time, (start, stop)))
        energy = np.sum(prediction.error[inside] ** 2 * moving[inside], axis=0)
        if moving[inside].any():
            rows.append(np.sqrt(energy / np.maximum(1, moving[inside].sum(axis=0))))
    return np.array(rows)


def _shown_cycle(log: Log, prediction: Prediction) -> Plot:
    """What one cycle shows, few enough samples to be drawn."""
    from agent.report import torque_plot
    from agent.validation import predict_log

    # bounds cost a regressor for every sample, so they are made for these alone
    part = predict_log(prediction.model, log.middle_part())
    return torque_plot(part, prediction.rmse(moving=True), *log.middle_cycle())
