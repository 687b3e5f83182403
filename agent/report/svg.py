"""Pictures written as SVG: scales, round numbers along an axis, texts.

A plotting library takes longer over the pictures of a page than all else on it takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape

import numpy as np

#: Width of a picture [pt].
WIDTH = 720.0
#: Mean width of a letter in parts of its height.
LETTER = 0.55
#: What is left free on either side of the data, in parts of them.
_FREE = 0.05
_MINUTE, _HOUR, _DAY = 60.0, 3600.0, 86400.0
_DATE_STEPS = (
    *(1.0, 2.0, 5.0, 10.0, 30.0),
    *(_MINUTE * count for count in (1, 2, 5, 10, 30)),
    *(_HOUR * count for count in (1, 2, 3, 6, 12)),
    *(_DAY * count for count in (1, 2, 7, 14, 30, 91, 182, 365, 730, 1826, 3652)),
)


@dataclass(frozen=True)
class Scale:
    """From `low` to `high` of what is shown onto `begin` to `end` [pt] of the picture."""

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, values: np.ndarray) -> np.ndarray:
        shown: np.ndarray = self.begin + (values - self.low) * ((self.end - self.begin) / (self.high - self.low))
        return shown


def picture(height: float, content: str) -> str:
    """The SVG of a `content`; in its ink where the page's colours say so (`currentColor`)."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH:g}pt" height="{height:.0f}pt" '
        f'viewBox="0 0 {WIDTH:g} {height:.0f}" font-family="sans-serif" fill="none" stroke-linejoin="round" '
        f'overflow="visible">\n{content}\n</svg>'
    )


def extent(columns: Sequence[np.ndarray]) -> tuple[float, float]:
    """What an axis shows of these."""
    values = np.concatenate([np.asarray(column, dtype=float).ravel() for column in columns])
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    free = _FREE * (high - low) or 0.05 * abs(high) or 0.05
    return low - free, high + free


def ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """At most so many round numbers from `low` to `high`, and their texts."""
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
    text = "%H:%M:%S" if step < _MINUTE else "%m-%d %H:%M" if step < _DAY else "%Y-%m-%d"
    numbers = np.arange(np.ceil(low / step), np.floor(high / step) + 1.0) * step
    return [(float(value), datetime.fromtimestamp(value, UTC).strftime(text)) for value in numbers]


def text_at(x: float, y: float, text: str, size: float, anchor: str) -> str:
    """A text of so many points, its `anchor` (start, middle, end) there."""
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:.3g}" text-anchor="{anchor}">{escape(text)}</text>'


def answering(shape: str, text: str) -> str:
    """The same of a shape of SVG, whose tag is still open; what is not to be seen is not quite transparent, as a
    pointer falls through what is."""
    fill = "" if "fill=" in shape else ' fill="#808080" fill-opacity="0.002"'
    return f'<g class="answer"><title>{escape(text)}</title>{shape}{fill}/></g>'
