"""The still picture of a plot: for paper, and where no script runs."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np

from agent.report.plots import Panel, Plot, Series, thinned

_MOST_POINTS = 300


def still(plot: Plot) -> str:
    """SVG text of all panels, their axes and legends."""
    from agent.report.figures import new_plot, svg_text

    columns = min(plot.columns, len(plot.panels))
    rows = -(-len(plot.panels) // columns)
    height = (1.9 if len(plot.panels) > 1 else 2.8) * rows + 0.5
    figure, axes = new_plot(height=height, rows=rows, columns=columns)
    for axis in axes.flat[len(plot.panels) :]:
        axis.set_axis_off()
    shown: tuple[str, ...] = ()
    for number, (panel, axis) in enumerate(zip(plot.panels, axes.flat, strict=False)):
        labels = tuple(one.label for one in panel.series)
        _draw(plot, panel, axis, 13 if len(labels) > 2 else 3)  # a long legend takes the line above the axis
        if labels != shown and (len(labels) > 1 or panel.marks):
            axis.legend(ncols=max(1, len(labels)), fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 0.98))
        shown = labels
        if number >= len(plot.panels) - columns:
            axis.set_xlabel(f"{plot.x_label} [{plot.x_unit}]" if plot.x_unit else plot.x_label)
    figure.subplots_adjust(left=0.08, right=0.99, bottom=0.42 / height, top=1 - 0.42 / height, hspace=0.6, wspace=0.2)
    return svg_text(plot.name, figure, fitted=False)


def _draw(plot: Plot, panel: Panel, axis: Any, pad: float) -> None:
    x = plot.abscissa(panel)
    chosen = thinned(np.column_stack([one.values for one in panel.series]), _MOST_POINTS)
    shown: Any = x[chosen]
    if plot.dates:
        shown = [datetime.fromtimestamp(value, UTC) for value in shown.tolist()]
    high, low = np.zeros(len(chosen)), np.zeros(len(chosen))
    for one in panel.series:
        values = one.values[chosen]
        if one.look == "part":
            base = np.where(values >= 0, high, low)
            axis.fill_between(shown, base, base + values, color=one.colour, alpha=0.55, linewidth=0, label=one.label)
            high, low = high + np.maximum(values, 0), low + np.minimum(values, 0)
        elif one.low is not None:
            axis.fill_between(
                shown, one.low[chosen], values, color=one.colour, alpha=0.25, linewidth=0, label=one.label
            )
        else:
            axis.plot(shown, values, color=one.colour, label=one.label, **_line(one))
    for name, level in panel.marks.items():
        axis.axhline(level, linestyle=":", linewidth=1, color="#8a949e", label=name)
    axis.set_ylabel(f"[{panel.unit}]" if panel.unit else "", fontsize=8)
    # Without a height every label is measured to find one.
    axis.set_title(panel.title, fontsize=8, loc="left", pad=pad, y=1.0)
    if panel.from_zero:
        axis.set_ylim(bottom=0)


def _line(one: Series) -> dict[str, Any]:
    if one.look == "points":
        return {"linestyle": "none", "marker": ".", "markersize": 4}
    return {"linewidth": 1.0, "linestyle": "--" if one.look == "dashed" else "-"}
