"""Two runs side by side, from their folders."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from agent.core.console import Console
from agent.core.errors import InputError

if TYPE_CHECKING:
    from agent.validation.compare import Comparison


def compare_runs(before: Path, after: Path, console: Console) -> Comparison:
    """Compare the models of two run folders along the excitation that the later one recorded.

    Raises:
        InputError: a run without a model or a log, or of different robots.
    """
    from agent.estimation import IdentifiedModel
    from agent.pipeline.identify import read_logs
    from agent.validation.compare import compare_models

    for run in (before, after):
        if not (run / "model.json").is_file():
            raise InputError(
                f"{run}: this run has no model (a diagnosis, or stopped before its end); only calibrations and "
                "recalibrations can be compared"
            )
    models = [IdentifiedModel.load(run / "model.json") for run in (before, after)]
    if models[0].robot.joint_names != models[1].robot.joint_names or models[0].robot.name != models[1].robot.name:
        raise InputError(
            f"{before.name} is of {models[0].robot.name}, {after.name} of {models[1].robot.name}: there is nothing to "
            "compare between different robots"
        )
    log = next((run / "excitation.mcap" for run in (after, before) if (run / "excitation.mcap").exists()), None)
    if log is None:
        raise InputError(f"neither {before} nor {after} has its excitation.mcap any more: no motion to compare along")
    (motion,) = read_logs([log], models[1].robot, console)
    return compare_models(models[0], models[1], motion, before.name, after.name)
