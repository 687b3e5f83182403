"""Plots of a report: SVG that follows the page's light or dark colours, each with its data.

What a part of a picture shows is written into it (`answering`): the page says it under the pointer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.report.plots import SERIES, Panel, Plot, Series, joint_series
from agent.report.svg import LETTER, WIDTH, Scale, answering, picture, text_at, ticks


@dataclass(frozen=True)
class Figure:
    """A plot ready for a page: SVG text, caption, and the data behind it as a table."""

    name: str
    caption: str
    svg: str
    header: tuple[str, ...]
    rows: np.ndarray


def search_history(best: np.ndarray, mean: np.ndarray) -> Plot:
    """Fitness over the generations : best (G,) and mean of the feasible (G,)."""
    series = (Series("best", best), Series("mean of the feasible", mean, "dashed", SERIES[1]))
    caption = "Fitness, log10 det(HᵀH / M), over the generations; higher is better (the paper's Fig. 4a)."
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
    """RMSE (motions, n) of several motions per axis, over the nominal torque (n,) where there is one.

    A box is the middle half, its line the median; whiskers reach what is no farther off than 1.5 boxes, dots the rest.
    """
    known = np.isfinite(nominal)
    values = np.where(known, 100.0 * rmse / np.where(known, nominal, 1.0), rmse)
    level = 100.0 * gate if known.any() else 0.0
    left, top, right, bottom = 57.6, 12.0, WIDTH - 8.0, 190.0
    up = Scale(0.0, 1.05 * max(float(np.nanmax(values, initial=0.0)), level, 1e-9), bottom, top)
    wide = (right - left) / len(names)
    parts = ['<g fill="currentColor">']
    for value, text in ticks(up.low, up.high, 6):
        place = float(up(np.array(value)))
        parts.append(f'<path d="M{left:.1f} {place:.1f}H{right:.1f}" stroke="currentColor" stroke-opacity="0.25"/>')
        parts.append(text_at(left - 5.0, place + 3.0, text, 9.0, "end"))
    unit = text_at(0.0, 0.0, "RMSE / nominal torque [%]" if known.any() else "RMSE [N·m]", 9.0, "middle")
    parts.append(f'<g transform="translate(14 {(top + bottom) / 2:.1f}) rotate(-90)">{unit}</g>')
    for k, (name, has) in enumerate(zip(names, known, strict=True)):
        middle = left + (k + 0.5) * wide
        parts.append(text_at(middle, bottom + 14.0, name, 9.0, "middle"))
        if not has and known.any():
            parts.append(text_at(middle, bottom + 25.0, "[N·m]", 9.0, "middle"))
    if known.any():
        parts.append(text_at(right, float(up(np.array(level))) - 3.0, "gate", 8.0, "end"))
        look = f'stroke="{SERIES[3]}" stroke-width="1.3" stroke-dasharray="1.3 2"'
        parts.append(f'<path d="M{left:.1f} {float(up(np.array(level))):.1f}H{right:.1f}" {look}/>')
    parts.append(f'</g><path d="M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}" stroke="currentColor"/>')
    for k, (name, has, column) in enumerate(zip(names, known, values.T, strict=True)):
        least, low, half, high, most = np.quantile(column, (0.0, 0.25, 0.5, 0.75, 1.0))
        near = column[(column >= low - 1.5 * (high - low)) & (column <= high + 1.5 * (high - low))]
        ends = up(np.array([near.min(initial=low), low, half, high, near.max(initial=high)])).tolist()
        middle, side = left + (k + 0.5) * wide, 0.25 * min(wide, 120.0)
        box = (
            f"M{middle:.1f} {ends[0]:.1f}V{ends[1]:.1f}M{middle:.1f} {ends[3]:.1f}V{ends[4]:.1f}"
            f"M{middle - side:.1f} {ends[1]:.1f}h{2 * side:.1f}V{ends[3]:.1f}h{-2 * side:.1f}Z"
        )
        line = f'<path d="M{middle - side:.1f} {ends[2]:.1f}h{2 * side:.1f}" stroke="{SERIES[0]}" stroke-width="2"/>'
        far = "".join(f"M{middle:.1f} {place:.1f}h0" for place in up(np.setdiff1d(column, near)).tolist())
        dots = f'<path d="{far}" stroke="{SERIES[3]}" stroke-width="4" stroke-linecap="round"/>' if far else ""
        said = (
            f"{name}: median {half:.3g}, middle half {low:.3g} to {high:.3g}, all {least:.3g} to {most:.3g} "
            f"{'%' if has else 'N·m'}"
        )
        span = f'<rect x="{middle - wide / 2:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{bottom - top:.1f}"'
        parts.append(f'<path d="{box}" stroke="currentColor"/>{line}{dots}{answering(span, said)}')
    header = tuple(f"{name} [{'%' if has else 'N·m'}]" for name, has in zip(names, known, strict=True))
    return Figure("validation-box", caption, picture(bottom + 30.0, "\n".join(parts)), header, values)


def cell_map(
    name: str, caption: str, values: np.ndarray, columns: Sequence[str], rows: Sequence[str], units: Sequence[str] = ()
) -> Figure:
    """Cells (rows, columns) with their values in the `units` of the rows, shaded by them: against the largest of the
    rows of the same unit."""
    units = units or [""] * len(rows)
    largest = {unit: float(np.nanmax(values[np.array(units) == unit], initial=1e-9)) for unit in units}
    labels = [f"{row} [{unit}]" if unit else row for row, unit in zip(rows, units, strict=True)]
    left, top, tall = 12.0 + 9.0 * LETTER * max(map(len, labels), default=0), 4.0, 32.4
    wide, bottom = (WIDTH - left - 4.0) / max(len(columns), 1), top + tall * len(rows)
    cells, texts = [], []
    for row, column in np.ndindex(values.shape):
        value, text = float(values[row, column]), "-"
        x, y = left + column * wide, top + row * tall
        if np.isfinite(value):
            text = f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"
            shade = min(0.08 + 0.82 * max(value, 0.0) / largest[units[row]], 1.0)  # reads on light and on dark
            said = f"{rows[row]}, {columns[column]}: {value:.3g} {units[row]}".replace("\n", " ").rstrip()
            place = f'x="{x + 0.02 * wide:.1f}" y="{y + 0.04 * tall:.1f}"'
            size = f'width="{0.96 * wide:.1f}" height="{0.92 * tall:.1f}"'
            cells.append(answering(f'<rect {place} {size} fill="{SERIES[1]}" fill-opacity="{shade:.3f}"', said))
        texts.append(text_at(x + wide / 2, y + tall / 2 + 3.2, text, 9.0, "middle"))
    texts += [text_at(left - 6.0, top + (k + 0.5) * tall + 3.2, label, 9.0, "end") for k, label in enumerate(labels)]
    for column, heading in enumerate(columns):
        for line, words in enumerate(heading.split("\n")):
            texts.append(text_at(left + (column + 0.5) * wide, bottom + 12.0 + 10.0 * line, words, 8.0, "middle"))
    lines = max((heading.count("\n") + 1 for heading in columns), default=1)
    content = "\n".join([*cells, '<g fill="currentColor">', *texts, "</g>"])
    header = ("row", *(column.replace("\n", "_") for column in columns))
    shown = np.column_stack([np.arange(1, len(rows) + 1), values])
    return Figure(name, caption, picture(bottom + 8.0 + 10.0 * lines, content), header, shown)
