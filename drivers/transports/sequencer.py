"""Puts sample blocks in order by their sequence numbers, whatever the wire did to them."""

from __future__ import annotations

import numpy as np

from drivers.errors import ProtocolError
from drivers.protocol import Gap, SampleBlock

_LATEST = 2.0**31  # s: what a log's stamps can say
_JITTER = 25  # steps between two neighbours are none: 50 ms at 500 Hz


class Sequencer:
    """Takes blocks as they come and gives every sample once, in order, from sequence number 0.

    A block beyond the next expected sample is held back until what is missing arrives or is given up.
    """

    def __init__(self) -> None:
        self.expected = 0
        self._gaps: list[Gap] = []
        self._held: dict[int, SampleBlock] = {}
        self._latest = float("-inf")
        self._joints: int | None = None  # of the first block
        self._released = 0  # the sequence number after the last sample that was given
        self._step: float | None = None  # [s] between samples, by the first of them

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Abandoned samples."""
        return tuple(self._gaps)

    @property
    def held(self) -> int:
        """Samples that wait for earlier ones."""
        return sum(len(block) for block in self._held.values())

    def accept(self, block: SampleBlock) -> list[SampleBlock]:
        """The blocks that are in order now; may be none.

        Raises:
            ProtocolError: old sequence numbers with new times, or neighbours far apart in time: the controller counts
                from the start again. Times that no clock shows, or another number of joints than before.
        """
        first = int(block.sequence[0])
        joints = block.position.shape[1]
        self._joints = joints if self._joints is None else self._joints
        if joints != self._joints:
            raise ProtocolError(f"the controller sent samples of {self._joints} joints, and now of {joints}")
        if not bool(np.all(np.abs(block.time) < _LATEST)):
            wrong = block.time[~(np.abs(block.time) < _LATEST)][0]
            raise ProtocolError(f"the controller's sample {first} is of {wrong:.4g} s by its clock: that is no time")
        if first < self.expected and block.time[0] > self._latest:
            raise ProtocolError(
                f"the controller's sample counter went back from {self.expected} to {first}: it was reset in mid-motion"
            )
        earlier = self._held.get(first)
        if earlier is not None and len(earlier) >= len(block):
            return []
        self._held[first] = block
        return self._release()

    def missing(self, total: int | None = None) -> tuple[int, int] | None:
        """(first, count) of the samples in front of what is held back, or before `total`, if any are missing."""
        end = min(self._held) if self._held else total
        if end is None or end <= self.expected:
            return None
        return self.expected, end - self.expected

    def give_up(self, before: int) -> list[SampleBlock]:
        """Count what is missing before sequence number `before` as lost; returns what is in order after that."""
        if before > self.expected:
            first = self.expected
            if self._gaps and self._gaps[-1].first + self._gaps[-1].count == first:
                first = self._gaps.pop().first
            self._gaps.append(Gap(first, before - first))
            self.expected = before
        return self._release()

    def _release(self) -> list[SampleBlock]:
        ready = []
        while self._held:
            first = min(self._held)
            if first > self.expected:
                break
            block = self._held.pop(first)
            if (known := self.expected - first) > 0:
                block = block.part(known)
            if len(block):
                self._check_step(block)
                ready.append(block)
                self.expected += len(block)
                self._released = self.expected
                self._latest = float(block.time[-1])
        return ready

    def _check_step(self, block: SampleBlock) -> None:
        """A counter that was reset and has caught up since shows in the times only, as a clock that was set does."""
        apart, steps = np.diff(block.time), np.ones(len(block) - 1)
        if self._released:
            apart = np.append(float(block.time[0]) - self._latest, apart)
            steps = np.append(self.expected + 1 - self._released, steps)
        if self._step is None and len(apart):
            self._step = float(np.median(apart / steps) or np.mean(apart / steps))
        if self._step is None or not (far := apart > _JITTER * self._step * steps).any():
            return
        number = self.expected + int(np.argmax(far)) + (not self._released)
        raise ProtocolError(
            f"the controller's samples {number - int(steps[np.argmax(far)])} and {number} are {apart[far][0]:.3g} s "
            "apart: its clock was set forward, or its counter reset in mid-motion"
        )
