"""Intervals over machines, and sections of the page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

#: Value, and lowest and highest end of its 95 % interval.
Interval = tuple[float, float, float]
_RESAMPLES = 4000
#: Machines that a verdict takes; fewer agree by chance more often than one time in twenty (sign test).
FEWEST = 6


def mean_of(values: Mapping[int, float]) -> Interval:
    """Mean over machines and its 95 % bootstrap interval; NaN where there is one machine only."""
    drawn = np.array(list(values.values()))
    return _interval(drawn, np.ones_like(drawn))


def ratio_of(first: Mapping[int, float], second: Mapping[int, float]) -> Interval:
    """Ratio of means over the machines that both have, with its 95 % interval: machines are drawn again in pairs."""
    both = [machine for machine in first if machine in second]
    return _interval(np.array([first[m] for m in both]), np.array([second[m] for m in both]))


def difference_of(first: Mapping[int, float], second: Mapping[int, float]) -> Interval:
    """Mean of first minus second over the machines that both have, with its 95 % interval."""
    return mean_of({machine: first[machine] - second[machine] for machine in first if machine in second})


def _interval(first: np.ndarray, second: np.ndarray) -> Interval:
    value = float(first.sum() / second.sum())
    if len(first) < 2:
        return value, np.nan, np.nan
    picked = np.random.default_rng(0).integers(len(first), size=(_RESAMPLES, len(first)))
    ratios = first[picked].sum(axis=1) / second[picked].sum(axis=1)
    low, high = np.quantile(ratios, (0.025, 0.975))
    return value, float(low), float(high)


def each(lines: Mapping[int, Any], pick: Callable[[Any], Any]) -> dict[int, float]:
    """By machine: the mean over joints of what is picked of its values, one number or (n,)."""
    return {machine: float(np.mean(pick(values))) for machine, values in lines.items()}


def text(found: Interval, digits: int = 2) -> str:
    """A figure and its interval; of one machine there is none."""
    if np.isnan(found[1]):
        return f"{found[0]:.{digits}f}"
    value, low, high = (f"{x:.{digits}f}" for x in found)
    return f"{value} [{low}, {high}]"


def verdict(found: Interval, machines: int) -> str:
    """What a ratio of errors says of the first: better, worse or open."""
    if machines < FEWEST:
        return "open"
    return "better" if found[2] < 1 else "worse" if found[1] > 1 else "open"


@dataclass
class PageSection:
    """Markdown `lines`, and which statements belong among the limits."""

    lines: list[str] = field(default_factory=list)
    weak: list[str] = field(default_factory=list)

    def say(self, *lines: str) -> None:
        """Add lines, and an empty one."""
        self.lines += [*lines, ""]

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Add a table."""
        self.say(*("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)))
