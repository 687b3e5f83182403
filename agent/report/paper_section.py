"""The paper's own estimator beside the one that was used: same log, same unseen motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agent.core import InputError
from agent.report.page import Section, Table
from agent.robot import torque_units

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.recording import Log
    from agent.robot import Tool
    from agent.validation import Prediction


def paper_section(
    model: IdentifiedModel, log: Log, predictions: Sequence[Prediction], tool: Tool | None = None
) -> Section | None:
    """RMSE on moving samples by axis, of the model and of `method: paper` on its log; None where that is the model."""
    from agent.estimation import EstimationSettings, estimate
    from agent.validation import pooled_rmse

    if model.method == "paper":
        return None
    settings = EstimationSettings.create(cutoff=model.cutoff, method="paper", order=model.order)
    try:
        paper = estimate(model.robot, [log], settings, tool)
    except InputError as error:
        return Section("The paper's own estimator", (f"It cannot be fitted to this log: {error}.",))
    others = [prediction.by(paper) for prediction in predictions]
    ours, theirs = (pooled_rmse(several) for several in (predictions, others))
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
