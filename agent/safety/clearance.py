"""What a check of the cell finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Violation:
    """The first violation of a motion: two bodies nearer than the margin, or a joint out of its range (`second` "").

    `index` of the sample at or before it, `time` [s] where the motion has times; `depth` is how far beyond the margin
    or range these two get on the whole motion [m, rad]; `stopping` says that it happens on the way to a stop that
    begins at the sample.
    """

    first: str
    second: str
    index: int
    time: float | None
    depth: float
    margin: float
    stopping: bool

    def __str__(self) -> str:
        where = f"sample {self.index}" if self.time is None else f"{self.time:.3f} s"
        begin = f"on the way to a stop from {where}" if self.stopping else f"at {where}"
        if not self.second:
            return f"{begin} {self.first} leaves its range, by {self.depth:.3g} (rad or m) at most"
        if self.margin > 0:
            amount = f"nearer than the margin of {1000 * self.margin:.0f} mm, by {1000 * self.depth:.1f} mm at most"
        else:
            amount = f"in collision, {1000 * self.depth:.1f} mm deep at most"
        return f"{begin} {self.first} and {self.second} are {amount}"


@dataclass(frozen=True, eq=False)
class CellReport:
    """What a check found.

    `clearances`: the smallest distance of each pair of bodies [m], negative where they overlap; `collision`: the first
    violation in time, or None; `depth`: the deepest of all violations [m, rad], to rank motions by.
    """

    clearances: Mapping[tuple[str, str], float]
    collision: Violation | None
    depth: float
