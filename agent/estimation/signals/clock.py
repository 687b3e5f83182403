"""The times at which the samples of a segment were taken, and its signals on an even grid, a part at a time.

Uneven stamps mean uneven sampling, late stamps on even sampling, or both. The candidate times are the even grid (if the
stamps keep its phase), the stamps, and times from recorded velocities. Positions are smoothest over the right ones: the
sum of their squared fourth differences decides. Times from velocities must lower it by a factor of ten.

These times follow from the motion: between two samples each joint moves by its mean velocity times the interval, so the
joints that move determine the interval Δ. If nothing moves, it is the mean interval. The stamps bound the drift:

    minimise Σ ((t_i - stamp_i) / σ)² + Σ ((t_{i+1} - t_i - Δ_i) / σ_i)².
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent.recording import Log, line, sample_numbers, settled

_ROUNDS = 3  # of weights of the joints


def sampling_times(
    stamps: np.ndarray, even: np.ndarray, position: np.ndarray, velocity: np.ndarray
) -> np.ndarray | None:
    """(S,) increasing times [s] from stamps (S,), the even grid (S,), positions and velocities (S, n).

    None if fewer than two joints move, so that none confirms another, or if the times do not increase.
    """
    from scipy.linalg import solveh_banded

    usual = np.diff(even)
    moving = [j for j in range(position.shape[1]) if np.ptp(position[:, j]) > 0 and np.ptp(velocity[:, j]) > 0]
    if len(moving) < 2 or len(stamps) < 3:
        return None
    late = max(float(np.var(stamps - even)), 1e-18)
    interval, precision = usual, np.zeros_like(usual)
    for _ in range(_ROUNDS):
        precision = np.full_like(usual, 0.5 / late)
        total = usual * precision
        for j in moving:
            step, mean = np.diff(position[:, j]), (velocity[1:, j] + velocity[:-1, j]) / 2
            certain = 1 / max(float(np.mean((step - mean * interval) ** 2)), 1e-18)
            total += certain * mean * step
            precision += certain * mean**2
        interval = total / precision
    banded = np.zeros((2, len(stamps)))
    banded[0, 1:] = -precision
    banded[1] = 1 / late
    banded[1, :-1] += precision
    banded[1, 1:] += precision
    pull = stamps / late
    pull[:-1] -= precision * interval
    pull[1:] += precision * interval
    times = solveh_banded(banded, pull)
    return times if np.all(np.diff(times) > 0) else None


_SMOOTHER = 10.0  # factor between the sums of squared fourth differences
_HALO = 100  # samples on either side of a part that its spline depends on


@dataclass(frozen=True, eq=False)
class SampleClock:
    """The samples from `start` on: their `number` (S,) on the grid, and their times `knots` (S,) [s] to interpolate.

    `knots` is None if every sample lies on the grid and none is missing.
    """

    log: Log
    start: int
    number: np.ndarray
    slope: float
    intercept: float
    knots: np.ndarray | None

    @classmethod
    def of(cls, log: Log, start: int, stop: int) -> SampleClock:
        """The clock of one segment without gaps."""
        stamps = log.t[start:stop]
        number = sample_numbers(stamps, log.sample_rate)
        slope, intercept = line(number, stamps)
        late = intercept + slope * number
        uneven = np.max(np.abs(stamps - late)) > 1e-3 * slope
        if not uneven and number[-1] + 1 == len(stamps):
            return cls(log, start, number, slope, intercept, None)
        if uneven and log.even:
            number = settled(number, (stamps - intercept) / slope, log.position[start:stop])
            slope, intercept = line(number, stamps)
            late = intercept + slope * number
        by_number, by_stamp = (cls(log, start, number, slope, intercept, knots) for knots in (late, stamps))
        if not uneven:
            return by_number
        even, stamped = by_number._roughness() if log.even else np.inf, by_stamp._roughness()
        if log.velocity is not None and np.all(np.isfinite(log.velocity[start:stop])):
            times = sampling_times(stamps, late, log.position[start:stop], log.velocity[start:stop])
            by_velocity = None if times is None else cls(log, start, number, slope, intercept, times)
            if by_velocity and _SMOOTHER * by_velocity._roughness() < min(even, stamped):
                return by_velocity
        return by_number if even <= stamped else by_stamp

    @property
    def size(self) -> int:
        """Samples of the grid."""
        return int(self.number[-1]) + 1

    @property
    def rate(self) -> float:
        """[Hz]."""
        return 1 / self.slope

    def time(self, grid: slice) -> np.ndarray:
        """[s] of a part of the grid."""
        return self.intercept + self.slope * np.arange(grid.start, grid.stop)

    def signals(self, grid: slice) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Position, torque and set-points (None where there are none) on a part of the grid, missing samples filled."""
        position = self._on(grid, self.log.position)
        effort, set_points = self.log.effort, self.log.reference_position
        torque = None if effort is None else self._on(grid, effort, monotone=True)
        if set_points is not None and not np.all(np.isfinite(set_points[self._rows(grid)])):
            set_points = None
        return position, torque, None if set_points is None else self._on(grid, set_points)

    def _on(self, grid: slice, values: np.ndarray, monotone: bool = False) -> np.ndarray:
        rows = self._rows(grid)
        if self.knots is None:
            return values[rows]
        from scipy.interpolate import CubicSpline, PchipInterpolator  # slow to load, and even logs do not need it

        knots = self.knots[rows.start - self.start : rows.stop - self.start]
        curve: Callable[[np.ndarray], np.ndarray]
        curve = (PchipInterpolator if monotone else CubicSpline)(knots, values[rows])
        return curve(np.clip(self.time(grid), knots[0], knots[-1]))

    def _rows(self, grid: slice) -> slice:
        """Samples of the log that a part of the grid depends on."""
        if self.knots is None:
            return slice(self.start + grid.start, self.start + grid.stop)
        first, stop = np.searchsorted(self.number, [grid.start - _HALO, grid.stop + _HALO])
        return slice(self.start + int(first), self.start + int(stop))

    def _roughness(self) -> float:
        position = (self._on(part, self.log.position) for part in self.log.scratch.parts(self.size))
        return float(sum(np.sum(np.diff(part, 4, axis=0) ** 2) for part in position))
