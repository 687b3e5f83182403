"""Plots of a report: matplotlib SVG that follows the page's light or dark colours, each with its data.

What a part of a picture shows is written into it (`answer`): the page says it under the pointer.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.report.plots import SERIES, Panel, Plot, Series, joint_series

#: A colour no plot uses: replaced by `currentColor`, so axes and text follow the page.
_INK = "#010203"
#: What begins the id of a part that knows what it shows.
_ANSWER = "answer:"


@dataclass(frozen=True)
class Figure:
    """A plot ready for a page: SVG text, caption, and the data behind it as a table."""

    name: str
    caption: str
    svg: str
    header: tuple[str, ...]
    rows: np.ndarray


def to_figure(
    name: str, caption: str, plot: Any, header: tuple[str, ...], rows: np.ndarray, fitted: bool = True
) -> Figure:
    """A matplotlib figure with its data; `fitted` as in `svg_text`."""
    return Figure(name, caption, svg_text(name, plot, fitted), header, np.asarray(rows))


def svg_text(name: str, plot: Any, fitted: bool = True) -> str:
    """Turn a matplotlib figure into SVG without fixed ink, and close it.

    `fitted` margins follow their texts, which draws the plot twice.
    """
    import matplotlib.pyplot as plt

    buffer = io.StringIO()
    box = "tight" if fitted else None
    plot.savefig(buffer, format="svg", transparent=True, bbox_inches=box, metadata={"Date": None})
    plt.close(plot)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(_INK, "currentColor")
    svg = re.sub(rf'<g id="{_ANSWER}([^"]*)">', r'<g class="answer"><title>\1</title>', svg)
    # ids repeat from plot to plot on one page, and a clip path would then be another plot's
    svg = re.sub(r"(\d{1,4}\.\d\d)\d+", r"\1", svg)  # a hundredth of a point is finer than paper
    return re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{name}-", svg)


def answer(part: Any, text: str) -> None:
    """Let a part of a plot say what it shows."""
    part.set_gid(_ANSWER + text)


def answer_along(span: Any, texts: Iterable[str], first: int = 0) -> None:
    """Let every unit of an axis say what it shows; `span` is `axvspan` or `axhspan` of the plot's axes."""
    for place, text in enumerate(texts, start=first):
        # not quite transparent: a pointer falls through what is
        answer(span(place - 0.5, place + 0.5, facecolor=(0.5, 0.5, 0.5, 0.002), linewidth=0), text)


