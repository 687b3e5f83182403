"""Which parameters the data cannot tell apart: a map of the correlations of their estimates."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

import numpy as np

from agent.report.figures import Figure
from agent.report.page import Section, Table

if TYPE_CHECKING:
    from agent.model import IdentifiedModel

_SHOWN = 0.1
_STRONG = 0.95
_MOST_PAIRS = 12
_LIKE, _AGAINST = "#2a86c8", "#d55e00"


def correlation_section(model: IdentifiedModel) -> Section:
    """The map and the strongest pairs."""
    values = correlation(model.covariance)
    first, second = np.triu_indices(len(values), 1)
    order = np.argsort(-np.abs(values[first, second]))[:_MOST_PAIRS]
    rows = [(model.names[first[k]], model.names[second[k]], f"{values[first[k], second[k]]:+.3f}") for k in order]
    strong = int((np.abs(values[first, second]) > _STRONG).sum())
    text = (
        f"{strong} of {len(first)} pairs of parameters are correlated beyond {_STRONG}. The data determine the sum "
        "or difference of such a pair, not each value. Predictions are not affected.",
    )
    table = Table("correlated-pairs", ("parameter", "with", "correlation"), rows)
    return Section("Correlation of parameters", text, (_map(values, model.names), table))


def correlation(covariance: np.ndarray) -> np.ndarray:
    """(p, p) of a covariance; nought beside a parameter without variance."""
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > 0, deviation, 1.0)
    return np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)


def _map(values: np.ndarray, names: tuple[str, ...]) -> Figure:
    """One square a pair below the diagonal, named where the mouse rests; weak pairs are left white."""
    size, left = 12, 90
    side = left + size * len(names)
    drawn = []
    for k, name in enumerate(names):
        drawn.append(f'<text x="{left - 4}" y="{size * k + 10}" text-anchor="end">{escape(name)}</text>')
        below = f"translate({left + size * k + 9},{size * len(names) + 4}) rotate(90)"
        drawn.append(f'<text transform="{below}">{escape(name)}</text>')
        for other in range(k):
            value = float(values[k, other])
            if abs(value) >= _SHOWN:
                drawn.append(
                    f'<g class="answer"><title>{escape(name)}, {escape(names[other])}: {value:+.2f}</title>'
                    f'<rect x="{left + size * other}" y="{size * k}" width="{size - 1}" height="{size - 1}" '
                    f'fill="{_LIKE if value > 0 else _AGAINST}" fill-opacity="{abs(value):.2f}"/></g>'
                )
    svg = (
        f'<svg viewBox="0 0 {side} {side}" style="max-width:{1.4 * side:.0f}px" font-size="9" fill="currentColor">'
        f"{''.join(drawn)}</svg>"
    )
    caption = "Correlation of the parameters' estimates: blue with each other, orange against each other, full at 1."
    return Figure("correlation", caption, svg, tuple(names), values)
