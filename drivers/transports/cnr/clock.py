"""The two clocks of one arm: the controller's milliseconds and the samples' microseconds, aligned by what both saw.

Both report the same joint positions. Where the arm moves with velocity v, a feedback's position p(t) and the samples'
q(t') agree at one offset o only: with d = p(t) - q(t + o), the next o is o + <v, d> / <v, v> (Gauss-Newton for one
unknown). Every feedback in motion gives one such offset. The median of the newest is the offset of the clocks, so that
their drift does not count.
"""

from __future__ import annotations

from collections import deque

import numpy as np

#: The arm has begun to move when a joint is so far from where it stood [rad, or m].
_MOVED = np.radians(0.02)
#: Lowest speed (norm over joints) at which a feedback gives the time [rad/s].
_FAST = 0.05
#: The beginnings of motion that both clocks saw agree within this [s].
_REACH = 0.08
#: Remaining difference of positions that shows a failed search [rad, or m].
_ASTRAY = np.radians(0.2)
_KEPT = 10.0  # s of samples
_BATCH = 10  # feedbacks
_NEWEST, _FEWEST = 50, 5  # estimates
#: The controller counts whole milliseconds [s]; its time lies anywhere in the one that has begun.
_RESOLUTION = 0.001


class ClockMatch:
    """Aligns the clocks during one motion, from its beginning on. Bounded memory."""

    def __init__(self) -> None:
        self._feedback = _Beginning()
        self._samples = _Beginning()
        self._pending: deque[tuple[float, np.ndarray]] = deque()
        self._times: deque[np.ndarray] = deque()
        self._positions: deque[np.ndarray] = deque()
        self._estimates: deque[float] = deque(maxlen=_NEWEST)

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

    def offset(self) -> float | None:
        """How far the samples' clock is ahead of the controller's now [s]; None before the arm has moved."""
        self._match()
        return self._coarse() if len(self._estimates) < _FEWEST else float(np.median(self._estimates))

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
        offset = float(np.median(self._estimates)) if self._estimates else coarse
        ready = []
        while self._pending and self._pending[0][0] + offset + 2 * _REACH < self._times[-1][-1]:
            ready.append(self._pending.popleft())
        if not ready:
            return
        times, positions = np.concatenate(self._times), np.concatenate(self._positions)
        when, where = np.array([t for t, _ in ready]), np.array([p for _, p in ready])
        first = max(0, int(np.searchsorted(times, when[0] + offset - 2 * _REACH)) - 1)
        self._estimates.extend(_offsets(times[first:], positions[first:], when, where, offset))


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
) -> list[float]:
    """The offsets near `start` of the feedbacks (`when`, `where`) that tell one."""
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
    return [float(one) for one in offset[inside & (speed > _FAST**2) & (left < _ASTRAY)]]


def _interpolated(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(at, times, column) for column in values.T])
