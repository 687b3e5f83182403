"""The still picture of a plot: for paper, and where no script runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from html import escape

import numpy as np

from agent.report.plots import Panel, Plot, Series, thinned
from agent.report.svg import LETTER, WIDTH, Scale, dates, extent, picture, text_at, ticks

_MOST_POINTS = 300
#: Margins of the picture [pt], and the gaps between panels in parts of a panel.
_LEFT, _RIGHT, _EDGE = 57.6, 7.2, 30.2
_BESIDE, _BELOW = 0.2, 0.6
#: A panel of so many points has one more tick.
_TICK_WIDE, _TICK_TALL = 75.0, 28.0
_TEXT, _TITLE, _LEGEND = 9.0, 8.0, 7.0
_HANDLE, _GAP = 14.0, 5.0
_MARK = 'stroke="#8a949e" stroke-width="1" stroke-dasharray="1 1.7"'


def still(plot: Plot) -> str:
    """SVG text of all panels, their axes and legends."""
    columns = min(plot.columns, len(plot.panels))
    rows = -(-len(plot.panels) // columns)
    height = 72.0 * ((1.9 if len(plot.panels) > 1 else 2.8) * rows + 0.5)
    wide = (WIDTH - _LEFT - _RIGHT) / (columns + _BESIDE * (columns - 1))
    tall = (height - 2.0 * _EDGE) / (rows + _BELOW * (rows - 1))
    parts: list[str] = []
    shown: tuple[str, ...] = ()
    for number, panel in enumerate(plot.panels):
        row, column = divmod(number, columns)
        left, top = _LEFT + column * (1.0 + _BESIDE) * wide, _EDGE + row * (1.0 + _BELOW) * tall
        labels = tuple(one.label for one in panel.series)
        legend = labels != shown and (len(labels) > 1 or bool(panel.marks))
        parts += _panel(plot, panel, number, (left, top, wide, tall), legend)
        shown = labels
        if number >= len(plot.panels) - columns:
            label = f"{plot.x_label} [{plot.x_unit}]" if plot.x_unit else plot.x_label
            text = text_at(left + wide / 2, top + tall + 25.0, label, _TEXT, "middle")
            parts.append(f'<g fill="currentColor">{text}</g>')
    return picture(height, "\n".join(parts))


def _panel(
    plot: Plot, panel: Panel, number: int, frame: tuple[float, float, float, float], legend: bool
) -> Iterator[str]:
    left, top, wide, tall = frame
    x = plot.abscissa(panel)
    chosen = thinned(np.column_stack([one.values for one in panel.series]), _MOST_POINTS)
    outlines = list(_outlines(panel, chosen))
    across = Scale(*extent([x[chosen]]), left, left + wide)
    edges = [edge for _, pair in outlines for edge in pair]
    low, high = extent([*edges, np.array(list(panel.marks.values()))])
    if panel.from_zero:
        low, high = 0.0, high if high > 0.0 else 1.0
    up = Scale(low, high, top + tall, top)
    steps = dates if plot.dates else ticks
    yield '<g fill="currentColor" stroke="none">'
    grid = []
    for value, text in steps(across.low, across.high, int(wide / _TICK_WIDE) + 1):
        place = float(across(np.array(value)))
        grid.append(f"M{place:.1f} {top:.1f}V{top + tall + 3.0:.1f}")
        inside = min(place, WIDTH - 0.5 * _TEXT * LETTER * len(text))
        yield text_at(inside, top + tall + 13.0, text, _TEXT, "middle")
    for value, text in ticks(up.low, up.high, int(tall / _TICK_TALL) + 1):
        place = float(up(np.array(value)))
        grid.append(f"M{left - 3.0:.1f} {place:.1f}H{left + wide:.1f}")
        yield text_at(left - 5.0, place + 3.0, text, _TEXT, "end")
    if panel.unit:
        middle = f"{left - 45.0:.1f} {top + tall / 2:.1f}"
        unit = text_at(0.0, 0.0, f"[{panel.unit}]", _TITLE, "middle")
        yield f'<g transform="translate({middle}) rotate(-90)">{unit}</g>'
    crowded = legend and LETTER * _TITLE * len(panel.title) + sum(_legend_sizes(panel)) > wide
    pad = 13.0 if crowded or len(panel.series) > 2 else 3.0  # a long legend takes the line above the axis
    yield text_at(left, top - pad, panel.title, _TITLE, "start")
    if legend:
        yield from _legend(panel, left, left + wide, top - 3.0)
    yield "</g>"
    yield f'<path d="{"".join(grid)}" stroke="currentColor" stroke-width="0.8" stroke-opacity="0.25"/>'
    ink = 'stroke="currentColor" stroke-width="0.8"'
    yield f'<path d="M{left:.1f} {top:.1f}V{top + tall:.1f}H{left + wide:.1f}" {ink}/>'
    clip = f"{plot.name}-clip-{number}"
    shape = f'<rect x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{tall:.1f}"/>'
    yield f'<clipPath id="{clip}">{shape}</clipPath><g clip-path="url(#{clip})">'
    for level in panel.marks.values():
        yield f'<path d="M{left:.1f} {float(up(np.array(level))):.1f}H{left + wide:.1f}" {_MARK}/>'
    places = across(x[chosen])
    for one, (lower, upper) in outlines:
        if one.look == "part" or one.low is not None:
            yield f'<path d="{_area(places, up(lower), up(upper))}" {_look(one)}/>'
        else:
            yield f'<path d="{_points(places, up(upper), one.look == "points")}" {_look(one)}/>'
    yield "</g>"


def _outlines(panel: Panel, chosen: np.ndarray) -> Iterator[tuple[Series, tuple[np.ndarray, np.ndarray]]]:
    """Every curve with its lower and upper edge, twice the same of a line."""
    above, below = np.zeros((2, len(chosen)))
    for one in panel.series:
        values = one.values[chosen]
        if one.look == "part":
            base = np.where(values >= 0, above, below)
            yield one, (base, base + values)
            above, below = above + np.maximum(values, 0), below + np.minimum(values, 0)
        else:
            yield one, (values if one.low is None else one.low[chosen], values)


def _points(x: np.ndarray, y: np.ndarray, single: bool) -> str:
    """A line that is broken where there is nothing, or a dot for each point."""
    known = np.isfinite(x) & np.isfinite(y)
    drawn, texts = False, []
    for is_known, a, b in zip(known.tolist(), x.tolist(), y.tolist(), strict=True):
        if is_known:
            texts.append(f"M{a:.1f} {b:.1f}h0" if single else f"{'L' if drawn else 'M'}{a:.1f} {b:.1f}")
        drawn = is_known
    return "".join(texts)


def _area(x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> str:
    """What lies between two lines, wherever both are known."""
    known = np.isfinite(x) & np.isfinite(lower) & np.isfinite(upper)
    runs = np.split(np.arange(len(x)), np.flatnonzero(np.diff(known)) + 1)
    texts = []
    for run in runs:
        if len(run) and known[run[0]]:
            there, back = _points(x[run], upper[run], False), _points(x[run[::-1]], lower[run[::-1]], False)
            texts.append(f"{there}L{back[1:]}Z")
    return "".join(texts)


def _look(one: Series) -> str:
    colour = escape(one.colour)
    if one.look == "part" or one.low is not None:
        return f'fill="{colour}" fill-opacity="{0.55 if one.look == "part" else 0.25}"'
    if one.look == "points":
        return f'stroke="{colour}" stroke-width="3" stroke-linecap="round"'
    dashed = ' stroke-dasharray="3.7 1.6"' if one.look == "dashed" else ""
    return f'stroke="{colour}" stroke-width="1"{dashed}'


def _legend(panel: Panel, left: float, right: float, bottom: float) -> Iterator[str]:
    """One row that ends on the right, smaller where it would be too long."""
    entries = [(one.label, _entry(one)) for one in panel.series]
    entries += [(name, lambda x, y: f'<path d="M{x:.1f} {y:.1f}h{_HANDLE:g}" {_MARK}/>') for name in panel.marks]
    sizes = _legend_sizes(panel)
    part = min(1.0, (right - left) / sum(sizes))
    place = right - part * sum(sizes)
    for (label, handle), size in zip(entries, sizes, strict=True):
        yield f'<g fill="none">{handle(place, bottom - 2.5)}</g>'
        yield text_at(place + _HANDLE + _GAP, bottom, label, part * _LEGEND, "start")
        place += part * size


def _legend_sizes(panel: Panel) -> list[float]:
    labels = [*(one.label for one in panel.series), *panel.marks]
    return [_HANDLE + 3.0 * _GAP + LETTER * _LEGEND * len(label) for label in labels]


def _entry(one: Series) -> Callable[[float, float], str]:
    if one.look == "part" or one.low is not None:
        return lambda x, y: f'<path d="M{x:.1f} {y - 2.5:.1f}h{_HANDLE:g}v5h-{_HANDLE:g}Z" {_look(one)}/>'
    if one.look == "points":
        return lambda x, y: f'<path d="M{x + _HANDLE / 2:.1f} {y:.1f}h0" {_look(one)}/>'
    return lambda x, y: f'<path d="M{x:.1f} {y:.1f}h{_HANDLE:g}" {_look(one)}/>'
