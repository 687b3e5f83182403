"""What a notebook shows of a result: a headline, one small plot as inline SVG, and the text of the terminal.

The plots are drawn by hand: some kilobytes each, where those of the reports have hundreds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

_COLOURS = ("#3b82c4", "#d9822b", "#4f9d69", "#c75d8a", "#8f75d6", "#a0823c", "#3fa7a3")
_WIDTH, _LEFT, _RIGHT, _ROW = 640.0, 110.0, 70.0, 16.0
_MOST_POINTS = 300


class Shown(ABC):
    """A result that prints itself: `text` on a terminal, headline and plot above it in a notebook."""

    @abstractmethod
    def headline(self) -> str:
        """The key figure in one sentence."""

    @abstractmethod
    def text(self) -> str:
        """Everything a terminal shows."""

    @abstractmethod
    def svg(self) -> str:
        """One plot."""

    def __repr__(self) -> str:
        return f"{self.headline()}\n{self.text()}".rstrip()

    def _repr_html_(self) -> str:
        text = f"<details><summary>more</summary><pre>{escape(self.text())}</pre></details>" if self.text() else ""
        return f"<div><p><b>{escape(self.headline())}</b></p>{self.svg()}{text}</div>"


def bars(names: Sequence[str], series: Mapping[str, Sequence[float] | np.ndarray], unit: str) -> str:
    """Horizontal bars: one group a name, one bar a series; values that are not finite have none."""
    values = np.array([list(row) for row in series.values()], dtype=float)
    finite = values[np.isfinite(values)]
    largest = float(finite.max()) if finite.size and finite.max() > 0 else 1.0
    scale = (_WIDTH - _LEFT - _RIGHT) / largest
    parts = []
    for k, name in enumerate(names):
        top = 22 + k * (len(values) * _ROW + 6)
        parts.append(_text(_LEFT - 6, top + 12, name, "end"))
        for row, colour in zip(range(len(values)), _COLOURS, strict=False):
            value, y = values[row, k], top + row * _ROW
            width = max(scale * value, 0.0) if np.isfinite(value) else 0.0
            parts.append(f'<rect x="{_LEFT:g}" y="{y:.1f}" width="{width:.1f}" height="{_ROW - 3:g}" fill="{colour}"/>')
            parts.append(_text(_LEFT + width + 4, y + 11, f"{value:.3g} {unit}" if np.isfinite(value) else "-"))
    height = 22 + len(names) * (len(values) * _ROW + 6)
    return _svg(height, [*_legend(list(series)), *parts])


def lines(x: np.ndarray, series: Mapping[str, np.ndarray], x_label: str, y_label: str, height: float = 200.0) -> str:
    """Curves (S,) over x (S,), thinned to a few hundred points."""
    step = max(1, len(x) // _MOST_POINTS)
    x = np.asarray(x, dtype=float)[::step]
    curves = {name: np.asarray(y, dtype=float)[::step] for name, y in series.items()}
    everything = np.concatenate([y[np.isfinite(y)] for y in curves.values()])
    low, high = (float(everything.min()), float(everything.max())) if everything.size else (0.0, 1.0)
    across = (_WIDTH - _LEFT - 10) / max(float(np.ptp(x)), 1e-12)
    up = (height - 60) / max(high - low, 1e-12)
    parts = [
        _text(_LEFT - 6, 30, f"{high:.3g}", "end"),
        _text(_LEFT - 6, height - 34, f"{low:.3g}", "end"),
        _text(_LEFT, height - 18, f"{x[0]:.3g}"),
        _text(_WIDTH - 10, height - 18, f"{x[-1]:.3g} {x_label}", "end"),
        _text(4, height / 2, y_label),
    ]
    for (_, y), colour in zip(curves.items(), _COLOURS * (len(curves) // len(_COLOURS) + 1), strict=False):
        points = " ".join(
            f"{_LEFT + across * (a - x[0]):.1f},{height - 36 - up * (b - low):.1f}"
            for a, b in zip(x, y, strict=True)
            if np.isfinite(b)
        )
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.2"/>')
    return _svg(height, [*_legend(list(curves)), *parts])


def _legend(names: Sequence[str]) -> list[str]:
    parts, x = [], _LEFT
    for name, colour in zip(names, _COLOURS, strict=False):
        parts += [f'<rect x="{x:g}" y="4" width="10" height="10" fill="{colour}"/>', _text(x + 14, 13, name)]
        x += 24 + 7 * len(name)
    return parts


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {height:g}" width="{_WIDTH:g}" '
        f'font-family="sans-serif" font-size="11" fill="currentColor">{"".join(parts)}</svg>'
    )
