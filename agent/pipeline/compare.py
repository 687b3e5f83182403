"""Comparison of the models of several runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from agent.core import Console, InputError, write_atomically
from agent.model import IdentifiedModel
from agent.pages import comparison_page
from agent.pipeline.checked_logs import read_logs
from agent.pipeline.job import EXCITATION
from agent.runs import check_output
from agent.validation import Comparison, compare_models, predict_log


def compare_runs(runs: Sequence[Path], console: Console, report: Path | None = None) -> list[Comparison]:
    """Compare the models of later run folders with the first, along the excitation that the last one recorded.

    Writes a page to `report` where that is given.

    Args:
        runs: folders, the one that others are compared with first.
        console: where progress is shown.
        report: page to write.

    Raises:
        InputError: a run without a model or a log, runs of different robots, or a page that cannot be written there.
    """
    models = _models(runs)
    if report is not None:
        check_output(report, ())
    log = next((run / EXCITATION for run in reversed(runs) if (run / EXCITATION).exists()), None)
    if log is None:
        which = f"neither {runs[0]} nor {runs[1]} has its" if len(runs) == 2 else "none of these runs has its"
        raise InputError(f"{which} excitation.mcap any more: no motion to compare along")
    (motion,) = read_logs([log], models[-1].robot, console)
    inputs = [
        compare_models(models[0], model, motion, runs[0].name, run.name)
        for run, model in zip(runs[1:], models[1:], strict=True)
    ]
    if report is not None:
        by_name = {run.name: model for run, model in zip(runs, models, strict=True)}
        write_atomically(report, comparison_page(by_name, inputs, [predict_log(model, motion) for model in models]))
    return inputs


def _models(runs: Sequence[Path]) -> list[IdentifiedModel]:
    if len({run.name for run in runs}) < len(runs):
        raise InputError("compare: a run is named twice; name two runs or more, each once")
    for run in runs:
        if not (run / "model.json").is_file():
            raise InputError(
                f"{run}: this run has no model (a diagnosis, or stopped before its end); only calibrations and "
                "recalibrations can be compared"
            )
    models = [IdentifiedModel.load(run / "model.json") for run in runs]
    first = models[0].robot
    for run, model in zip(runs, models, strict=True):
        if model.robot.joint_names != first.joint_names or model.robot.name != first.name:
            raise InputError(
                f"{runs[0].name} is of {first.name}, {run.name} of {model.robot.name}: there is nothing to compare "
                "between different robots"
            )
    return models
