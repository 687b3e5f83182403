"""Messages of several topics, joined to samples by their time."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.transports.cnr.snapshots import Rows
from drivers.wire import cnr as wire

_PATIENCE = 125  # periods that a sample waits for what is missing of it
_SAME = 0.45  # of a period: how far the times of one sample's messages may lie apart
_STEPS = 64  # samples over which the step between them is averaged
_MOST_WAITING = 20_000  # samples; beyond, the times make no sense
_BACK_US = 1_000_000  # µs: no message is later than that


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


class Joiner:
    """Messages of the channels in, whole samples out, in the order of their times. One thread adds, another takes.

    A sample is whole when every channel has given a message of its time; the time is that of the first channel. The
    joint channels carry the same one, currents are stamped apart: within `_SAME` periods they are the same sample. A
    sample with a hole, or one whose predecessor is not there, waits for `_PATIENCE` periods; then it is given up, or
    its predecessor is. A node whose loop is slower than the period is not waited for.

    Args:
        channels: their names; the first one's time is the sample's.
        period: of the samples [µs].
    """

    def __init__(self, channels: Sequence[str], period: float) -> None:
        self.counts = Counts()
        self.restarts = 0  # how often time has gone back further than any message is late
        self._channels = tuple(channels)
        self._period = period
        self._lock = threading.Lock()
        self._came = threading.Condition(self._lock)
        self._count = 0  # whole samples
        self._times: list[int] = []  # of what waits, sorted
        self._waiting: dict[int, list[tuple[float, ...] | None]] = {}
        self._blank: list[tuple[float, ...] | None] = [None] * len(self._channels)
        self._stamps: dict[int, int] = {}  # of the last channel
        self._step = period  # between samples as they are [µs]
        self._whole: list[tuple[int, int, list[Any]]] = []
        self._given = -(2**62)  # time of the last sample given out or up; negative: none was
        self._newest = -(2**62)

    def add(self, channel: int, time_us: int, values: tuple[float, ...]) -> None:
        """One message."""
        with self._lock:
            if time_us < self._given - _BACK_US:
                self._begin_anew()
            key = self._find(channel, time_us)
            if key is None:
                if time_us <= self._given + _SAME * self._period:
                    self.counts.late += 1
                    return
                key = time_us
                bisect.insort(self._times, key)
                self._waiting[key] = self._blank.copy()
            elif channel == 0 and key != time_us:
                key = self._stamp(key, time_us)
            row = self._waiting[key]
            if row[channel] is not None:
                self.counts.duplicate += 1
                return
            row[channel] = values
            if channel == len(self._channels) - 1:
                self._stamps[key] = time_us
            if None not in row:
                self._newest = max(self._newest, key)
            self._release()

    def leave_out(self, channels: Iterable[int]) -> None:
        """Samples are whole without these; their values are zero."""
        with self._lock:
            for row in (self._blank, *self._waiting.values()):
                for channel in channels:
                    row[channel] = (0.0,) * wire.AXES

    def take(self) -> Rows:
        """Whole samples since the last call."""
        with self._lock:
            whole, self._whole = self._whole, []
        times, late = (np.array([row[k] for row in whole], np.int64) for k in (0, 1))
        return Rows(times, late, np.array([row[2] for row in whole]).reshape(-1, len(self._channels), wire.AXES))

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
            rows = list(self._waiting.values())
        absent = [name for k, name in enumerate(self._channels) if all(row[k] is None for row in rows)]
        return absent or list(self._channels)

    def _begin_anew(self) -> None:
        self.restarts += 1
        self._times, self._waiting, self._stamps = [], {}, {}
        self._given = self._newest = -(2**62)

    def _find(self, channel: int, time_us: int) -> int | None:
        """The sample that a message belongs to, by its time."""
        if time_us in self._waiting:
            return time_us
        place = bisect.bisect_left(self._times, time_us)
        near = [key for key in self._times[max(0, place - 1) : place + 1] if self._same(key, time_us)]
        free = [key for key in near if self._waiting[key][channel] is None]
        return min(free, key=lambda key: abs(key - time_us)) if free else None

    def _same(self, one: int, other: int) -> bool:
        return abs(one - other) <= _SAME * self._period

    def _stamp(self, key: int, time_us: int) -> int:
        """Give a sample the time of its first channel."""
        self._times.remove(key)
        bisect.insort(self._times, time_us)
        self._waiting[time_us] = self._waiting.pop(key)
        self._stamps[time_us] = self._stamps.pop(key, time_us)
        return time_us

    def _release(self) -> None:
        while self._times:
            key = self._times[0]
            row = self._waiting[key]
            patient = self._newest - key <= _PATIENCE * self._period and len(self._times) <= _MOST_WAITING
            step = key - self._given
            follows = self._given < 0 or step < 1.5 * self._step
            if patient and (None in row or not follows):
                return
            if None in row:
                for name, values in zip(self._channels, row, strict=True):
                    if values is None:
                        self.counts.missing[name] = self.counts.missing.get(name, 0) + 1
            else:
                self._whole.append((key, self._stamps.get(key, key) - key, row))
                self._count += 1
                self._came.notify_all()
            if self._given > 0:
                self._step += (min(max(step, self._period), 2 * self._period) - self._step) / _STEPS
            self._given = key
            del self._times[0], self._waiting[key]
            self._stamps.pop(key, None)
