"""Sections of the page: lines, tables, and pictures as SVG, text as text, the same bytes from the same results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("svg")
from matplotlib import pyplot as plt

_COLOURS = ("#1f6fb2", "#c8553d", "#5b8c5a", "#8e6c8a", "#d39b22", "#5f6b73")
_APART = 0.008  # of the axis, between lines
Interval = tuple[float, float, float]


def ratios(path: Path, rows: Mapping[str, tuple[Interval, str]], label: str) -> None:
    """A point with its interval for each row, coloured by its verdict; left of one is better."""
    figure, axes = _figure(7.0, 0.9 + 0.3 * len(rows))
    for at, ((value, low, high), verdict) in enumerate(rows.values()):
        colour = {"better": _COLOURS[0], "worse": _COLOURS[1]}.get(verdict, _COLOURS[5])
        axes.plot([low, high], [at, at], color=colour, linewidth=2)
        axes.plot([value], [at], "o", color=colour, markersize=5)
    axes.axvline(1.0, color="#888888", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.set_xlabel(label)
    _plain_ticks(axes.xaxis)
    _save(figure, path)


def curves(path: Path, lines: Mapping[str, Mapping[float, Interval]], labels: tuple[str, str], logs: str = "") -> None:
    """A line with intervals for each entry; `logs` says which axes are logarithmic ("x", "y", "xy")."""
    figure, axes = _figure(7.0, 3.4)
    places = [at for points in lines.values() for at in points]
    span = max(places) - min(places)
    for k, (name, points) in enumerate(lines.items()):
        shift = _APART * (k - 0.5 * (len(lines) - 1))  # intervals side by side
        x = [at * (1.0 + 3.0 * shift) if "x" in logs else at + shift * span for at in points]
        found = list(points.values())
        y = [value for value, _, _ in found]
        spread = [[value - low for value, low, _ in found], [high - value for value, _, high in found]]
        style = dict(color=_COLOURS[k % len(_COLOURS)], marker="o", markersize=4, capsize=2, linewidth=1.4)
        axes.errorbar(x, y, yerr=spread, label=name, linestyle="-" if k < len(_COLOURS) else "--", **style)
    for which in logs:
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        _plain_ticks(axes.xaxis if which == "x" else axes.yaxis)
    if "x" in logs:
        ticks = sorted(set(places))
        axes.set_xticks(ticks, [f"{at:g}" for at in ticks])
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _save(figure, path)


def _figure(width: float, height: float) -> tuple:
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "evidence", "font.size": 9})
    figure, axes = plt.subplots(figsize=(width, height))
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def _plain_ticks(axis) -> None:
    axis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_tick_params(which="minor", labelsize=7)


def _save(figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


@dataclass
class PageSection:
    """Markdown `lines`, and what of it belongs among the weak spots."""

    lines: list[str] = field(default_factory=list)
    weak: list[str] = field(default_factory=list)

    def say(self, *lines: str) -> None:
        """Add lines, and an empty one."""
        self.lines += [*lines, ""]

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Add a table."""
        self.say(
            "| " + " | ".join(head) + " |",
            "| " + " | ".join("---" for _ in head) + " |",
            *("| " + " | ".join(row) + " |" for row in rows),
        )

    def picture(self, name: str, what: str) -> None:
        """Add a picture of the page's folder."""
        self.say(f"![{what}](evidence/{name}.svg)")
