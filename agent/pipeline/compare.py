"""Runs side by side, from their folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from agent.core import Console, InputError

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.recording import Log
    from agent.validation import Comparison


def compare_runs(runs: Sequence[Path], console: Console, report: Path | None = None) -> list[Comparison]:
    """Compare the models of later run folders with that of the first, along the excitation that the last one recorded.

    Writes a page to `report` where that is given.

    Raises:
        InputError: a run without a model or a log, or of different robots.
    """
    from agent.validation import compare_models, predict_log

    models = _models(runs)
    motion = _motion(runs, models[-1], console)
    found = [
        compare_models(models[0], model, motion, runs[0].name, run.name)
        for run, model in zip(runs[1:], models[1:], strict=True)
    ]
    if report is not None:
        from agent.core import write_atomically
        from agent.report import comparison_page

        by_name = {run.name: model for run, model in zip(runs, models, strict=True)}
        predictions = [predict_log(model, motion) for model in models]
        write_atomically(report, comparison_page(by_name, found, predictions))
    return found


def _models(runs: Sequence[Path]) -> list[IdentifiedModel]:
    from agent.model import IdentifiedModel

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


def _motion(runs: Sequence[Path], model: IdentifiedModel, console: Console) -> Log:
    from agent.pipeline.identify import read_logs

    log = next((run / "excitation.mcap" for run in reversed(runs) if (run / "excitation.mcap").exists()), None)
    if log is None:
        which = f"neither {runs[0]} nor {runs[1]} has its" if len(runs) == 2 else "none of these runs has its"
        raise InputError(f"{which} excitation.mcap any more: no motion to compare along")
    (motion,) = read_logs([log], model.robot, console)
    return motion
