"""Planned against executed set-points: r(t) ≈ p(a t + b), p averaged over a short time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.recording import Log


@dataclass(frozen=True, eq=False)
class MotionGap:
    """before, after, floor (n,) [rad]; rate a, shift b [s] and blend [s] of the fit; 1, 0, 0 where it helps nothing, or
    by no practical size."""

    before: np.ndarray
    after: np.ndarray
    floor: np.ndarray | None
    rate: float
    shift: float
    blend: float
    limits: DecisionLimits = LIMITS

    @property
    def notable(self) -> bool:
        """Whether there is anything to explain."""
        return bool(self.before.max() > self.limits.path_gap)

    @property
    def described(self) -> bool:
        """Whether there is something to explain, and rate, shift and blend that all motions share explain it."""
        return self.notable and (self.closure or 0.0) >= self.limits.explained

    @property
    def practical(self) -> bool:
        """Whether rate, shift or blend are of a size that matters: every interpolator is off by a little."""
        late = max(abs(self.shift), self.blend)
        return abs(self.rate - 1.0) > self.limits.path_rate or late > self.limits.path_time

    @property
    def closure(self) -> float | None:
        """Of the motion gap."""
        b, a = np.mean(self.before**2), np.mean(self.after**2)
        return float((b - a) / b) if b > 0 else None


def motion_gap(logs: Sequence[Log], limits: DecisionLimits = LIMITS) -> MotionGap | None:
    """The gap over all logs; None where a log lacks planned or executed set-points."""
    pairs = []
    for log in logs:
        if log.planned_position is None or log.reference_position is None:
            return None
        good = np.all(np.isfinite(log.planned_position) & np.isfinite(log.reference_position), axis=1)
        if good.sum() < 10:
            return None
        pairs.append((log.t[good], log.planned_position[good], log.reference_position[good]))
    before = _rms([executed - planned for _, planned, executed in pairs])
    as_it_is = MotionGap(before, before, _floor(logs, [e - p for _, p, e in pairs]), 1.0, 0.0, 0.0, limits)
    if not as_it_is.notable:
        return as_it_is
    fitted = [_fit(*pair) for pair in pairs]
    errors = []
    for number, pair in enumerate(pairs):
        others = [one for k, one in enumerate(fitted) if k != number] or fitted
        rate, blend = (float(np.median([other[k] for other in others])) for k in (0, 2))
        errors.append(pair[2] - _executed(*pair[:2], rate, fitted[number][1], blend))
    rate, shift, blend = (float(np.median([one[k] for one in fitted])) for k in range(3))
    found = MotionGap(before, _rms(errors), _floor(logs, errors), rate, shift, blend, limits)
    # other corners and ramps are no change of rate: what one motion teaches then makes another one worse
    return found if found.practical and np.sum(found.after**2) < np.sum(before**2) else as_it_is


def _rms(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0))


def _executed(time: np.ndarray, planned: np.ndarray, rate: float, shift: float, blend: float) -> np.ndarray:
    """(S, n) set-points of a plan run at another rate, later by `shift` and averaged over `blend`."""
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import uniform_filter1d

    at = np.clip(time[0] + rate * (time - time[0]) - shift, time[0], time[-1])
    moved = CubicSpline(time, planned)(at)
    width = 1 + 2 * int(0.5 * blend / np.median(np.diff(time)))
    return uniform_filter1d(moved, width, axis=0, mode="nearest") if width > 1 else moved


def _fit(time: np.ndarray, planned: np.ndarray, executed: np.ndarray) -> tuple[float, float, float]:
    """Rate, shift and blend of one log: a coarse grid of rates, then least squares."""
    from scipy.optimize import least_squares

    thin = slice(None, None, max(1, len(time) // 3000))
    t, p, e = time[thin], planned[thin], executed[thin]
    size = np.maximum(np.std(p, axis=0), 1e-3)

    def error(x: np.ndarray) -> np.ndarray:
        return ((_executed(t, p, x[0], x[1], 0.0) - e) / size).ravel()

    start = min(
        ((rate, shift) for rate in (0.94, 0.97, 0.985, 1.0, 1.015, 1.03, 1.06) for shift in (-0.02, 0.0, 0.02)),
        key=lambda x: float(np.sum(error(np.array(x)) ** 2)),
    )
    rate, shift = least_squares(error, start, x_scale=(1e-3, 1e-3), max_nfev=60).x
    blends = (0.0, 0.01, 0.02, 0.04, 0.06, 0.1, 0.15, 0.25)
    blend = min(blends, key=lambda w: float(np.sum((_executed(time, planned, rate, shift, w) - executed) ** 2)))
    return float(rate), float(shift), blend


def _floor(logs: Sequence[Log], errors: Sequence[np.ndarray]) -> np.ndarray | None:
    parts = []
    for log, error in zip(logs, errors, strict=True):
        starts = np.asarray(log.cycle_starts)
        if len(starts) < 2 or len(error) != len(log.t):
            continue
        length = int(np.min(np.diff(starts)) * log.sample_rate)
        first = [int(np.searchsorted(log.t, s - 1e-9)) for s in starts]
        cycles = [error[a : a + length] for a in first if a + length <= len(error)]
        parts += [b - a for a, b in pairwise(cycles)]
    return np.sqrt(0.5) * _rms(parts) if parts else None
