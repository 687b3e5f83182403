"""Two clocks of one arm: the controller's milliseconds and the samples' microseconds, aligned by what both saw.

Both report the same joint positions. Where the arm moves with velocity v, a feedback's position p(t) and the samples'
q(t') agree at one offset only: with d = p(t) - q(t + o), the next o is o + <v, d> / <v, v> (Gauss-Newton for one
unknown). Every feedback in motion gives one such offset; a straight line through them is offset and drift.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

#: The arm has begun to move when a joint is so far from where it stood [rad, or m].
_MOVED = np.radians(0.02)
#: A feedback tells the time where the arm is at least so fast (norm over joints) [rad/s].
_FAST = 0.05
#: The beginnings of motion that both clocks saw agree within this [s].
_REACH = 0.08
#: Positions still differ by so much where the search went astray [rad, or m].
_ASTRAY = np.radians(0.2)
_KEPT = 10.0  # s of samples
_BATCH = 10  # feedbacks
_MOST_ESTIMATES = 20_000
_FEWEST_ESTIMATES = 5
#: The controller counts whole milliseconds [s]; its time lies anywhere in the one that has begun.
_RESOLUTION = 0.001


@dataclass(frozen=True)
class Alignment:
    """Sample time = controller time + `offset` at controller time `middle` [s], growing by `drift` seconds a second.

    Deviations: `offset_deviation` [s] includes the controller's resolution; `count` feedbacks it is taken from.
    """

    middle: float
    offset: float
    offset_deviation: float
    drift: float
    drift_deviation: float
    count: int

    @property
    def facts(self) -> dict[str, str]:
        """For the log, by names that end in their unit."""
        return {
            "clock_offset_s": f"{self.offset:.9f}",
            "clock_offset_uncertainty_s": f"{self.offset_deviation:.3g}",
            "clock_offset_at_controller_time_s": f"{self.middle:.3f}",
            "clock_drift_ppm": f"{1e6 * self.drift:.3g}",
            "clock_drift_uncertainty_ppm": f"{1e6 * self.drift_deviation:.3g}",
            "clock_feedbacks": str(self.count),
        }

    def sample_time(self, controller_time: float) -> float:
        """[s] on the clock of the samples."""
        return controller_time + self.offset + self.drift * (controller_time - self.middle)


class ClockMatch:
    """Aligns the clocks during one motion, from its beginning on. Bounded memory."""

    def __init__(self) -> None:
        self._feedback = _Beginning()
        self._samples = _Beginning()
        self._pending: deque[tuple[float, np.ndarray]] = deque()
        self._times: deque[np.ndarray] = deque()
        self._positions: deque[np.ndarray] = deque()
        self._estimates: list[tuple[float, float]] = []

    @property
    def controller_moved_at(self) -> float | None:
        """Controller time [s] at which a feedback saw the arm begin to move; None before."""
        return self._feedback.time

    def feedback(self, time: float, position: np.ndarray) -> None:
        """Where the arm was (n,) at a controller time [s], in whole milliseconds."""
        time += _RESOLUTION / 2
        self._feedback.look(np.array([time]), position[None, :])
        self._pending.append((time, position))
        if len(self._pending) >= _BATCH:
            self._match()

    def samples(self, times: np.ndarray, positions: np.ndarray) -> None:
        """Where the arm was (K, n) at sample times (K,) [s]."""
        self._samples.look(times, positions)
        self._times.append(times)
        self._positions.append(positions)
        while len(self._times) > 1 and self._times[0][-1] < times[-1] - _KEPT:
            self._times.popleft()
            self._positions.popleft()

    def alignment(self) -> Alignment | None:
        """What is known now; None before the arm has moved."""
        self._match()
        coarse = self._coarse()
        if coarse is None:
            return None
        if len(self._estimates) < _FEWEST_ESTIMATES:
            assert self._feedback.time is not None
            return Alignment(self._feedback.time, coarse, _REACH / 2, 0.0, float("nan"), len(self._estimates))
        return _line(np.array(self._estimates))

    def _coarse(self) -> float | None:
        if self._feedback.time is None or self._samples.time is None:
            return None
        return self._samples.time - self._feedback.time

    def _match(self) -> None:
        coarse = self._coarse()
        if coarse is None or not self._times:
            while len(self._pending) > 50 * _KEPT:
                self._pending.popleft()
            return
        offset = coarse if not self._estimates else float(np.median([o for _, o in self._estimates[-50:]]))
        ready = []
        while self._pending and self._pending[0][0] + offset + 2 * _REACH < self._times[-1][-1]:
            ready.append(self._pending.popleft())
        if not ready or len(self._estimates) >= _MOST_ESTIMATES:
            return
        times, positions = np.concatenate(self._times), np.concatenate(self._positions)
        when, where = np.array([t for t, _ in ready]), np.array([p for _, p in ready])
        first = max(0, int(np.searchsorted(times, when[0] + offset - 2 * _REACH)) - 1)
        self._estimates += _offsets(times[first:], positions[first:], when, where, offset)


class _Beginning:
    """When the arm began to move."""

    def __init__(self) -> None:
        self.time: float | None = None
        self._rest: np.ndarray | None = None
        self._last: tuple[float, float] | None = None

    def look(self, times: np.ndarray, positions: np.ndarray) -> None:
        if self.time is not None or len(times) == 0:
            return
        if self._rest is None:
            self._rest = positions[0]
        away = np.abs(positions - self._rest).max(axis=1)
        beyond = np.flatnonzero(away > _MOVED)
        if len(beyond) == 0:
            self._last = (float(times[-1]), float(away[-1]))
            return
        k = int(beyond[0])
        if k > 0:
            self._last = (float(times[k - 1]), float(away[k - 1]))
        time, distance = float(times[k]), float(away[k])
        if self._last is not None:
            # From rest the way grows with the square of time.
            before, near = self._last
            part = (np.sqrt(_MOVED) - np.sqrt(near)) / (np.sqrt(distance) - np.sqrt(near))
            time = before + float(part) * (time - before)
        self.time = time


def _offsets(
    times: np.ndarray, positions: np.ndarray, when: np.ndarray, where: np.ndarray, start: float
) -> list[tuple[float, float]]:
    """(controller time, offset) of the feedbacks (`when`, `where`) that tell one, near `start`."""
    if len(times) < 3:
        return []
    velocities = np.gradient(positions, times, axis=0)
    offset = np.full(len(when), start)
    for _ in range(4):
        at = when + offset
        q = _interpolated(at, times, positions)
        v = _interpolated(at, times, velocities)
        speed = np.sum(v**2, axis=1)
        step = np.sum(v * (where - q), axis=1) / np.maximum(speed, _FAST**2)
        offset = np.clip(offset + step, start - _REACH, start + _REACH)
    inside = (when + offset > times[0]) & (when + offset < times[-1]) & (np.abs(offset - start) < 0.99 * _REACH)
    left = np.abs(where - _interpolated(when + offset, times, positions)).max(axis=1)
    usable = inside & (speed > _FAST**2) & (left < _ASTRAY)
    return [(float(t), float(o)) for t, o in zip(when[usable], offset[usable], strict=True)]


def _interpolated(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(at, times, column) for column in values.T])


def _line(estimates: np.ndarray) -> Alignment:
    """A straight line through (time, offset) pairs (K, 2), without the ones far off it."""
    kept = np.ones(len(estimates), bool)
    for _ in range(3):
        time, offset = estimates[kept].T
        middle = float(time.mean())
        spread = float(np.sum((time - middle) ** 2))
        level = float(offset.mean())
        drift = float((time - middle) @ (offset - level) / spread) if spread > 0 else 0.0
        left = estimates[:, 1] - level - drift * (estimates[:, 0] - middle)
        scale = 1.4826 * float(np.median(np.abs(left[kept])))
        kept = np.abs(left) <= max(4.0 * scale, _RESOLUTION)
        if kept.sum() < _FEWEST_ESTIMATES:
            kept = np.ones(len(estimates), bool)
    count = int(kept.sum())
    deviation = float(np.sqrt(np.sum(left[kept] ** 2) / max(1, count - 2)))
    return Alignment(
        middle=middle,
        offset=level,
        offset_deviation=float(np.hypot(deviation / np.sqrt(count), _RESOLUTION / np.sqrt(12.0))),
        drift=drift,
        drift_deviation=deviation / np.sqrt(spread) if spread > 0 else float("nan"),
        count=count,
    )
