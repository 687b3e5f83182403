"""The controller's samples from the rows that the C5G Open node publishes.

The published node sleeps one period, reads the last snapshot, and stamps it with its PC's clock: rows are uneven, show
a snapshot twice or leave one out, and their currents may be of the snapshot after that of their positions. But the
controller makes set-points at an even period T, so a row read at t has snapshot n = floor((t - p) / T), and only the
phase p is unknown. It is the one for which the set-points are smoothest over n.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from drivers.wire.cnr import CHANNELS, CURRENTS, POSITIONS, TARGET_POSITIONS, TARGET_VELOCITIES, VELOCITIES

_AHEAD = 80  # rows that have come after a row before it is given out: they tell the phase of its time
_BEHIND = 80  # rows before it that do
_EVERY = 40  # rows from one estimate of the phase to the next
_PHASES, _FINE = 40, 21  # that are tried over a period, and about the best of them
_UNEVEN, _SHARE = 0.005, 0.02  # of a period; of the rows: more that are off the grid by more, and stamps are no times
_SHORT = 0.75  # of a period: no turn of the loop takes less
_LOOKED_AT = 500  # rows that tell whether they are
_ENOUGH = 100  # of these
_TELLING = 1e-3  # deg of set-points' travel below which they tell no phase
_CUBIC = 4  # snapshots through which the set-points are continued to the next row
_TRIALS = np.array([0.0, -1.0, 1.0])  # numbers that it may be off by
_CLEARLY = 0.3  # times the distance from there
_WORSE = 2.0  # times the smallest roughness: such a phase is wrong
_IDLE = 0.3  # s without a row after which what waits is given out

_POSITION, _VELOCITY, _TARGET, _TARGET_VELOCITY, _CURRENT = map(
    CHANNELS.index, (POSITIONS, VELOCITIES, TARGET_POSITIONS, TARGET_VELOCITIES, CURRENTS)
)
_DERIVED = {_VELOCITY: _POSITION, _TARGET_VELOCITY: _TARGET}


@dataclass(eq=False)
class Rows:
    """Rows of the node: times (K,) [µs], by how much the currents were read later (K,) [µs], values (K, 5, 10)."""

    times: np.ndarray
    late: np.ndarray
    values: np.ndarray

    def part(self, chosen: slice | np.ndarray) -> Rows:
        """Some of them."""
        return Rows(self.times[chosen], self.late[chosen], self.values[chosen])

    def and_then(self, other: Rows) -> Rows:
        """These, and others after them."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Rows(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class NodeFacts:
    """What the node really gave: rows, their mean period and its deviation [s], and what was done about them."""

    rows: int = 0
    period: float = 0.0
    jitter: float = 0.0
    repeated: int = 0  # rows of a snapshot that was there already
    currents_between: int = 0  # currents that were interpolated: those of this snapshot were not published
    derived: tuple[str, ...] = ()  # topics without a value of their own

    @property
    def facts(self) -> dict[str, str]:
        """For the log; nothing where rows are the controller's own samples."""
        if not self.rows:
            return {}
        return {
            "node_rate_hz": f"{1 / self.period:.1f}",
            "node_jitter_s": f"{self.jitter:.3g}",
            "node_rows": str(self.rows),
            "node_repeated": str(self.repeated),
            "node_currents_between": str(self.currents_between),
            "node_derived": " ".join(self.derived) or "none",
        }


