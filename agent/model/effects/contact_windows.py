"""Windows of a log in which something pushed: where a constant force on a link leaves least, and stands out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agent.model.signals import MotionSignals

_DURATIONS = (0.2, 0.3, 0.4, 0.55, 0.75, 1.0, 1.35, 1.8, 2.4, 3.2, 4.2, 6.0, 8.5, 12.0)  # s
_STARTS = 0.05  # s
#: A push takes no more of its log than this: what is there all along is no event, and nothing says what is usual.
_MOST_OF_LOG = 0.8
_USUAL, _STANDS_OUT = 0.9, 3.0  # quantile of the other windows of a length, and how far above it a contact is
_SHARP = 100.0  # the same of one that may come back with the cycle beside one that does not
_FROM_START = 20.0  # the same of one that begins with the log, where nothing before it is quiet
_CLEARANCE = 2.0  # durations before and after, where no window comes near it
_BORDER = 0.3  # s from where a motion's samples begin: what there is before tells whether that is quiet
_AGAIN = 0.2  # s that what comes back with the cycle may be early or late
_ALONE = 2.0  # times the window at the same place of another cycle
_MAX_PUSHES, _LEAST_GAIN_RATIO = 30, 0.02  # pushes, and part of the strongest one's gain that another has
_FEW, _RARE = 6, 0.15  # pushes that may last, and part of the time that more of them may have: else it is none
_EDGE_STEPS, _EDGE_PARTS = 8, 40  # by which either end of a push is moved to fit, of so many parts of its length each
_PARTS, _PART = np.linspace(0.13, 0.7, 10), 1 / 6  # of a push, where parts of it begin that are judged for a pause
_PAUSE, _SHOWS = 0.5, 0.1  # of the force, missing there, and of the push's usual gain, that it would have to be


@dataclass(frozen=True)
class PushedWindow:
    """A window in which a force on a link would take `gain` away."""

    gain: float
    link: int
    log: int
    start: float
    duration: float

    def meets(self, other: PushedWindow) -> bool:
        """Whether another push shares time with it."""
        return bool(self.overlaps(other.log, np.array(other.start), other.duration))

    def only_meets(self, other: PushedWindow, late: float) -> bool:
        """Whether it shares time with another `late` [s], neither end with that one's."""
        start, end = other.start + late, other.start + other.duration + late
        apart = abs(self.start - start), abs(self.start + self.duration - end)
        shared = self.start < end and self.start + self.duration > start
        return shared and min(apart) > max(_AGAIN, other.duration / _EDGE_PARTS)

    def overlaps(self, log: int, starts: np.ndarray, duration: float) -> np.ndarray:
        """(K,) bool: which windows of a log it shares time with."""
        return (log == self.log) & (starts < self.start + self.duration) & (starts + duration > self.start)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Running sums over the rows of one motion, time (S',) [s]: moments (S', 3, 3) of the columns of a force, and with
    the error (S', 3)."""

    time: np.ndarray
    gram: np.ndarray
    side: np.ndarray

    def between(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moments (K, 3, 3) of the force's columns, and with the error (K, 3), from `starts` to `ends` (K,) [s]."""
        first = np.searchsorted(self.time, starts)
        last = np.minimum(np.searchsorted(self.time, ends), len(self.time) - 1)
        return self.gram[last] - self.gram[first], self.side[last] - self.side[first]

    def forces(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) what a constant force takes away from `starts` to `ends` (K,) [s], and that force (K, 3) [N]."""
        moments, pull = self.between(starts, ends)
        moments += 1e-6 * np.trace(moments, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        force = np.linalg.solve(moments, pull[:, :, None])[:, :, 0]
        return np.einsum("ka,ka->k", pull, force), force

    def whole(self, starts: np.ndarray, duration: float, gain: np.ndarray, force: np.ndarray) -> np.ndarray:
        """(K,) bool: which forces (K, 3) [N] from `starts` for `duration` [s] pull in the middle of it as well, as far
        as they would show there: else there are two with a pause between."""
        whole = np.ones(len(starts), dtype=bool)
        if duration < 3 * _DURATIONS[0]:
            return whole
        for begin in _PARTS:
            moments, pull = self.between(starts + begin * duration, starts + (begin + _PART) * duration)
            expected = np.einsum("ka,kab,kb->k", force, moments, force)
            missing = expected - np.einsum("ka,ka->k", force, pull)
            whole &= missing <= _PAUSE * expected + _SHOWS * _PART * gain
        return whole


@dataclass(frozen=True, eq=False)
class Windows:
    """All windows of a length in one motion: starts (K,) [s], gain (K,) of a force on a link, from its `sums`; `again`
    (K,) is the largest gain at the same place of another cycle; `whole` (K,): no pause in the middle of it."""

    link: int
    log: int
    duration: float
    starts: np.ndarray
    gain: np.ndarray
    whole: np.ndarray
    cycle_starts: Sequence[float]
    sums: _Sums

    @classmethod
    def of(cls, link: int, signals: MotionSignals, residual: np.ndarray, sigma: np.ndarray) -> Iterator[Windows]:
        """Of every length, from running sums over the rows: moments of the force's columns, and with the error."""
        rows = np.zeros(len(signals.time), dtype=bool)
        rows[signals.kept] = True
        columns = -signals.pushed(link, rows) / sigma[:, None]
        gram = np.cumsum(np.einsum("san,sbn->sab", columns, columns), axis=0)
        side = np.cumsum(np.einsum("san,sn->sa", columns, residual / sigma), axis=0)
        time = signals.time[signals.kept]
        sums = _Sums(time, gram, side)
        for duration in _DURATIONS:
            if duration > _MOST_OF_LOG * (time[-1] - time[0]):
                return
            starts = np.arange(time[0], time[-1] - duration, _STARTS)
            gain, force = sums.forces(starts, starts + duration)
            whole = sums.whole(starts, duration, gain, force)
            yield cls(link, signals.log_index, duration, starts, gain, whole, signals.cycle_starts, sums)

    @cached_property
    def strongest(self) -> PushedWindow | None:
        """The strongest window."""
        return self.best([])

    def best(self, taken: Sequence[PushedWindow]) -> PushedWindow | None:
        """The strongest window beside those taken."""
        gain = np.where(self._shared(taken) | ~self.whole, -np.inf, self.gain)
        at = int(np.argmax(gain))
        if not np.isfinite(gain[at]):
            return None
        return PushedWindow(float(gain[at]), self.link, self.log, float(self.starts[at]), self.duration)

    def fitted(self, push: PushedWindow, taken: Sequence[PushedWindow]) -> PushedWindow:
        """A push of these windows with both ends where it gains most: what it leaves out would be seen beside it."""
        step = max(_STARTS, push.duration / _EDGE_PARTS)
        moved = step * np.arange(-_EDGE_STEPS, _EDGE_STEPS + 1)
        starts, ends = (part.ravel() for part in np.meshgrid(push.start + moved, push.start + push.duration + moved))
        free = (starts >= self.starts[0] + (0 if self.bare(push) else _BORDER)) & (ends <= self.sums.time[-1])
        free &= ends - starts >= _DURATIONS[0] - 1e-9
        free &= ends - starts <= _MOST_OF_LOG * (self.sums.time[-1] - self.sums.time[0])
        for other in taken:
            free &= (other.log != self.log) | (starts >= other.start + other.duration) | (ends <= other.start)
        if not free.any():
            return push
        starts, ends = starts[free], ends[free]
        gain, _ = self.sums.forces(starts, ends)
        at = int(np.argmax(gain))
        return PushedWindow(float(gain[at]), self.link, self.log, float(starts[at]), float(ends[at] - starts[at]))

    def bare(self, push: PushedWindow) -> bool:
        """Whether a push begins where the samples do, so that nothing before it tells whether that is quiet."""
        return push.log == self.log and push.start < self.starts[0] + _BORDER

    def beside(self, taken: Sequence[PushedWindow]) -> np.ndarray:
        """Gains of the windows that share no time with those taken."""
        return self.gain[~self._shared(taken)]

    def near(self, push: PushedWindow, taken: Sequence[PushedWindow]) -> float:
        """Largest gain of the windows right before and after a push that share no time with those taken."""
        reach = (1 + _CLEARANCE) * push.duration
        around = (np.abs(self.starts - push.start) <= reach) & ~self._shared(taken)
        return float(self.gain[around].max(initial=0.0))

    def beside_edges(self, push: PushedWindow) -> float:
        """Largest gain a second of the windows that end just before a push or begin just after it."""
        before, after = push.start - self.duration - self.starts, self.starts - push.start - push.duration
        close = [(gap >= _STARTS) & (gap <= _BORDER) for gap in (before, after)]
        return float(self.gain[close[0] | close[1]].max(initial=0.0)) / self.duration

    def again(self, push: PushedWindow, taken: Sequence[PushedWindow]) -> float:
        """Largest gain at the same place, give or take half a step, of another cycle; nought where there is none.

        Another push that only meets that place, neither end at its own, is no repetition.
        """
        edges = np.asarray(self.cycle_starts, dtype=float)
        here = int(np.searchsorted(edges, push.start + 1e-9)) - 1
        if len(edges) < 2 or here < 0:
            return 0.0
        others = [other for other in taken if other.log == self.log and other is not push]
        late = np.delete(edges, here) - edges[here]
        places = [push.start + by for by in late if not any(other.only_meets(push, by) for other in others)]
        return max(
            (float(self.gain[np.abs(self.starts - at) < 2 * _STARTS].max(initial=0.0)) for at in places), default=0
        )

    def _shared(self, taken: Sequence[PushedWindow]) -> np.ndarray:
        shared = np.zeros(len(self.starts), dtype=bool)
        for push in taken:
            shared |= push.overlaps(self.log, self.starts, self.duration)
        return shared


def strongest(windows: Sequence[Windows]) -> list[PushedWindow]:
    """The strongest windows that do not overlap, as far as they stand out; strongest first."""
    taken: list[PushedWindow] = []
    best = [w.strongest for w in windows]
    spans = [(w.log, float(np.ptp(w.starts)) + w.duration) for w in windows if len(w.starts)]
    lasting = sum(max(span for log, span in spans if log == one) for one in {log for log, _ in spans})
    while len(taken) < _MAX_PUSHES:
        candidates = [(push, w) for push, w in zip(best, windows, strict=True) if push is not None]
        if not candidates:
            break
        push, of_length = max(candidates, key=lambda pair: pair[0].gain)
        if taken and push.gain < _LEAST_GAIN_RATIO * taken[0].gain:
            break
        last = of_length.fitted(push, taken)
        if len(taken) >= _FEW and sum(one.duration for one in (*taken, last)) > _RARE * lasting:
            break  # windows enough would follow any torque
        taken.append(last)
        # where the strongest of a length shares no time with it, it stays the strongest
        best = [w.best(taken) if one and last.meets(one) else one for one, w in zip(best, windows, strict=True)]
    found = [(push, *_beside(push, taken, windows)) for push in taken]
    bare = [push for push in taken if any(w.bare(push) for w in windows)]
    alone = [
        push
        for push, around, again in found
        if push.gain > max((_FROM_START if push in bare else _STANDS_OUT) * around, _ALONE * again)
    ]
    # beside a push that does not come back, one that does and has nothing like it around it is a push as well
    return [p for p, around, _ in found if p in alone or (alone and p.gain > _SHARP * around)]


def _beside(push: PushedWindow, taken: Sequence[PushedWindow], windows: Sequence[Windows]) -> tuple[float, float]:
    """Gain that is usual or near a push, and the one that comes back at its place of another cycle."""
    of_link = [w for w in windows if w.link == push.link]
    here = [w for w in of_link if w.log == push.log]
    as_long = min((w.duration for w in here), key=lambda duration: abs(duration - push.duration))
    scale = push.duration / as_long
    usual = _usual(push, taken, of_link)
    again = scale * max((w.again(push, taken) for w in here if w.duration == as_long), default=0.0)
    near = scale * max((w.near(push, taken) for w in here if w.duration == as_long), default=0.0)
    shortest = [w for w in of_link if w.duration == _DURATIONS[0] and w.log == push.log]
    return max(usual, near, push.duration * max((w.beside_edges(push) for w in shortest), default=0.0)), again


def _usual(push: PushedWindow, taken: Sequence[PushedWindow], windows: Sequence[Windows]) -> float:
    """Gain of a segment as long as a push where none is, from shorter ones where the pushes leave no room for it.

    Infinite where they leave room for none: what is there from the first sample to the last is no event.
    """
    for duration in (length for length in reversed(_DURATIONS) if length <= push.duration):
        parts = [w.beside(taken) for w in windows if w.duration == duration]
        others = np.concatenate([np.zeros(0), *parts])
        if len(others):
            return float(np.quantile(others, _USUAL)) * push.duration / duration
    return np.inf
