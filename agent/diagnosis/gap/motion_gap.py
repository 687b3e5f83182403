"""Planned against executed set-points: r(t) ≈ p(a t + b), p averaged over a short time.

A plan is laid onto a log from stop to stop (`agent.link.Aligner`): each way begins when the controller begins it,
however long the one before took. So t counts from the last stop, unless the log's own time explains more: a plan may
also be that of the whole log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from agent.diagnosis.document import Cause
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.recording import SHORTEST_STOP, Log

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_RATES = np.linspace(0.94, 1.06, 9)  # numerical: where the fit of a rate may start
_BLENDS = 26  # numerical: times that are tried, `path_time` apart
_ROWS = 3000  # numerical: of a log, for the fit of rate and shift


@dataclass(frozen=True, eq=False)
class MotionGap:
    """RMSE before and after the fit, and repeatability (n,) [rad]; rate a, shift b [s] and blend [s] of the fit.

    Rate, shift and blend are 1, 0 and 0 if the fit does not improve the gap by a practical size.
    """

    before: np.ndarray
    after: np.ndarray
    floor: np.ndarray | None
    rate: float
    shift: float
    blend: float

    @property
    def notable(self) -> bool:
        """Whether there is anything to explain."""
        return bool(self.before.max() > LIMITS.path_gap)

    @property
    def described(self) -> bool:
        """Whether there is something to explain, and rate, shift and blend that all motions share explain it."""
        return self.notable and (self.closure or 0.0) >= LIMITS.explained

    def causes(self, of_path: Sequence[str]) -> list[Cause] | None:
        """The gap as a cause, by the first of these effects, if any; None if nothing explains it."""
        parameters = {"rate": self.rate, "shift": self.shift, "blend": self.blend}
        named = [Cause(name, (), self.closure, LAW.confidence, parameters) for name in of_path[:1]]
        return named if self.described else None

    @property
    def practical(self) -> bool:
        """Whether rate, shift or blend are of a size that matters: every interpolator has a small error."""
        latest = max(abs(self.shift), self.blend)
        return abs(self.rate - 1.0) > LIMITS.path_rate or latest > LIMITS.path_time

    @property
    def closure(self) -> float | None:
        """Part of the motion gap that is explained."""
        b, a = np.mean(self.before**2), np.mean(self.after**2)
        return float((b - a) / b) if b > 0 else None


def motion_gap(logs: Sequence[Log]) -> MotionGap | None:
    """The gap over all logs; None where a log lacks planned or executed set-points."""
    pairs: list[_Pair] = []
    for log in logs:
        if log.planned_position is None or log.reference_position is None:
            return None
        good = np.all(np.isfinite(log.planned_position) & np.isfinite(log.reference_position), axis=1)
        if good.sum() < LIMITS.min_samples:
            return None
        pairs.append(_Pair(log.t[good], log.planned_position[good], log.reference_position[good]))
    before = _rms([pair.executed - pair.planned for pair in pairs])
    as_it_is = MotionGap(before, before, _floor(logs, [p.executed - p.planned for p in pairs]), 1.0, 0.0, 0.0)
    if not as_it_is.notable:
        return as_it_is
    stopped = [replace(pair, starts=_after_stops(pair)) for pair in pairs]
    tried = [gap for some in (pairs, stopped) if (gap := _described(logs, some, before)) is not None]
    best = min(tried, key=lambda gap: float(np.sum(gap.after**2)), default=as_it_is)
    # other corners and ramps are no change of rate: what one motion teaches then makes another one worse
    return best if best.practical and np.sum(best.after**2) < np.sum(before**2) else as_it_is


@dataclass(frozen=True, eq=False)
class _Pair:
    """Planned and executed set-points (S, n) of a log over time (S,) [s], and times [s] where the plan starts anew."""

    time: np.ndarray
    planned: np.ndarray
    executed: np.ndarray
    starts: np.ndarray = field(default_factory=lambda: np.empty(0))

    @cached_property
    def stretches(self) -> list[tuple[np.ndarray, np.ndarray, CubicSpline | None]]:
        """Times, planned set-points and a curve through them between starts; no curve through a few points."""
        from scipy.interpolate import CubicSpline

        cuts = np.searchsorted(self.time, self.starts)
        return [
            (time, planned, CubicSpline(time, planned) if len(time) >= LIMITS.min_samples else None)
            for time, planned in zip(np.split(self.time, cuts), np.split(self.planned, cuts), strict=True)
        ]


def _described(logs: Sequence[Log], pairs: Sequence[_Pair], before: np.ndarray) -> MotionGap | None:
    """The gap with rate and blend of the other logs, and a shift of each; None if this increases the gap of a motion.

    Corners of a large motion may look like a rate, which a small motion then refutes. If the plan starts again at every
    stop, the shift also comes from the other logs: it does not contain the clock of the log.
    """
    fitted = [_fit(pair) for pair in pairs]
    errors = []
    for number, pair in enumerate(pairs):
        others = [parameters for k, parameters in enumerate(fitted) if k != number] or fitted
        rate, shift, blend = (float(np.median([other[k] for other in others])) for k in range(3))
        errors.append(pair.executed - _executed(pair, rate, shift if len(pair.starts) else fitted[number][1], blend))
        if _rms(errors[-1:]).max() > max(_rms([pair.executed - pair.planned]).max(), LIMITS.path_gap):
            return None
    rate, shift, blend = (float(np.median([parameters[k] for parameters in fitted])) for k in range(3))
    return MotionGap(before, _rms(errors), _floor(logs, errors), rate, shift, blend)


def _after_stops(pair: _Pair) -> np.ndarray:
    """Times [s] at which the executed set-points move again after a standstill, or the plan continues."""
    moves = np.any(np.diff(pair.executed, axis=0) != 0.0, axis=1)
    changes, period = np.flatnonzero(moves), float(np.median(np.diff(pair.time)))
    if not len(changes):
        return np.empty(0)
    resumed = changes[np.flatnonzero(np.diff(changes) > round(SHORTEST_STOP / period)) + 1]
    gaps = np.flatnonzero(np.round(np.diff(pair.time) / period) > 1) + 1
    return np.asarray(pair.time[np.union1d(resumed, gaps)])


def _rms(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0))


def _executed(pair: _Pair, rate: float, shift: float, blend: float) -> np.ndarray:
    """(S, n) set-points of a plan run at another rate, later by `shift` and averaged over `blend`."""
    from scipy.ndimage import uniform_filter1d

    width = 1 + 2 * int(0.5 * blend / np.median(np.diff(pair.time)))
    parts = []
    for time, planned, curve in pair.stretches:
        if curve is not None:
            plan_time = np.clip(time[0] + rate * (time - time[0]) - shift, time[0], time[-1])
            planned = curve(plan_time)
            planned = uniform_filter1d(planned, width, axis=0, mode="nearest") if width > 1 else planned
        parts.append(planned)
    return np.concatenate(parts)


def _fit(pair: _Pair) -> tuple[float, float, float]:
    """Rate, shift and blend of one log: a coarse grid of rates, then least squares."""
    from scipy.optimize import least_squares

    step = slice(None, None, max(1, len(pair.time) // _ROWS))
    thin = replace(pair, time=pair.time[step], planned=pair.planned[step], executed=pair.executed[step])
    size = np.maximum(np.std(thin.planned, axis=0), LIMITS.least_travel)

    def error(x: np.ndarray) -> np.ndarray:
        return ((_executed(thin, x[0], x[1], 0.0) - thin.executed) / size).ravel()

    start = min(
        ((rate, shift) for rate in _RATES for shift in 2 * LIMITS.path_time * np.array([-1, 0, 1])),
        key=lambda x: float(np.sum(error(np.array(x)) ** 2)),
    )
    rate, shift = least_squares(error, start).x
    blends = LIMITS.path_time * np.arange(_BLENDS)
    blend = min(blends, key=lambda w: float(np.sum((_executed(pair, rate, shift, w) - pair.executed) ** 2)))
    return float(rate), float(shift), float(blend)


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
