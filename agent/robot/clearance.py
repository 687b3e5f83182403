"""The smallest distances of a whole motion, to a tolerance.

Between two postures no distance shrinks faster than the joints can carry a body (`BodyPair.reach`). One posture in the
middle of a stretch therefore clears the whole stretch where its distances are larger than half the stretch can take
away, and only the other stretches are looked at more closely: branch and bound, over the continuous motion that is
linear in joint space between samples. Nothing that is deeper than `tolerance` is missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError

if TYPE_CHECKING:
    from agent.robot.collision import CollisionModel

#: The smallest clearance of a pair is found to this part of its distance from the margin.
RESOLUTION = 0.25
_FIRST_STRETCHES = 64
#: Stretches that a proof begins with, and how often they are halved before it is given up.
_FEW_STRETCHES, _HALVINGS = 32, 6


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
    """Result of a check.

    `clearances`: the smallest distance of each pair of bodies [m], negative where they overlap; `collision`: the first
    violation in time, or None; `depth`: the deepest of all violations [m, rad], to rank motions by.
    """

    clearances: Mapping[tuple[str, str], float]
    collision: Violation | None
    depth: float


class ClearanceSearch:
    """Branch and bound over stretches of the motion u and, where there is a `stop`, of the way to a stop s in [0, 1].

    `margin` (pairs,) [m]. The posture is q(u) + s · stop(u), u counting samples. A stretch is the rectangle u0..u1,
    s0..s1; its bound is the distance in its middle less what the joints can take away on the way to its edges.
    """

    def __init__(
        self, model: CollisionModel, q: np.ndarray, stop: np.ndarray | None, margin: np.ndarray, tolerance: float
    ):
        self.model, self.q, self.stop, self.margin, self.tolerance = model, q, stop, margin, tolerance
        self.reach = np.array([pair.reach for pair in model.pairs]).T  # (n, pairs)
        self.travelled = _cumulated(q)
        #: Of the way to a stop: how much it has changed up to each sample, and how long it is there.
        self.stopping = None if stop is None else (_cumulated(stop), np.abs(stop))
        self.smallest = np.full(len(model.pairs), np.inf)
        self.first: tuple[float, int, bool] | None = None  # u, pair, on the way to a stop

    def run(self) -> None:
        stretches = self._stretches(_FIRST_STRETCHES)
        is_open = np.ones((len(stretches), len(self.model.pairs)), dtype=bool)
        while len(stretches):
            along, aside = self._radius(stretches)
            middle = _middle(stretches)
            distances = self.model.distances(self._postures(middle), np.any(is_open, axis=0))
            if np.isnan(distances).any():
                raise InputError("the distance of two bodies is no number; look at the robot's bodies and at the boxes")
            self._note(middle, distances)
            is_open &= self._undecided(stretches, distances - along - aside)
            stretches, is_open = _halves(stretches, is_open, along, aside)

    def all_keep_margin(self) -> bool:
        """Whether every pair is proved to keep its margin everywhere, so that `run` finds no violation: a motion that
        is well clear needs few postures. False where a pair does not, or where the proof would take long."""
        stretches = self._stretches(_FEW_STRETCHES)
        is_open = np.ones((len(stretches), len(self.model.pairs)), dtype=bool)
        for _ in range(_HALVINGS):
            along, aside = self._radius(stretches)
            distances = self.model.distances(self._postures(_middle(stretches)), np.any(is_open, axis=0))
            if not (distances >= self.margin).all():
                return False
            is_open &= ~(distances - along - aside >= self.margin)
            if not is_open.any():
                return True
            stretches, is_open = _halves(stretches, is_open, along, aside)
        return False

    def clearances(self) -> dict[tuple[str, str], float]:
        smallest = self.smallest.tolist()
        return {
            (pair.first, pair.second): clearance for pair, clearance in zip(self.model.pairs, smallest, strict=True)
        }

    def first_violation(self, times: np.ndarray | None) -> Sequence[Violation]:
        if self.first is None:
            return []
        u, pair, stopping = self.first
        names = self.model.pairs[pair]
        time = None if times is None else float(np.interp(u, np.arange(len(times)), times))
        margin = float(self.margin[pair])
        depth = margin - float(self.smallest[pair])
        return [Violation(names.first, names.second, int(u), time, depth, margin, stopping)]

    def depth(self) -> float:
        """How far the worst pair is beyond its margin [m]; negative where none is."""
        return float(np.max(self.margin - self.smallest))

    def _stretches(self, count: int) -> np.ndarray:
        """(R, 4) the whole motion, cut evenly."""
        edges = np.linspace(0.0, len(self.q) - 1.0, min(len(self.q), count) + 1)
        edges = np.concatenate([[0.0], edges])  # the start by itself: it may be where the arm stands now
        stretches = np.zeros((len(edges) - 1, 4))
        stretches[:, 0], stretches[:, 1] = edges[:-1], edges[1:]
        stretches[:, 3] = 0.0 if self.stop is None else 1.0
        return stretches

    def _postures(self, middle: np.ndarray) -> np.ndarray:
        postures = _at(self.q, middle[:, 0])
        return postures if self.stop is None else postures + middle[:, 1:] * _at(self.stop, middle[:, 0])

    def _radius(self, stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(R, pairs) what the joints can take away along u, and along s."""
        u0, u1, s0, s1 = stretches.T
        middle = (u0 + u1) / 2

        def half(cumulated: np.ndarray) -> np.ndarray:
            before, in_middle, after = (_at(cumulated, u) @ self.reach for u in (u0, middle, u1))
            return np.maximum(in_middle - before, after - in_middle)

        along = half(self.travelled)
        if self.stopping is None:
            return along, np.zeros_like(along)
        changed, length = self.stopping
        along = along + s1[:, None] * half(changed)
        return along, (s1 - s0)[:, None] / 2 * (_at(length, middle) @ self.reach)

    def _note(self, middle: np.ndarray, distances: np.ndarray) -> None:
        self.smallest = np.minimum(self.smallest, distances.min(axis=0))
        short = distances - self.margin
        violating = np.flatnonzero(~(short.min(axis=1) >= 0))
        if len(violating):
            row = violating[np.argmin(middle[violating, 0])]
            if self.first is None or middle[row, 0] < self.first[0]:
                self.first = (float(middle[row, 0]), int(short[row].argmin()), bool(middle[row, 1] > 0))

    def _undecided(self, stretches: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """(R, pairs) where there may be a smaller clearance worth knowing, or an earlier violation."""
        target = self.smallest - np.maximum(self.tolerance, RESOLUTION * np.abs(self.smallest - self.margin))
        earlier = stretches[:, :1] < (np.inf if self.first is None else self.first[0] - 1.0)  # to the sample
        return (bounds < target) | (earlier & (bounds < self.margin - self.tolerance))


def _middle(stretches: np.ndarray) -> np.ndarray:
    """(R, 2) u and s in the middle of each."""
    return (stretches[:, [0, 2]] + stretches[:, [1, 3]]) / 2


def _halves(
    stretches: np.ndarray, is_open: np.ndarray, along: np.ndarray, aside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Each stretch that is open for a pair, cut in the middle of u, or of s, and what is open there."""
    going_on = is_open.any(axis=1)
    across_u = np.where(is_open, along, 0.0).max(axis=1) >= np.where(is_open, aside, 0.0).max(axis=1)
    stretches, is_open, across_u = stretches[going_on], is_open[going_on], across_u[going_on]
    lower, upper = stretches.copy(), stretches.copy()
    rows, column = np.arange(len(stretches)), np.where(across_u, 0, 2)
    middle = (stretches[rows, column] + stretches[rows, column + 1]) / 2
    lower[rows, column + 1] = middle
    upper[rows, column] = middle
    return np.concatenate([lower, upper]), np.concatenate([is_open, is_open])


def _cumulated(values: np.ndarray) -> np.ndarray:
    """(S, n) how far each joint has gone up to each sample."""
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(np.abs(np.diff(values, axis=0)), axis=0)])


def _at(values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Rows of `values` (S, …) at real-valued indices u (R,), linear between samples."""
    below = np.minimum(u.astype(int), max(len(values) - 2, 0))
    above = np.minimum(below + 1, len(values) - 1)
    part = (u - below)[:, None]
    return values[below] * (1 - part) + values[above] * part
