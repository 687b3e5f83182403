"""The even grid on which a segment of a log was sampled, and its signals there, a part at a time.

Uneven stamps mean an uneven sampling, a late stamp on an even one, or both. Where the stamps keep the phase of a grid,
the position tells: sampled evenly it is smooth in the sample number, else in the stamps. Without a grid they are
believed. Where recorded velocities give times in which its squared fourth
differences are a tenth of those in either, these are taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent.estimation.sample_times import taken_at
from agent.recording import Log, line, sample_numbers, settled

_SMOOTHER = 10.0  # times, squared fourth differences
_HALO = 100  # samples at either side of a part, beyond which a spline does not feel its knots


@dataclass(frozen=True, eq=False)
class SampleClock:
    """Of the samples from `start` on: their `number` (S,) on the grid and their `knots` (S,) [s], to interpolate from.

    `knots` is None where every sample lies on the grid and none is missing.
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
            times = taken_at(stamps, late, log.position[start:stop], log.velocity[start:stop])
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
        from scipy.interpolate import CubicSpline, PchipInterpolator  # most of a second, and even logs need none of it

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
