"""A trajectory as a JointTrajectoryController takes it: what it refuses, and which state it commands at which time.

Read in the controller's source (ros2_controllers, Jazzy) and written anew. The kind of a segment follows from what both
of its ends have: positions alone are joined by lines, with velocities by cubics, with accelerations by quintics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

#: Hermite polynomials over u from 0 to 1, lowest power first: of value, slope and bend at 0, then of the same at 1.
_QUINTIC = np.array(
    [
        [1, 0, 0, -10, 15, -6],
        [0, 1, 0, -6, 8, -3],
        [0, 0, 0.5, -1.5, 1.5, -0.5],
        [0, 0, 0, 10, -15, 6],
        [0, 0, 0, -4, 7, -3],
        [0, 0, 0, 0.5, -1, 0.5],
    ]
)
_CUBIC = np.array([[1, 0, -3, 2], [0, 1, -2, 1], [0, 0, 3, -2], [0, 0, -1, 1]])
_LINE = np.array([[1, -1], [0, 1]])
_STILL = 1.2e-7  # rad/s: what passes for zero at the end
_APART = 1e-3  # rad: nearer positions are the same


@dataclass(frozen=True, eq=False)
class TrajectoryPoint:
    """One point: time [s] from the start, position (n,), and velocity and acceleration (n,) or nothing (0,)."""

    time: float
    rows: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, time: float, *rows: Sequence[float]) -> TrajectoryPoint:
        """With plain numbers; what is empty is left out, and what comes after it."""
        arrays = [np.asarray(row, dtype=float) for row in rows]
        count = next((k for k, row in enumerate(arrays) if len(row) == 0), len(arrays))
        return cls(time, tuple(arrays[:count]))


@dataclass(frozen=True, eq=False)
class TrajectoryMessage:
    """A JointTrajectory message: `stamp` [s] of the header, 0 for at once."""

    names: tuple[str, ...]
    stamp: float
    points: tuple[TrajectoryPoint, ...]

    def leads_away(self, joints: Sequence[str], position: np.ndarray) -> bool:
        """Whether a point is elsewhere than the position (n,) of these joints."""
        column = [self.names.index(name) for name in joints]
        return any(np.any(np.abs(point.rows[0][column] - position) > _APART) for point in self.points)

    def refusal(self, joints: Sequence[str], now: float) -> str:
        """Why a controller of these joints does not take it; empty where it does."""
        times = [point.time for point in self.points]
        count = len(joints)
        if sorted(self.names) != sorted(joints):
            return "the joints are not those of the controller"
        if not times:
            return "empty trajectory received"
        if any(b <= a for a, b in pairwise(times)) or times[0] < 0.0:
            return "times are not strictly rising"
        if self.stamp and self.stamp + times[-1] < now:
            return "the trajectory ends in the past"
        rows = [row for point in self.points for row in point.rows]
        if any(len(row) != count for row in rows) or not all(point.rows for point in self.points):
            return "wrong number of positions, velocities or accelerations"
        if not all(np.isfinite(row).all() for row in rows):
            return "a value is no number"
        last = self.points[-1].rows
        return "the velocity at the end is not zero" if len(last) > 1 and np.abs(last[1]).max() > _STILL else ""


@dataclass(eq=False)
class SampledTrajectory:
    """A message under way since it was first sampled, at `began` [s], from the state `before` (position, velocity).

    A first point that is due has no segment that leads to it.
    """

    message: TrajectoryMessage
    joints: tuple[str, ...]
    began: float
    before: tuple[np.ndarray, np.ndarray]
    times: np.ndarray = field(init=False)
    _points: list[TrajectoryPoint] = field(init=False)

    def __post_init__(self) -> None:
        column = [self.message.names.index(name) for name in self.joints]
        start = self.message.stamp or self.began
        points = [
            TrajectoryPoint(start + knot.time, tuple(row[column] for row in knot.rows)) for knot in self.message.points
        ]
        if self.began < points[0].time:
            position, velocity = self.before
            points.insert(0, TrajectoryPoint(self.began, (position, velocity, np.zeros_like(position))))
        self._points, self.times = points, np.array([point.time for point in points])

    @property
    def end(self) -> float:
        """Time [s] of the last point."""
        return float(self.times[-1])

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (n,) that are commanded at a time [s]; the last point is held."""
        if time >= self.end:
            return self._points[-1].rows[0], np.zeros(len(self.joints))
        k = max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)
        a, b = self._points[k], self._points[k + 1]
        length = b.time - a.time
        u = max(time - a.time, 0.0) / length
        count = min(len(a.rows), len(b.rows))
        basis = (_LINE, _CUBIC, _QUINTIC)[count - 1]
        ends = np.array([row * length**k for end in (a, b) for k, row in enumerate(end.rows[:count])])
        powers = np.arange(basis.shape[1])
        value = basis @ u**powers
        slope = basis[:, 1:] @ (powers[1:] * u ** (powers[1:] - 1)) / length
        return value @ ends, slope @ ends