def new_plot(width: float = 10.0, height: float = 3.2, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """A figure and its axes in the house's style, drawn without a display."""
    import matplotlib as mpl
    from cycler import cycler

    mpl.use("svg")
    import matplotlib.pyplot as plt

    style = {
        "text.color": _INK,
        "axes.labelcolor": _INK,
        "axes.edgecolor": _INK,
        "xtick.color": _INK,
        "ytick.color": _INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.prop_cycle": cycler(color=SERIES),
        "font.size": 9,
        "svg.fonttype": "none",
        "svg.hashsalt": "calibration",
        "font.family": "sans-serif",
        "legend.frameon": False,
        "grid.alpha": 0.25,
        "grid.color": _INK,
        "axes.grid": True,
        "lines.linewidth": 1.3,
    }
    mpl.rcParams.update(style)  # type: ignore[arg-type]  # its stub lists every key
    return plt.subplots(rows, columns, figsize=(width, height), squeeze=False, **options)


def search_history(best: np.ndarray, mean: np.ndarray) -> Plot:
    """Fitness over the generations (the paper's Fig. 4a): best (G,) and mean of the feasible (G,)."""
    series = (Series("best", best), Series("mean of the feasible", mean, "dashed", SERIES[1]))
    caption = "Fitness, log10 det(HᵀH / M), over the generations; higher is better."
    panel = Panel("fitness", "", series)
    return Plot("search-history", caption, "generation", (panel,), np.arange(1.0, len(best) + 1))


def speed_profile(t: np.ndarray, speed: np.ndarray, wanted: float) -> Plot:
    """TCP speed (S,) [m/s] over time, against the programmed one."""
    panel = Panel(
        "speed of the tool", "m/s", (Series("speed", speed),), marks={"as programmed": wanted}, from_zero=True
    )
    return Plot("speed", "Speed of the tool along one cycle.", "time", (panel,), t, "s", link="cycle")


def limit_margins(t: np.ndarray, use: dict[str, np.ndarray], names: tuple[str, ...]) -> Plot:
    """Use of each kind of limit over time, fraction of the limit: {kind: (S, n)}."""
    panels = [
        Panel(
            f"use of the {kind} limit",
            "%",
            joint_series(names, 100 * values),
            marks={"limit": 100.0},
            from_zero=True,
        )
        for kind, values in use.items()
    ]
    caption = "Use of the limits of the joints along one cycle, in % of each."
    return Plot("margins", caption, "time", tuple(panels), t, "s", link="cycle")


def motion_box_plot(rmse: np.ndarray, nominal: np.ndarray, names: tuple[str, ...], gate: float, caption: str) -> Figure:
    """RMSE (motions, n) of several motions per axis, over the nominal torque (n,) where there is one (Fig. 5b)."""
    plot, axes = new_plot(height=3.0)
    known = np.isfinite(nominal)
    values = np.where(known, 100.0 * rmse / np.where(known, nominal, 1.0), rmse)
    kinds = ["" if has or not known.any() else "\n[N·m]" for has in known]
    ink = {"color": _INK}
    axes[0, 0].boxplot(
        values,
        tick_labels=[name + kind for name, kind in zip(names, kinds, strict=True)],
        boxprops=ink,
        whiskerprops=ink,
        capprops=ink,
        flierprops={"markeredgecolor": SERIES[3], "markersize": 4},
        medianprops={"color": SERIES[0], "linewidth": 2},
    )
    quartiles = np.quantile(values, (0.0, 0.25, 0.5, 0.75, 1.0), axis=0)
    texts = (
        f"{name}: median {middle:.3g}, middle half {low:.3g} to {high:.3g}, all {least:.3g} to {most:.3g} "
        f"{'%' if has else 'N·m'}"
        for name, has, (least, low, middle, high, most) in zip(names, known, quartiles.T, strict=True)
    )
    answer_along(axes[0, 0].axvspan, texts, first=1)
    axes[0, 0].set_ylabel("RMSE / nominal torque [%]" if known.any() else "RMSE [N·m]")
    axes[0, 0].set_ylim(bottom=0)
    if known.any():
        axes[0, 0].axhline(100.0 * gate, linestyle=":", color=SERIES[3], label="gate")
        axes[0, 0].legend()
    header = tuple(f"{name} [{'%' if has else 'N·m'}]" for name, has in zip(names, known, strict=True))
    return to_figure("validation-box", caption, plot, header, values)


def cell_map(
    name: str, caption: str, values: np.ndarray, columns: Sequence[str], rows: Sequence[str], units: Sequence[str] = ()
) -> Figure:
    """Cells (rows, columns) with their values in the `units` of the rows, shaded by them: against the largest of the
    rows of the same unit."""
    from matplotlib.patches import Rectangle

    units = units or [""] * len(rows)
    largest = {unit: float(np.nanmax(values[np.array(units) == unit], initial=1e-9)) for unit in units}
    plot, axes = new_plot(height=0.45 * len(rows) + 1.2)
    axis = axes[0, 0]
    axis.grid(visible=False)
    for row, column in np.ndindex(values.shape):
        value, text = float(values[row, column]), "-"
        if np.isfinite(value):
            text = f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"
            shade = min(0.08 + 0.82 * max(value, 0.0) / largest[units[row]], 1.0)  # reads on light and on dark
            corner = column - 0.48, row - 0.46
            cell = axis.add_patch(Rectangle(corner, 0.96, 0.92, facecolor=SERIES[1], alpha=shade, linewidth=0))
            answer(cell, f"{rows[row]}, {columns[column]}: {value:.3g} {units[row]}".replace("\n", " ").rstrip())
        axis.text(column, row, text, ha="center", va="center")
    axis.set_xlim(-0.5, len(columns) - 0.5)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.set_xticks(range(len(columns)), columns, fontsize=8)
    axis.set_yticks(
        range(len(rows)), [f"{row} [{unit}]" if unit else row for row, unit in zip(rows, units, strict=True)]
    )
    header = ("row", *(column.replace("\n", "_") for column in columns))
    return to_figure(name, caption, plot, header, np.column_stack([np.arange(1, len(rows) + 1), values]))
