"""What we planned, laid onto the controller's set-points."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.safety import is_there

if TYPE_CHECKING:
    from agent.motion import Trajectory


class Aligner:
    """Lays what we planned, from stop to stop, onto the controller's set-points.

    The controller waits for the arm to settle at each stop, so only the segments between stops are comparable in
    time. Where the numbers of segments differ there is nothing to compare, and nothing is written.

    A motion may last for hours, so set-points are looked at as they come and only their stamps are kept, compressed.
    """

    #: Shortest rest [s] of the set-points that counts as a stop.
    REST = 0.006

    def __init__(self, chains: Sequence[Trajectory], period: float):
        self._chains = chains
        self._segments = MovingSegments(round(self.REST / period))
        self._stamps = Stamps()
        self._seen = True  # set-points, with every block
        self._first = self._last = 0.0  # time [s] of samples
        self.samples = 0
        self.cycle_starts: list[float] = []

    def take(self, time: np.ndarray, reference: np.ndarray | None) -> None:
        if self.samples and time[0] <= self._last:
            return  # they came before
        self._first = float(time[0]) if self.samples == 0 else self._first
        self._last = float(time[-1])
        self.samples += len(time)
        if reference is None:
            self._seen = False
        else:
            self._stamps.add(time)
            self._segments.add(reference)

    @property
    def elapsed(self) -> float:
        return self._last - self._first

    def finish(self, write_planned: Callable[[np.ndarray, np.ndarray, np.ndarray], None]) -> list[float]:
        """Write the planned set-points; returns the controller times at which cycles start (all but the approach)."""
        segments = self._segments.found
        chains, approaches = self._chains, 1
        if len(segments) == len(chains) - 1 and is_there(chains[0]):
            chains, approaches = chains[1:], 0  # the arm stood at the first point already
        if not self._seen or not segments or len(segments) != len(chains):
            return []
        motion = list(zip(segments, chains, strict=True))
        # A program with stops in its cycle repeats where it makes the same way again, not at every stop.
        cycles = {start for (start, _), chain in motion[approaches:] if chain is motion[approaches:][0][1]}
        starts, at = [], 0
        for stamps in self._stamps.parts():
            for (start, _), chain in motion:
                first, last = max(start, at), min(start + len(chain.t), at + len(stamps))
                if first < last:
                    planned = slice(first - start, last - start)
                    write_planned(stamps[first - at : last - at], chain.q[planned], chain.qd[planned])
                if start in cycles and at <= start < at + len(stamps):
                    starts.append(float(stamps[start - at]))
            at += len(stamps)
        self.cycle_starts = [start - self._first for start in starts]
        return starts


class MovingSegments:
    """[start, stop) ranges of set-points between rests of at least `rest` samples, as the set-points come.

    A range starts at the last sample before the first change and ends after the last change.
    """

    def __init__(self, rest: int) -> None:
        self.found: list[tuple[int, int]] = []
        self._rest = rest
        self._count = 0
        self._last: np.ndarray | None = None

    def add(self, reference: np.ndarray) -> None:
        """The next set-points (K, n)."""
        before = reference[:1] if self._last is None else self._last[None]
        moved = np.any(np.diff(reference, axis=0, prepend=before) != 0.0, axis=1)
        changes = self._count - 1 + np.flatnonzero(moved)
        for run in np.split(changes, np.flatnonzero(np.diff(changes) > self._rest) + 1):
            if len(run) == 0:
                continue
            start, stop = int(run[0]), int(run[-1]) + 2
            if self.found and start - (self.found[-1][1] - 2) <= self._rest:
                start, _ = self.found.pop()
            self.found.append((start, stop))
        self._count += len(reference)
        self._last = np.array(reference[-1])


def moving_segments(reference: np.ndarray, rest: int) -> list[tuple[int, int]]:
    """The `MovingSegments` of (S, n) set-points."""
    segments = MovingSegments(rest)
    if len(reference):
        segments.add(reference)
    return segments.found


class Stamps:
    """Times [s] in nearly no memory: to the nanosecond, by how they differ from an even step."""

    _TOGETHER = 4096

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self._open: list[np.ndarray] = []

    def add(self, time: np.ndarray) -> None:
        """The next times (K,) [s]."""
        self._open.append(np.rint(1e9 * np.asarray(time)).astype(np.int64))
        if sum(map(len, self._open)) >= self._TOGETHER:
            self._pack()

    def parts(self) -> Iterator[np.ndarray]:
        """All times, in order, in arrays (K,) [s]."""
        self._pack()
        for part in self._packed:
            yield 1e-9 * np.frombuffer(zlib.decompress(part), np.int64).cumsum().cumsum()

    def _pack(self) -> None:
        if self._open:
            steps = np.diff(np.diff(np.concatenate(self._open), prepend=0), prepend=0)
            self._packed.append(zlib.compress(steps.tobytes(), 1))
            self._open = []
