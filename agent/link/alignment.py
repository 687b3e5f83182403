"""Alignment of planned set-points with the controller's."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.recording import SHORTEST_STOP
from agent.safety import is_standstill

if TYPE_CHECKING:
    from agent.motion import Trajectory


class Aligner:
    """Aligns planned set-points, from stop to stop, with the controller's.

    The controller waits for the arm to settle at each stop, so only the segments between stops are comparable in
    time. Where the numbers of segments differ there is nothing to compare, and nothing is written.

    A motion may last for hours, so set-points are looked at as they come and only their times are kept.
    """

    def __init__(self, chains: Sequence[Trajectory], period: float, approaches: int = 1):
        self._chains, self._approaches = chains, approaches
        self._segments = MovingSegments(round(SHORTEST_STOP / period))
        self._stamps = array("d")  # of set-points [s]
        self._seen = True  # set-points, with every block
        self._first = self._last = 0.0  # time [s] of samples
        self.samples = 0
        self.cycle_starts: list[float] = []

    def take(self, time: np.ndarray, reference: np.ndarray | None) -> None:
        """Take the next times (K,) [s] and set-points (K, n); samples that came before are ignored."""
        if self.samples and time[0] <= self._last:
            return
        self._first = float(time[0]) if self.samples == 0 else self._first
        self._last = float(time[-1])
        self.samples += len(time)
        if reference is None:
            self._seen = False
        else:
            self._stamps.frombytes(np.asarray(time, dtype=float).tobytes())
            self._segments.add(reference)

    @property
    def elapsed(self) -> float:
        """Seconds from the first sample to the last."""
        return self._last - self._first

    def finish(self, write_planned: Callable[[np.ndarray, np.ndarray, np.ndarray], None]) -> list[float]:
        """Write the planned set-points; returns the controller times at which cycles start (all but the approach)."""
        segments, chains, approaches = self._segments.ranges, self._chains, self._approaches
        if len(segments) == len(chains) - 1 and is_standstill(chains[0]):
            chains, approaches = chains[1:], 0  # the arm stood at the first point already
        if not self._seen or not segments or len(segments) != len(chains):
            return []
        stamps, starts = np.array(self._stamps), []
        for k, ((start, _), chain) in enumerate(zip(segments, chains, strict=True)):
            times = stamps[start : start + len(chain.t)]
            write_planned(times, chain.q[: len(times)], chain.qd[: len(times)])
            # A program with stops in its cycle repeats where it makes the same way again, not at every stop.
            if k >= approaches and chain is chains[approaches]:
                starts.append(float(times[0]))
        self.cycle_starts = [start - self._first for start in starts]
        return starts


class MovingSegments:
    """[start, stop) ranges of set-points between rests of at least `still_samples` samples, as the set-points come.

    A range starts at the last sample before the first change and ends after the last change.
    """

    def __init__(self, still_samples: int) -> None:
        self.ranges: list[tuple[int, int]] = []
        self._still_samples = still_samples
        self._count = 0
        self._last: np.ndarray | None = None

    def add(self, reference: np.ndarray) -> None:
        """The next set-points (K, n)."""
        before = reference[:1] if self._last is None else self._last[None]
        moved = np.any(np.diff(reference, axis=0, prepend=before) != 0.0, axis=1)
        changes = self._count - 1 + np.flatnonzero(moved)
        for run in np.split(changes, np.flatnonzero(np.diff(changes) > self._still_samples) + 1):
            if len(run) == 0:
                continue
            start, stop = int(run[0]), int(run[-1]) + 2
            if self.ranges and start - (self.ranges[-1][1] - 2) <= self._still_samples:
                start, _ = self.ranges.pop()
            self.ranges.append((start, stop))
        self._count += len(reference)
        self._last = np.array(reference[-1])


def moving_segments(reference: np.ndarray, still_samples: int) -> list[tuple[int, int]]:
    """The `MovingSegments` of (S, n) set-points."""
    segments = MovingSegments(still_samples)
    if len(reference):
        segments.add(reference)
    return segments.ranges
