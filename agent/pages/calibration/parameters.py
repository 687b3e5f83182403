"""The parameters: values, intervals, and how well the motion shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.core import NORMAL_95, counted, plus_minus
from agent.model import USUAL_CONDITION, IdentifiedModel, judged_condition
from agent.pages.elements import Section, Table
from agent.pages.plots import Panel, Plot, Series
from agent.recording import Log
from agent.validation import observability

_PRIOR = (
    "Prior: what description and torque level say before the fit. From the data: how much they reduce its variance. "
    "Near 100 % the data determine a parameter, near 0 % the prior does."
)


def parameters_section(table: Sequence[Sequence[str]], notes: Sequence[str] = ()) -> Section:
    """Every parameter with its 95 % interval; `table` is that of `IdentifiedModel.rows`, header first."""
    priors = any(row[6] != "-" for row in table[1:])
    rows = []
    for name, value, deviation, _, unit, meaning, mean, doubt, share in table[1:]:
        before = (_interval(mean, doubt), share) if priors else ()
        cells = ("-", "stood still") if value == "-" else (_interval(value, deviation), _known(value, deviation))
        rows.append((name, cells[0], unit, cells[1], *before, meaning))
    before = ("prior ± 95 %", "from the data [%]") if priors else ()
    header = ("parameter", "value ± 95 %", "unit", "how well it is known", *before, "stands for")
    return Section("Parameters", (*notes, _PRIOR) if priors else notes, (Table("parameters", header, rows),))


def _interval(value: str, deviation: str) -> str:
    return plus_minus(float(value), NORMAL_95 * float(deviation))


def _known(value_text: str, scatter: str) -> str:
    """The standard deviation over the value, where that says something."""
    value, deviation = float(value_text), float(scatter)
    if abs(value) <= NORMAL_95 * deviation:
        return "may be zero"
    return f"to {100 * deviation / abs(value):.2g} %"


def observation_section(model: IdentifiedModel, log: Log) -> Section:
    """What a model's own motion shows of its parameters: condition number of the fit, singular values, the directions
    seen least, and what is not identifiable."""
    observed = observability(model, log)
    combined = counted(observed.combined, "standard parameter")
    hidden = f" No motion of this arm shows {', '.join(observed.never_acting)}." if observed.never_acting else ""
    text = [
        f"{observed.parameters} parameters. Condition number {judged_condition(model.condition_number)}.",
        "It is that of the weighted observation matrix that the model was estimated from, columns scaled to unit "
        "length. Singular values and directions are those along one cycle, rows weighted by the residuals.",
        f"In combinations alone: {combined} of the links, listed with the parameters.{hidden}",
        "Not significantly different from zero on this motion (the 95 % interval contains it): "
        f"{', '.join(observed.within_noise)}."
        if observed.within_noise
        else "Every parameter differs significantly from zero on this motion (95 %).",
    ]
    rows = []
    for k, (value, parts) in enumerate(observed.weakest):
        direction = " ".join(f"{part:+.2f} {name}" for name, part in parts.items()).removeprefix("+")
        rows.append((str(k + 1), f"{value:.2g}", direction))
    directions = Table("directions", ("seen least", "singular value over the largest", "direction"), rows)
    values = observed.singular_values
    decades = np.log10(np.maximum(values / values[0], 1e-9))
    marks = {f"a condition number of {USUAL_CONDITION}": -np.log10(USUAL_CONDITION)}
    panel = Panel("singular values", "log10 of value / largest", (Series("value / largest", decades),), marks=marks)
    number, caption = np.arange(1.0, len(values) + 1), "Singular values of the observation matrix."
    return Section(
        "Observation matrix", text, (Plot("singular-values", caption, "number", (panel,), number), directions)
    )
