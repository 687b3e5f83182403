"""Messages of the C5G Open node's five topics, joined to rows by their times."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np

from drivers.transports.cnr.snapshot_clock import Rows
from drivers.wire import cnr as wire

_PATIENCE = 125  # periods that a sample waits for what is missing of it
_SAME = 0.45  # of a period: how far the times of one sample's messages may lie apart
_STEPS = 64  # samples over which the step between them is averaged
_MOST_WAITING = 20_000  # samples; beyond, the times make no sense
_BACK_US = 1_000_000  # µs: no message is later than that
_NEVER = -(2**62)  # µs


@dataclass
class Counts:
    """What did not come as it should, in messages: `late` after its sample was given out or given up, also when it
    came a second time; `duplicate` before; `damaged` no message at all; `missing` by topic."""

    late: int = 0
    duplicate: int = 0
    damaged: int = 0
    missing: dict[str, int] = field(default_factory=dict)

    @property
    def facts(self) -> dict[str, str]:
        """For the log."""
        missing = {f"missing_{name}": str(count) for name, count in self.missing.items()}
        others = {"late": self.late, "duplicate": self.duplicate, "damaged": self.damaged}
        return {**missing, **{f"{name}_messages": str(count) for name, count in others.items()}}


@dataclass(eq=False)
class _Sample:
    """A sample that is not whole yet: its time [µs], that of its last channel, and values by channel."""

    time: int
    values: list[tuple[float, ...] | None]
    stamp: int | None = None

    @property
    def late(self) -> int:
        """Delay [µs] of the last channel that was read."""
        return 0 if self.stamp is None else self.stamp - self.time


_time = attrgetter("time")


class Joiner:
    """Messages of the channels in, whole samples out, in the order of their times. One thread adds, another takes.

    A sample is whole when every channel has given a message of its time; the time is that of the first channel. The
    joint channels carry the same one, currents are stamped apart: within `_SAME` periods they are the same sample. A
    sample with a hole, or one whose predecessor is not there, waits for `_PATIENCE` periods; then it is given up, or
    its predecessor is. A node whose loop is slower than the period is not waited for.

    Parameters
    ----------
    channels : their names; the first one's time is the sample's.
    period : of the samples [µs].
    """

    def __init__(self, channels: Sequence[str], period: float) -> None:
        self.counts = Counts()
        self.restarts = 0  # how often time has gone back further than any message is late
        self._channels = tuple(channels)
        self._period = period
        self._lock = threading.Lock()
        self._came = threading.Condition(self._lock)
        self._count = 0  # whole samples
        self._waiting: list[_Sample] = []  # sorted by time
        self._blank: list[tuple[float, ...] | None] = [None] * len(self._channels)
        self._step = period  # between samples as they are [µs]
        self._whole: list[_Sample] = []
        self._released = self._newest = _NEVER  # time of the last sample given out or up, and of the newest whole one

    def add(self, channel: int, time_us: int, values: tuple[float, ...]) -> None:
        """Take one message."""
        with self._lock:
            if time_us < self._released - _BACK_US:
                self.restarts += 1
                self._waiting, self._released, self._newest = [], _NEVER, _NEVER
            sample = self._find(channel, time_us)
            if sample is None:
                if time_us <= self._released + _SAME * self._period:
                    self.counts.late += 1
                    return
                sample = _Sample(time_us, self._blank.copy())
                bisect.insort(self._waiting, sample, key=_time)
            elif channel == 0 and sample.time != time_us:
                self._waiting.remove(sample)
                sample.time = time_us
                bisect.insort(self._waiting, sample, key=_time)
            if sample.values[channel] is not None:
                self.counts.duplicate += 1
                return
            sample.values[channel] = values
            if channel == len(self._channels) - 1:
                sample.stamp = time_us
            if None not in sample.values:
                self._newest = max(self._newest, sample.time)
            self._release()

    def leave_out(self, channels: Iterable[int]) -> None:
        """Samples are whole without these; their values are zero."""
        with self._lock:
            for values in (self._blank, *(sample.values for sample in self._waiting)):
                for channel in channels:
                    values[channel] = (0.0,) * wire.AXES

    def take(self) -> Rows:
        """Whole samples since the last call."""
        with self._lock:
            whole, self._whole = self._whole, []
        times = np.array([sample.time for sample in whole], np.int64)
        late = np.array([sample.late for sample in whole], np.int64)
        values = np.array([sample.values for sample in whole])
        return Rows(times, late, values.reshape(-1, len(self._channels), wire.AXES))

    @property
    def newest(self) -> int:
        """Time of the newest whole sample [µs]."""
        return self._newest

    def forget_counts(self) -> None:
        """Count anew from here on."""
        with self._lock:
            self.counts, self.restarts = Counts(), 0

    def wait(self, timeout: float) -> bool:
        """Wait for the next whole sample; False if none comes in time [s]."""
        with self._came:
            wanted = self._count + 1
            return self._came.wait_for(lambda: self._count >= wanted, timeout)

    def silent_channels(self) -> list[str]:
        """Names of the channels that the samples which wait are waiting for; all of them where nothing waits."""
        with self._lock:
            rows = [sample.values for sample in self._waiting]
            absent = [name for k, name in enumerate(self._channels) if all(row[k] is None for row in rows)]
        return absent or list(self._channels)

    def _find(self, channel: int, time_us: int) -> _Sample | None:
        """The sample that a message belongs to, by its time."""
        index = bisect.bisect_left(self._waiting, time_us, key=_time)
        neighbours = self._waiting[max(0, index - 1) : index + 1]
        if neighbours and neighbours[-1].time == time_us:
            return neighbours[-1]
        same = [
            sample
            for sample in neighbours
            if abs(sample.time - time_us) <= _SAME * self._period and sample.values[channel] is None
        ]
        return min(same, key=lambda sample: abs(sample.time - time_us), default=None)

    def _release(self) -> None:
        while self._waiting:
            sample = self._waiting[0]
            patient = self._newest - sample.time <= _PATIENCE * self._period and len(self._waiting) <= _MOST_WAITING
            step = sample.time - self._released
            follows = self._released < 0 or step < 1.5 * self._step
            whole = None not in sample.values
            if patient and not (whole and follows):
                return
            if whole:
                self._whole.append(sample)
                self._count += 1
                self._came.notify_all()
            for name, values in zip(self._channels, sample.values, strict=True):
                if values is None:
                    self.counts.missing[name] = self.counts.missing.get(name, 0) + 1
            if self._released > 0:
                self._step += (min(max(step, self._period), 2 * self._period) - self._step) / _STEPS
            self._released = sample.time
            del self._waiting[0]
