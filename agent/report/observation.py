"""Health of the observation matrix: how well the motion shows the parameters, and what it cannot show."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.core import counted
from agent.model import USUAL_CONDITION
from agent.report.page import Section, Table
from agent.report.plots import Panel, Plot, Series

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.recording import Log
    from agent.validation import Observability


def observation_section(model: IdentifiedModel, log: Log) -> Section:
    """What a model's own motion shows of its parameters: condition number of the fit, singular values, the directions
    seen least, and what is not identifiable."""
    from agent.model import judged_condition
    from agent.validation import observability

    found, condition_number = observability(model, log), judged_condition(model.condition_number)
    text = [
        f"{found.parameters} parameters. Condition number {condition_number}.",
        "It is that of the weighted observation matrix that the model was estimated from, columns scaled to unit "
        "length. Singular values and directions are those along one cycle, rows weighted by the residuals.",
        _unidentifiable(found),
    ]
    if found.within_noise:
        names = ", ".join(found.within_noise)
        text.append(f"Not significantly different from zero on this motion (the 95 % interval contains it): {names}.")
    else:
        text.append("Every parameter differs significantly from zero on this motion (95 %).")
    header = ("seen least", "singular value over the largest", "direction")
    rows = [(str(k + 1), f"{value:.2g}", _direction(parts)) for k, (value, parts) in enumerate(found.weakest)]
    return Section(
        "Observation matrix", text, (_singular_values(found.singular_values), Table("directions", header, rows))
    )


def _unidentifiable(found: Observability) -> str:
    what = counted(found.combined, "standard parameter")
    text = f"In combinations alone: {what} of the links, listed with the parameters."
    if not found.never_acting:
        return text
    return f"{text} No motion of this arm shows {', '.join(found.never_acting)}."


def _direction(parts: dict[str, float]) -> str:
    terms = [f"{value:+.2f} {name}" for name, value in parts.items()]
    return " ".join(terms).removeprefix("+")


def _singular_values(values: np.ndarray) -> Plot:
    decades = np.log10(np.maximum(values / values[0], 1e-9))
    marks = {f"a condition number of {USUAL_CONDITION}": -np.log10(USUAL_CONDITION)}
    panel = Panel("singular values", "log10 of value / largest", (Series("value / largest", decades),), marks=marks)
    number = np.arange(1.0, len(values) + 1)
    return Plot("singular-values", "Singular values of the observation matrix.", "number", (panel,), number)
