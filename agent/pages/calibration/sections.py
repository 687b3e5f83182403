"""The sections of a run's report beyond its verdict, each made from the run's files by one function.

A new section is a module with such a function, and its line in `RUN_SECTIONS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.pages.calibration.comparison import comparison_section
from agent.pages.calibration.friction import friction_section
from agent.pages.calibration.loop import ShownLoop
from agent.pages.calibration.parameters import correlation_section, observation_section
from agent.pages.calibration.recordings import LogHealth, log_section
from agent.pages.calibration.residuals import residual_section
from agent.pages.page import About, Section, Table
from agent.pages.plots import Plot
from agent.recipe import Recipe
from agent.recording import Log
from agent.robot import Tool, torque_units
from agent.runs import last_accepted
from agent.validation import Prediction, compare_models, pooled_rmse


@dataclass(frozen=True, eq=False)
class RunContent:
    """What the page of a run and its sections are made from.

    Attributes
    ----------
    run, recipe, model : run folder, recipe and identified model.
    predictions, health : of the motions that the model is judged on, and of their logs.
    excitation : the log that the model was fitted to.
    result, about : content of `result.json`, and the first screen.
    loop : the loop that was run.
    rmse : (motions or cycles, n) [N·m] on moving samples.
    shown : torque of one motion.
    search, validation_paths : of a calibration: how the loop was found, and (motions, k, 3) [m] of the TCP.
    """

    run: Path
    recipe: Recipe
    model: IdentifiedModel
    predictions: Sequence[Prediction]
    health: Sequence[LogHealth]
    excitation: Log
    result: dict[str, Any]
    about: About
    loop: ShownLoop
    rmse: np.ndarray
    shown: Plot
    search: Mapping[str, Any] = field(default_factory=dict)
    validation_paths: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 3)))


def _comparison(content: RunContent) -> Section | None:
    """Against the last accepted run of the same machine and loop, if there is one."""
    last = last_accepted(content.run)
    if last is None:
        return None
    before = IdentifiedModel.load(last / "model.json")
    return comparison_section(compare_models(before, content.model, content.excitation, last.name, content.run.name))


def paper_section(
    model: IdentifiedModel, log: Log, predictions: Sequence[Prediction], tool: Tool | None = None
) -> Section | None:
    """RMSE on moving samples by axis, of the model and of `method: paper` on its log; None where that is the model."""
    if model.method == "paper":
        return None
    settings = EstimationSettings.create(cutoff=model.cutoff, method="paper", order=model.order)
    try:
        paper = estimate(model.robot, [log], settings, tool)
    except InputError as error:
        return Section("The paper's own estimator", (f"It cannot be fitted to this log: {error}.",))
    ours, theirs = pooled_rmse(predictions), pooled_rmse([prediction.by(paper) for prediction in predictions])
    rows = [
        (name, f"{a:.3g}", f"{b:.3g}", unit, f"{b / a:.2f}" if a > 0 else "-")
        for name, a, b, unit in zip(model.robot.joint_names, ours, theirs, torque_units(model.robot), strict=True)
    ]
    header = ("axis", f"RMSE, {model.method}", "RMSE, paper", "unit", "paper over this")
    text = (
        "Coulomb, viscous and quadratic friction, weights of its eq. 4 and no prior, fitted to the same log with the "
        "same filter; moving samples of the same unseen motions.",
    )
    return Section("The paper's own estimator", text, (Table("paper", header, rows),))


#: In the order of the page; a function returns None where there is nothing to show.
RUN_SECTIONS: list[Callable[[RunContent], Section | None]] = [
    lambda content: residual_section(content.predictions),
    lambda content: friction_section(content.predictions),
    _comparison,
    lambda content: observation_section(content.model, content.excitation),
    lambda content: correlation_section(content.model),
    lambda content: paper_section(content.model, content.excitation, content.predictions, content.recipe.tool),
    lambda content: log_section([LogHealth.of(content.excitation), *content.health]),
]


def further_sections(content: RunContent) -> list[Section]:
    """All that apply to a run."""
    return [section for make in RUN_SECTIONS if (section := make(content)) is not None]
