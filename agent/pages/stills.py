"""The still picture of a plot as HTML with inline SVG: for paper, for notebooks, and where no script runs.

A plotting library would take longer over the pictures of a page than everything else on it takes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from agent.pages.plots import Panel, Plot, Series, thinned
from agent.pages.templates import filled

_MOST_POINTS = 300
#: Size of the picture of a panel that is alone in its row, and of one with a neighbour; margins of its axes [pt].
_WIDE, _NARROW, _TALL, _LOW = 720.0, 350.0, 200.0, 140.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 57.6, 7.2, 6.0, 30.0
_LETTER = 5.0  # mean width of a letter [pt]
#: Distance of the ticks of an axis, at least [pt].
_TICK_WIDE, _TICK_TALL = 75.0, 28.0
_DAY = 86400.0
_DATE_STEPS = (
    *(1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 7200.0, 10800.0, 21600.0, 43200.0),
    *(_DAY * count for count in (1, 2, 7, 14, 30, 91, 182, 365, 730, 1826, 3652)),
)
#: Sign of a look in a legend.
_SIGNS = {"line": "—", "dashed": "- -", "points": "●", "part": "■"}


@dataclass(frozen=True)
class Scale:
    """From `low` to `high` of the data onto `begin` to `end` [pt] of the picture."""

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, values: Any) -> Any:
        return self.begin + (values - self.low) * ((self.end - self.begin) / (self.high - self.low))


def still(plot: Plot) -> str:
    """HTML of all panels with their legends and axes."""
    shape = (_NARROW if plot.columns > 1 else _WIDE, _LOW if len(plot.panels) > 1 else _TALL)
    pictures = [_picture(plot, panel, *shape) for panel in plot.panels]
    return filled("agent.pages", "still.html", plot=plot, shape=shape, pictures=pictures, signs=_SIGNS)


def _picture(plot: Plot, panel: Panel, wide: float, high: float) -> dict[str, Any]:
    """A panel, its scales, and its texts, grid and curves in the picture."""
    x = plot.abscissa(panel)
    chosen = thinned(np.column_stack([series.values for series in panel.series]), _MOST_POINTS)
    outlines = list(_outlines(panel, chosen))
    across = Scale(*_extent([x[chosen]]), _LEFT, wide - _RIGHT)
    low, top = _extent([*(edge for _, pair in outlines for edge in pair), np.array(list(panel.marks.values()))])
    if panel.from_zero:
        low, top = 0.0, top if top > 0.0 else 1.0
    up = Scale(low, top, high - _BOTTOM, _TOP)
    texts = [((across.begin + across.end) / 2, high - 3.0, plot.abscissa_name, "middle")]
    grid = ""
    steps = dates if plot.dates else ticks
    for value, text in steps(across.low, across.high, int((across.end - across.begin) / _TICK_WIDE) + 1):
        pixel = float(across(value))
        grid += f"M{pixel:.1f} {up.end:.1f}V{up.begin + 3.0:.1f}"
        texts.append((min(pixel, wide - 0.5 * _LETTER * len(text)), up.begin + 13.0, text, "middle"))
    for value, text in ticks(up.low, up.high, int((up.begin - up.end) / _TICK_TALL) + 1):
        pixel = float(up(value))
        grid += f"M{across.begin - 3.0:.1f} {pixel:.1f}H{across.end:.1f}"
        texts.append((across.begin - 5.0, pixel + 3.0, text, "end"))
    paths, places = [], across(x[chosen])
    for series, (lower, upper) in outlines:
        filled_in = series.look == "part" or series.low is not None
        path = (
            _area(places, up(lower), up(upper)) if filled_in else _line_path(places, up(upper), series.look == "points")
        )
        paths.append((series, path))
    return {"panel": panel, "across": across, "up": up, "texts": texts, "grid": grid, "ways": paths}


def _extent(columns: Sequence[np.ndarray]) -> tuple[float, float]:
    """The range that an axis shows of these, with 5 % of it free on either side."""
    values = np.concatenate([np.asarray(column, dtype=float).ravel() for column in columns])
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    free = 0.05 * (high - low) or 0.05 * abs(high) or 0.05
    return low - free, high + free


def ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """At most `most` round numbers from `low` to `high`, and their texts."""
    exponent = int(np.floor(np.log10((high - low) / most)))
    sizes = [(part, power) for power in (exponent, exponent + 1) for part in (1.0, 2.0, 2.5, 5.0)]
    part, power = next(size for size in [*sizes, (1.0, exponent + 2)] if size[0] * 10.0 ** size[1] * most >= high - low)
    step = part * 10.0**power
    digits = max(0, -power + (part == 2.5))
    numbers = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1.0) * step + 0.0
    many = max(abs(low), abs(high)) >= 1e5 or digits > 4
    return [(float(value), f"{value:.6g}" if many else f"{value:.{digits}f}") for value in numbers]


def dates(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """The same of seconds since 1970."""
    step = next((size for size in _DATE_STEPS if size * most >= high - low), _DATE_STEPS[-1])
    text = "%H:%M:%S" if step < 60.0 else "%m-%d %H:%M" if step < _DAY else "%Y-%m-%d"
    numbers = np.arange(np.ceil(low / step), np.floor(high / step) + 1.0) * step
    return [(float(value), datetime.fromtimestamp(value, UTC).strftime(text)) for value in numbers]


def _outlines(panel: Panel, chosen: np.ndarray) -> Iterator[tuple[Series, tuple[np.ndarray, np.ndarray]]]:
    """Every curve with its lower and upper edge, twice the same of a line."""
    above, below = np.zeros((2, len(chosen)))
    for series in panel.series:
        values = series.values[chosen]
        if series.look == "part":
            base = np.where(values >= 0, above, below)
            yield series, (base, base + values)
            above, below = above + np.maximum(values, 0), below + np.minimum(values, 0)
        else:
            yield series, (values if series.low is None else series.low[chosen], values)


def _line_path(x: np.ndarray, y: np.ndarray, single: bool = False) -> str:
    """A line that is broken where there is nothing, or a dot for each point."""
    known = np.isfinite(x) & np.isfinite(y)
    drawn, texts = False, []
    for is_known, a, b in zip(known.tolist(), x.tolist(), y.tolist(), strict=True):
        if is_known:
            texts.append(f"M{a:.1f} {b:.1f}h0" if single else f"{'L' if drawn else 'M'}{a:.1f} {b:.1f}")
        drawn = is_known
    return "".join(texts)


def _area(x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> str:
    """The area between two lines, wherever both are known."""
    known = np.isfinite(x) & np.isfinite(lower) & np.isfinite(upper)
    runs = np.split(np.arange(len(x)), np.flatnonzero(np.diff(known)) + 1)
    known_runs = [run for run in runs if len(run) and known[run[0]]]
    return "".join(
        f"{_line_path(x[run], upper[run])}L{_line_path(x[run[::-1]], lower[run[::-1]])[1:]}Z" for run in known_runs
    )
