"""The paper's own estimator next to the one that a run used."""

from __future__ import annotations

from collections.abc import Sequence

from agent.core import InputError
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.pages.elements import Section, Table
from agent.recording import Log
from agent.robot import Tool, torque_units
from agent.validation import Prediction, pooled_rmse


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