class SnapshotClock:
    """Rows in, samples on the controller's even times out. One thread. Bounded memory.

    Rows on an even grid already go through as they are.

    Args:
        period: of the controller's set-points [µs].
    """

    def __init__(self, period: float) -> None:
        self._seen = 0
        self.active = False
        self._period = period
        self._filled = np.zeros(len(CHANNELS), bool)
        self._steps = np.empty(0)
        self._newest = 0  # time of the last row [µs]
        self._came = time.monotonic()
        self._facts = NodeFacts()
        self._forget()

    def _forget(self) -> None:
        self._rows: Rows | None = None
        self._given_out = 0  # of them: rows before are kept to tell the phase
        self._numbers = np.empty(0)  # of these
        self._estimated = 0  # rows that had come when the phase was estimated last
        self._phase: float | None = None  # [µs]
        self._determined = False  # by set-points, that is
        self._zero: float | None = None  # time of snapshot number 0 [µs]
        self._last = -(2**62)  # number of the last snapshot given out

    @property
    def facts(self) -> NodeFacts:
        """Since `begin`."""
        times = self._steps * 1e-6
        if not self.active or len(times) == 0:
            return NodeFacts()
        derived = tuple(CHANNELS[k] for k in _DERIVED if not self._filled[k])
        return replace(self._facts, period=float(times.mean()), jitter=float(times.std()), derived=derived)

    @property
    def has_enough(self) -> bool:
        """`begin` can tell whether the stamps are those of a loop. From any thread."""
        return len(self._steps) >= _ENOUGH

    def leave_out(self, channels: set[int]) -> None:
        """These are not published at all, so there is always something to derive."""
        self.active = self.active or bool(channels)

    def begin(self) -> None:
        """A motion is about to start: are stamps those of a loop? Count anew from here on.

        Short steps are none of a loop that sleeps a period: whoever stamps so is late now and then, and in order.
        """
        steps = self._steps / self._period
        if len(steps) and np.mean(np.abs(steps - np.round(steps)) > _UNEVEN) > _SHARE:
            self.active |= bool(np.quantile(steps, 2 * _SHARE) > _SHORT)
        self._facts = NodeFacts()

    def add(self, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Times (K,) [µs] and values (K, 5, 10) of the snapshots that are known now.

        Each snapshot comes once; one that the node left out is missing. Velocities that the node never filled are the
        differences of positions, currents of another snapshot are interpolated.
        """
        now = time.monotonic()
        if len(rows.times):
            self._seen += len(rows.times)
            self._came = now
            self._filled |= np.any(rows.values != 0.0, axis=(0, 2))
            steps = np.diff(rows.times, prepend=self._newest)[0 if self._newest else 1 :]
            self._newest = int(rows.times[-1])
            self._steps = np.concatenate([self._steps, steps])[-_LOOKED_AT:]
            back = bool(np.any(steps < 0))
            if not self.active or back:  # a clock that was set back is for others to judge
                self._forget()
                return rows.times, rows.values
            self._rows = rows if self._rows is None else self._rows.and_then(rows)
        if self._rows is None:
            return rows.times, rows.values
        stop = len(self._rows.times) - (0 if now - self._came > _IDLE else _AHEAD)
        if stop <= self._given_out:
            return rows.times[:0], rows.values[:0]
        if self._phase is None or self._seen - self._estimated >= _EVERY:
            self._estimated = self._seen
            self._find_phase(self._rows)
        assert self._phase is not None
        samples = self._samples(self._rows, self._given_out, stop, self._phase)
        first = max(0, stop - _BEHIND)  # a few of those that are given out still tell the phase
        self._rows, self._given_out = self._rows.part(slice(first, None)), stop - first
        return samples

    def _find_phase(self, rows: Rows) -> None:
        """The phase for which set-points are smooth, as near to the known one as it may be."""
        period, targets = self._period, rows.values[:, _TARGET]
        start = float(rows.times[0]) - 0.5 * period if self._phase is None else self._phase
        self._phase = start
        travel = np.abs(np.diff(targets, axis=0)).sum(axis=0)
        targets = targets[:, travel > _TELLING]
        if not targets.size:
            return

        def rough(trials: np.ndarray) -> np.ndarray:
            return np.array([_roughness(np.floor((rows.times - start - trial) / period), targets) for trial in trials])

        cell = period / _PHASES
        coarse = rough(cell * np.arange(_PHASES))
        best, good = int(np.argmin(coarse)), coarse <= _WORSE * coarse.min()
        low = high = best
        while not good.all() and good[(high + 1) % _PHASES]:
            high += 1
        while not good.all() and good[(low - 1) % _PHASES]:
            low -= 1
        edges = cell * np.array([low, high])
        if low == high:  # between the trials one may be better still
            trials = cell * (best + np.linspace(-1, 1, _FINE))
            fine = rough(trials)
            good = np.append(coarse[:1], fine) <= _WORSE * fine.min()
            edges = trials[np.flatnonzero(good[1:])[[0, -1]]]
        if good[0] and (self._determined or good.all()):
            return
        edges -= period * np.round(edges.mean() / period)  # the phase is the same a period on
        self._phase = start + float(np.clip(0.0, *edges) if self._determined else edges.mean())
        self._determined = True

    def _samples(self, rows: Rows, start: int, stop: int, phase: float) -> tuple[np.ndarray, np.ndarray]:
        """Times [µs] and values of rows `start` to `stop`, each snapshot once."""
        period = self._period
        periods = (rows.times - phase) / period
        number = np.floor(periods)
        number[:start] = self._numbers
        number = _followed(number, rows.values[:, _TARGET], start, stop + _CUBIC)
        self._numbers = number[max(0, stop - _BEHIND) : stop]
        new = np.flatnonzero(np.diff(number, prepend=-np.inf) > 0)  # the first row of each snapshot
        chosen = new[(new >= start) & (new < stop)]
        chosen = chosen[number[chosen] > self._last]
        values = rows.values[chosen].copy()
        if len(chosen) == 0:
            self._count(stop - start, 0, 0)
            return rows.times[:0], values
        self._last = int(number[chosen[-1]])
        for target, source in _DERIVED.items():
            if not self._filled[target] and len(new) > 1:
                rate = np.gradient(rows.values[new, source], number[new] * period * 1e-6, axis=0)
                values[:, target] = rate[np.searchsorted(new, chosen)]
        ahead = np.median(number - np.floor(periods))  # where the set-points say that the phase is a period off
        currents = np.maximum.accumulate(np.maximum(number, np.floor(periods + rows.late / period) + ahead))
        kinds, at = np.unique(currents, return_index=True)
        series = rows.values[at, _CURRENT]
        values[:, _CURRENT] = np.column_stack([np.interp(number[chosen], kinds, column) for column in series.T])
        self._count(stop - start, len(chosen), int(np.sum(~np.isin(number[chosen], kinds))))
        if self._zero is None:  # fixed once: times stay even where the phase moves
            self._zero = phase + 0.5 * period
        return (self._zero + number[chosen] * period).astype(np.int64), values

    def _count(self, rows: int, snapshots: int, between: int) -> None:
        facts = self._facts
        self._facts = NodeFacts(
            facts.rows + rows,
            repeated=facts.repeated + rows - snapshots,
            currents_between=facts.currents_between + between,
        )


def _followed(number: np.ndarray, targets: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Numbers (K,) of snapshots that rise, each off by one at most; those before row `start` are right.

    Rows from `start` to `stop` are of the snapshot that continues the set-points (K, n), where that is clearly another.
    """
    others = ~np.eye(_CUBIC, dtype=bool)
    for k in range(start, min(stop, len(number))):
        first = max(0, k - 2 * _CUBIC)
        at = first + np.unique(number[first:k], return_index=True)[1][-_CUBIC:]
        nodes = number[at] - number[k]
        if len(nodes) < _CUBIC or nodes[-1] - nodes[0] > 4 * _CUBIC:
            continue
        weights = np.prod(np.where(others, _TRIALS[:, None, None] - nodes, 1.0), axis=2)
        weights /= np.prod(nodes[:, None] - nodes, axis=1, where=others)
        off = np.linalg.norm(weights @ targets[at] - targets[k], axis=1)
        best = int(np.argmin(off))
        if off[best] < _CLEARLY * off[0]:
            number[k] += _TRIALS[best]
    return np.maximum.accumulate(number)


def _roughness(number: np.ndarray, targets: np.ndarray) -> float:
    """Mean square by which set-points (K, n) with these snapshot numbers (K,) miss the cubic through their neighbours,
    or another row of their own snapshot."""
    new = np.diff(number, prepend=-np.inf) > 0
    same = np.flatnonzero(~new)
    missed = float(np.sum((targets[same] - targets[same - 1]) ** 2)) if len(same) else 0.0
    x, y = number[new], targets[new]
    if len(x) < 5:
        return missed
    nodes = np.stack([x[k : len(x) - 4 + k] - x[2 : len(x) - 2] for k in (0, 1, 3, 4)])
    guess = np.zeros_like(y[2:-2])
    for j, k in enumerate((0, 1, 3, 4)):
        others = np.delete(nodes, j, axis=0)
        guess += (np.prod(others, axis=0) / np.prod(others - nodes[j], axis=0))[:, None] * y[k : len(y) - 4 + k]
    return (missed + float(np.sum((guess - y[2:-2]) ** 2))) / len(number)
