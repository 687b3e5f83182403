"""Samples of one motion between any wire and their reader: put in order, and kept until they are read."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from drivers.errors import DriverError, MotionStopped, ProtocolError, RefusedError
from drivers.protocol import Gap, SampleBlock
from drivers.wire.reasons import SAFETY_ENDS, EndReason

_MAX_HELD = 200_000  # samples waiting for earlier ones
_LATEST = 2.0**31  # s: what a log's stamps can say
#: A joint this far [rad, m] from where it stood has moved.
_MOVED = 1e-3
_JITTER = 25  # steps between two neighbours are none: 50 ms at 500 Hz


class Sequencer:
    """Takes blocks as they come and gives every sample once, in order, from sequence number 0.

    A block beyond the next expected sample is held back until what is missing arrives or is given up.
    """

    def __init__(self) -> None:
        self.expected = 0
        self._gaps: list[Gap] = []
        self._pending: dict[int, SampleBlock] = {}
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
        return sum(len(block) for block in self._pending.values())

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
        earlier = self._pending.get(first)
        if earlier is not None and len(earlier) >= len(block):
            return []
        self._pending[first] = block
        return self._release()

    def missing(self, total: int | None = None) -> tuple[int, int] | None:
        """(first, count) of the samples in front of what is held back, or before `total`, if any are missing."""
        end = min(self._pending) if self._pending else total
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
        while self._pending:
            first = min(self._pending)
            if first > self.expected:
                break
            block = self._pending.pop(first)
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


class _End(NamedTuple):
    reason: int
    samples: int
    message: str


class SampleStream:
    """Received samples of one motion that were not read yet. One thread gives, another takes.

    Args:
        limit: bytes that may wait for the consumer before it is `too_full`.
    """

    def __init__(self, limit: int) -> None:
        self.sequencer = Sequencer()
        self.stopping = False  # by our own command
        self.size = 0
        self._limit = limit
        self._end: _End | None = None
        self._ready: deque[SampleBlock] = deque()
        self._error: DriverError | None = None
        self._changed = threading.Condition()
        self._origin: np.ndarray | None = None  # (n,) where the arm stood
        self._farthest = 0.0  # [rad, m] from there
        self.over = False

    @property
    def moved(self) -> bool:
        """Whether the samples show that the arm moved away from its first position."""
        return not self._farthest <= _MOVED

    @property
    def seen(self) -> str:
        """What the samples show of the arm up to now."""
        if self._origin is None:
            return "no sample shows what the arm did: look at it"
        if not self.moved:
            return "its samples show a stationary arm until then"
        return f"meanwhile a joint moved by {self._farthest:.3f} rad: look at the arm, and for another program there"

    @property
    def unread(self) -> int:
        """Samples that wait for the consumer."""
        with self._changed:
            return sum(len(block) for block in self._ready)

    def too_full(self) -> DriverError | None:
        """Where the consumer is too far behind: the error that the motion is to end with, once it is stopped."""
        if self.size <= self._limit:
            return None
        return DriverError(
            f"{self.size >> 20} MiB of samples wait to be read; the motion was stopped: is the disk full?"
        )

    def check(self) -> None:
        """Raise what the motion ended with, if it has ended by a failure."""
        if self._error is not None:
            raise self._error

    def has_begun(self) -> bool:
        """Whether samples have come, or the end."""
        return self.over or self.size > 0

    def blocks(self) -> Iterator[SampleBlock]:
        """Consumer's side. A block is taken off once the next one is asked for: who is interrupted loses none."""
        while True:
            with self._changed:
                while not self._ready and not self.over:
                    self._changed.wait()
                if not self._ready:
                    self.check()
                    return
                block = self._ready[0]
            yield block
            with self._changed:
                self._ready.popleft()
                self.size -= _bytes(block)

    def wait(self, timeout: float) -> bool:
        """Wait for the end; False if it does not come in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self.over, timeout)

    def take(self, block: SampleBlock) -> None:
        """Samples have come."""
        self._append(self.sequencer.accept(block))
        if self.sequencer.held > _MAX_HELD:
            self.give_up()
        self._close_if_complete()

    def lost(self, before: int) -> None:
        """Samples missing before sequence number `before` are lost."""
        self._append(self.sequencer.give_up(before))

    def missing(self) -> tuple[int, int] | None:
        """(first, count) of the samples in front of what has come, or before the end, if any are missing."""
        return self.sequencer.missing(None if self._end is None else self._end.samples)

    def give_up(self) -> None:
        """What is missing is lost."""
        if (missing := self.missing()) is not None:
            self.lost(sum(missing))
        self._close_if_complete()

    def ended(self, reason: int, samples: int, message: str) -> None:
        """The controller says that the motion is over, with the count of its samples; some may still be missing."""
        self._end = _End(reason, samples, message)
        self._close_if_complete()

    def finish(self, error: DriverError | None) -> None:
        """No more samples; `error` is raised once those that came are read."""
        with self._changed:
            if not self.over:
                self.over = True
                self._error = error
            self._changed.notify_all()

    def _append(self, blocks: list[SampleBlock]) -> None:
        if blocks:
            with self._changed:
                for block in blocks:
                    self._origin = block.position[0] if self._origin is None else self._origin
                    self._farthest = np.fmax(self._farthest, np.max(np.abs(block.position - self._origin), initial=0.0))
                self._ready.extend(blocks)
                self.size += sum(_bytes(block) for block in blocks)
                self._changed.notify_all()

    def _close_if_complete(self) -> None:
        if self._end is not None and self.missing() is None:
            self.finish(_end_error(self._end, self.stopping))


def _end_error(end: _End, stopping: bool) -> DriverError | None:
    try:
        reason = EndReason(end.reason)
    except ValueError:
        return ProtocolError(f"the motion ended for an unknown reason {end.reason}: {end.message}")
    if reason is EndReason.DONE or (reason is EndReason.STOPPED and stopping):
        return None
    if reason in SAFETY_ENDS:
        cause = reason.name.lower().replace("_", " ")
        return MotionStopped(f"the controller stopped the arm ({cause}): {end.message}")
    if reason is EndReason.STOPPED:
        return MotionStopped(f"the motion was stopped at the controller: {end.message}")
    if reason is EndReason.PROGRAM_ERROR:
        return RefusedError(f"the controller cannot go on with the program: {end.message}")
    return DriverError(f"the controller ended the motion: {end.message}")


def _bytes(block: SampleBlock) -> int:
    return len(block) * 8 * (2 + 5 * block.position.shape[1])
