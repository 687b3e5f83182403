"""Straight moves with a turn about one axis, and the blends between them, worked out together.

The same formulas as one by one (`blend`), with arrays over all moves of a run: a loop has a dozen short stretches, and
calls would cost more than what is done in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from agent.compiled import blended
from agent.motion.path.blend import NODES, WEIGHTS, Corner
from agent.motion.path.segments import CartesianSegment, Line, Segment, SingleAxis


@dataclass(frozen=True, eq=False)
class StraightMoves:
    """M moves: start and way of the TCP (M, 3) [m], its orientation (M, 4) at the start, axis (M, 3) and angle (M,) of
    the turn [rad], what the rotation adds to the path (M,) [m]; and the M - 1 corners between them."""

    start: np.ndarray
    way: np.ndarray
    turn: np.ndarray
    axis: np.ndarray
    angle: np.ndarray
    turning: np.ndarray
    corners: tuple[Corner, ...]

    @classmethod
    def of(cls, segments: Sequence[Segment], corners: Sequence[Corner]) -> StraightMoves | None:
        """Of moves and the corners between them; None where they have to be worked out one by one."""
        if not corners or any(
            corner.through or corner.overlap or corner.step.family != "polynomial" or corner.step.turn != "path"
            for corner in corners
        ):
            return None
        curves, turns, turning = [], [], []
        for segment in segments:
            if not isinstance(segment, CartesianSegment) or segment.ends is not None:
                return None
            if (
                not isinstance(segment.curve, Line)
                or not isinstance(segment.turn, SingleAxis)
                or segment.turn.curve is not None
            ):
                return None
            curves.append(segment.curve)
            turns.append(segment.turn)
            turning.append(segment.turning)
        start = np.array([curve.start for curve in curves])
        return cls(
            start,
            np.array([curve.end for curve in curves]) - start,
            np.array([turn.start for turn in turns]),
            np.array([turn.axis for turn in turns]),
            np.array([turn.angle for turn in turns]),
            np.array(turning),
            tuple(corners),
        )

    def tau(self) -> np.ndarray:
        """(S,) parameters of the samples of all corners, but for their beginnings."""
        return np.concatenate([corner.tau()[1:] for corner in self.corners])

    def poses(self, sigmas: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Positions (S, 3) [m] and orientations (S, 4), move by move at its parameters `sigmas`, then corner by corner
        at `tau`."""
        counts = [len(sigma) for sigma in sigmas]
        tau = self.tau()
        joined, before = self._joined(1)
        one, two = joined.sigma(tau)
        which = np.concatenate((np.repeat(np.arange(len(sigmas)), counts), before, before + 1))
        sigma = np.concatenate((*sigmas, one, two))
        half = 0.5 * (sigma * self.angle[which])
        found = blended(self.start, self.way, self.turn, self.axis, which, before, sigma, np.cos(half), np.sin(half))
        return found[:, :3], found[:, 3:]

    def lengths(self) -> np.ndarray:
        """(S,) corner by corner, the lengths of its cells [m]."""
        known = [_nodes(corner.cells) for corner in self.corners]
        joined, before = self._joined(len(NODES))
        rate_one, rate_two = joined.rate(np.concatenate([nodes for nodes, _ in known]))
        one, two = self.way[:-1], self.way[1:]
        squares = [
            np.array([a @ b for a, b in zip(*pair, strict=True)])[before]
            for pair in ((one, one), (one, two), (two, two))
        ]
        size = rate_one * (rate_one * squares[0] + rate_two * (2.0 * squares[1])) + rate_two**2 * squares[2]
        turned = self.turning[before] * rate_one + self.turning[before + 1] * rate_two
        along = np.sqrt(np.maximum(size, 0.0) + turned**2)
        return (along.reshape(-1, len(NODES)) @ WEIGHTS) * 0.5 * np.concatenate([cells for _, cells in known])

    def _joined(self, repeats: int) -> tuple[Corner, np.ndarray]:
        """One corner with parts (S,) for `repeats` samples of every cell of all corners, and the move before (S,)."""
        counts = [repeats * corner.cells for corner in self.corners]
        parts = np.array([(corner.before, corner.after) for corner in self.corners])
        before, after = np.repeat(parts, counts, axis=0).T
        return replace(self.corners[0], before=before, after=after), np.repeat(np.arange(len(counts)), counts)


@lru_cache(maxsize=1000)
def _nodes(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (3 cells,) at which a blend is integrated, and the sizes of its cells (cells,)."""
    tau = np.linspace(0.0, 1.0, cells + 1)
    sizes = np.diff(tau)
    return (tau[:-1, None] + sizes[:, None] * 0.5 * (1.0 + NODES)).ravel(), sizes
