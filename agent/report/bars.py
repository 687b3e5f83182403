"""Pictures of bars, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.report.plots import SERIES
from agent.report.svg import LETTER, WIDTH, Scale, answering, extent, picture, text_at, ticks

_ROW, _TEXT = 26.0, 9.0


@dataclass(frozen=True)
class Bar:
    """From `begin` to `end` in a row, on one of its lanes."""

    row: int
    begin: float
    end: float
    colour: str
    lane: int = 0


def lying_bars(
    labels: Sequence[str],
    said: Sequence[str],
    bars: Sequence[Bar],
    label: str,
    lanes: int = 1,
    legend: Sequence[tuple[str, str]] = (),
    marks: np.ndarray | None = None,
) -> str:
    """Rows with their `labels` and what they say to a pointer, in their lanes bars over a `label`led axis from 0 on.

    `legend`: name and colour of the lanes. `marks` (rows,): where a stroke stands across a row, NaN where none does.
    """
    bars = [bar for bar in bars if np.isfinite((bar.begin, bar.end)).all()]
    marks = np.full(len(labels), np.nan) if marks is None else marks
    left, right = 12.0 + _TEXT * LETTER * max(map(len, labels), default=0), WIDTH - 10.0
    top = 18.0 if legend else 6.0
    bottom = top + _ROW * len(labels)
    ends = [edge for bar in bars for edge in (bar.begin, bar.end)]
    low, high = extent([np.array([0.0, *ends]), marks])
    across = Scale(0.0 if min(ends, default=0.0) >= 0.0 else low, high, left, right)

    def at(value: float) -> float:
        return float(across(np.array(value)))

    lines, texts, drawn = [], [], []
    for value, text in ticks(across.low, across.high, 10):
        lines.append(f"M{at(value):.1f} {top:.1f}V{bottom + 3.0:.1f}")
        texts.append(text_at(at(value), bottom + 13.0, text, _TEXT, "middle"))
    texts.append(text_at((left + right) / 2, bottom + 27.0, label, _TEXT, "middle"))
    tall = 0.72 * _ROW / lanes
    for bar in bars:
        y = top + (bar.row + 0.14) * _ROW + bar.lane * tall
        x, wide = min(at(bar.begin), at(bar.end)), abs(at(bar.end) - at(bar.begin))
        drawn.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{tall:.1f}" fill="{bar.colour}"/>')
    for row, (name, text, mark) in enumerate(zip(labels, said, marks.tolist(), strict=True)):
        y = top + row * _ROW
        texts.append(text_at(left - 6.0, y + _ROW / 2 + 3.0, name, _TEXT, "end"))
        if np.isfinite(mark):
            stroke = f"M{at(mark):.1f} {y + 0.12 * _ROW:.1f}v{0.76 * _ROW:.1f}"
            drawn.append(f'<path d="{stroke}" stroke="{SERIES[3]}" stroke-width="2"/>')
        span = f'<rect x="{left:.1f}" y="{y:.1f}" width="{right - left:.1f}" height="{_ROW:.1f}"'
        drawn.append(answering(span, text))
    place = right - sum(14.0 + 7.0 * LETTER * len(name) + 10.0 for name, _ in legend)
    for name, colour in legend:
        drawn.append(f'<path d="M{place:.1f} 8h9" stroke="{colour}" stroke-width="5"/>')
        texts.append(text_at(place + 13.0, 10.5, name, 7.0, "start"))
        place += 14.0 + 7.0 * LETTER * len(name) + 10.0
    axis = f'<path d="M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}" stroke="currentColor"/>'
    grid = f'<path d="{"".join(lines)}" stroke="currentColor" stroke-opacity="0.25"/>'
    return picture(bottom + 34.0, "\n".join([grid, *drawn, axis, '<g fill="currentColor">', *texts, "</g>"]))


def standing_bars(
    labels: Sequence[str],
    said: Sequence[str],
    values: np.ndarray,
    colours: Sequence[str],
    label: str,
    top_value: float,
    levels: Sequence[float],
) -> str:
    """Bars from 0 to `values` (N,) over upright labels, the axis from `-top_value` to `top_value`; dots at `levels`."""
    left, right, top, bottom = 57.6, WIDTH - 8.0, 6.0, 150.0
    up = Scale(-top_value, top_value, bottom, top)
    wide = (right - left) / max(len(labels), 1)

    def at(value: float) -> float:
        return float(up(np.array(value)))

    lines, texts, drawn = [], [], []
    for value, text in ticks(up.low, up.high, 6):
        lines.append(f"M{left:.1f} {at(value):.1f}H{right:.1f}")
        texts.append(text_at(left - 5.0, at(value) + 3.0, text, _TEXT, "end"))
    unit = text_at(0.0, 0.0, label, _TEXT, "middle")
    texts.append(f'<g transform="translate(16 {(top + bottom) / 2:.1f}) rotate(-90)">{unit}</g>')
    for k, (name, text, value, colour) in enumerate(zip(labels, said, values.tolist(), colours, strict=True)):
        x = left + k * wide
        y, tall = min(at(0.0), at(value)), abs(at(value) - at(0.0))
        size = f'width="{0.8 * wide:.1f}" height="{tall:.1f}"'
        drawn.append(f'<rect x="{x + 0.1 * wide:.1f}" y="{y:.1f}" {size} fill="{colour}"/>')
        span = f'<rect x="{x:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{bottom - top:.1f}"'
        drawn.append(answering(span, text))
        upright = text_at(0.0, 0.0, name, 6.0, "end")
        texts.append(f'<g transform="translate({x + wide / 2 + 2.0:.1f} {bottom + 4.0:.1f}) rotate(-90)">{upright}</g>')
    dots = f'stroke="{SERIES[3]}" stroke-width="1.3" stroke-dasharray="1.3 2"'
    drawn += [f'<path d="M{left:.1f} {at(level):.1f}H{right:.1f}" {dots}/>' for level in levels]
    axis = f'<path d="M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}" stroke="currentColor"/>'
    grid = f'<path d="{"".join(lines)}" stroke="currentColor" stroke-opacity="0.25"/>'
    height = bottom + 12.0 + 6.0 * LETTER * max(map(len, labels), default=0)
    return picture(height, "\n".join([grid, *drawn, axis, '<g fill="currentColor">', *texts, "</g>"]))
