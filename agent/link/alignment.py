"""What we planned, laid onto the controller's set-points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.safety import is_there

if TYPE_CHECKING:
    from agent.motion import Trajectory


class Aligner:
    """Lays what we planned, from stop to stop, onto the controller's set-points.

    The controller waits for the arm to settle at each stop, so only the segments between stops are comparable in
    time. Where the numbers of segments differ there is nothing to compare, and nothing is written.
    """

    #: Shortest rest [s] of the set-points that counts as a stop.
    REST = 0.006

    def __init__(self, chains: Sequence[Trajectory], period: float):
        self._chains = chains
        self._period = period
        self._times: list[np.ndarray] = []
        self._references: list[np.ndarray] = []
        self.samples = 0
        self.cycle_starts: list[float] = []

    def take(self, time: np.ndarray, reference: np.ndarray | None) -> None:
        self._times.append(np.asarray(time))
        if reference is not None:
            self._references.append(np.asarray(reference))
        self.samples += len(time)

    @property
    def elapsed(self) -> float:
        return float(self._times[-1][-1] - self._times[0][0]) if self.samples else 0.0

    def finish(self, write_planned: Callable[[np.ndarray, np.ndarray, np.ndarray], None]) -> list[float]:
        """Write the planned set-points; returns the controller times at which cycles start (all but the approach)."""
        if not self._references:
            return []
        time = np.concatenate(self._times)
        segments = moving_segments(np.concatenate(self._references), round(self.REST / self._period))
        chains, approaches = self._chains, 1
        if len(segments) == len(chains) - 1 and is_there(chains[0]):
            chains, approaches = chains[1:], 0  # the arm stood at the first point already
        if len(segments) != len(chains):
            return []
        for (start, _), chain in zip(segments, chains, strict=True):
            stop = min(start + len(chain.t), len(time))
            write_planned(time[start:stop], chain.q[: stop - start], chain.qd[: stop - start])
        motion = list(zip(segments, chains, strict=True))[approaches:]
        # A program with stops in its cycle repeats where it makes the same way again, not at every stop.
        starts = [start for (start, _), chain in motion if chain is motion[0][1]]
        self.cycle_starts = [float(time[start] - time[0]) for start in starts]
        return [float(time[start]) for start in starts]


def moving_segments(reference: np.ndarray, rest: int) -> list[tuple[int, int]]:
    """[start, stop) ranges of (S, n) set-points between rests of at least `rest` samples.

    A range starts at the last sample before the first change and ends after the last change.
    """
    if len(reference) < 2:
        return []
    changes = np.flatnonzero(np.any(np.diff(reference, axis=0) != 0.0, axis=1))
    if len(changes) == 0:
        return []
    splits = np.flatnonzero(np.diff(changes) > rest)
    starts = np.concatenate([[changes[0]], changes[splits + 1]])
    stops = np.concatenate([changes[splits], [changes[-1]]]) + 2
    return [(int(a), int(b)) for a, b in zip(starts, stops, strict=True)]
