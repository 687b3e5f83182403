"""When the C5G Open node publishes, and which of the controller's snapshots it has then: the ideal node, and the
published one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fake_controller.execution import Slice

CURRENTS_LATE = 200_000  # ns by which the ideal node stamps currents later than the rest
_UNEVEN = 30_000  # ns, standard deviation of what a turn of the loop takes more or less
_HELD_UP = (0.002, 2e6)  # share of turns that something holds up, and for how long [ns] on average
_READ_AFTER = (50_000, 350_000)  # ns from reading positions to reading currents


class Publication(NamedTuple):
    """Row `sample` at `stamp` [ns], with the currents of row `current`, stamped `late` [ns] after that."""

    stamp: int
    sample: int
    late: int
    current: int


class IdealNode:
    """Publishes every sample once, at the controller's own times."""

    fills_velocities = True

    def turns(self, time_ns: np.ndarray, samples: Slice) -> tuple[Slice, Iterator[Publication]]:
        """What is published of samples (K,) that follow those of before, and the samples that it is taken from."""
        return samples, (Publication(stamp, k, CURRENTS_LATE, k) for k, stamp in enumerate(time_ns.tolist()))


class LoopingNode:
    """As the published node does it: a loop sleeps `period` [s], reads the last positions and then the last currents.

    So a snapshot comes twice, or not at all, currents may be of the next one, and stamps are the PC's. Velocities are
    never filled.
    """

    fills_velocities = False

    def __init__(self, period: float) -> None:
        self._period = period * 1e9
        self._rng = np.random.default_rng(19)
        self._next = -np.inf  # when the loop reads positions [ns], and how much later currents
        self._late = 0.0
        self._kept: tuple[np.ndarray, Slice] | None = None

    def turns(self, time_ns: np.ndarray, samples: Slice) -> tuple[Slice, Iterator[Publication]]:
        """As of `IdealNode`; the last samples stay for the next call."""
        if self._kept is not None:
            time_ns = np.concatenate([self._kept[0], time_ns])
            pairs = zip(self._kept[1].columns, samples.columns, strict=True)
            samples = Slice(*(np.concatenate(pair) for pair in pairs))
        made = []
        at = max(self._next, float(time_ns[0]))
        while at + self._late < time_ns[-1]:  # beyond, nobody knows yet what is the last snapshot
            sample, current = np.searchsorted(time_ns, (at, at + self._late), side="right") - 1
            made.append(Publication(round(at), int(sample), round(self._late), int(current)))
            at += max(self._period + _UNEVEN * self._rng.standard_normal(), 0.5 * self._period)
            if self._rng.random() < _HELD_UP[0]:
                at += self._rng.exponential(_HELD_UP[1])
            self._late = self._rng.uniform(*_READ_AFTER)
        self._next = at
        first = max(0, int(np.searchsorted(time_ns, at, side="right")) - 1)
        self._kept = time_ns[first:], samples.part(slice(first, None))
        return samples, iter(made)
