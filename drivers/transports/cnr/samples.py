"""Samples from the broker: the messages of several topics, joined by their time."""

from __future__ import annotations

import bisect
import contextlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.errors import DriverError, ProtocolError
from drivers.secrets import read_secret
from drivers.wire import cnr as wire

_PATIENCE = 125  # periods that a sample waits for what is missing of it
_SAME = 0.45  # of a period: how far the times of one sample's messages may lie apart
_MOST_WAITING = 20_000  # samples; beyond, the times make no sense
_BACK_US = 1_000_000  # µs: no message is later than that
_KEEP_ALIVE = 60  # s: a broker's sign of life waits behind its samples, and samples that stop are noticed earlier


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
    its predecessor is.

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
        self._whole: list[tuple[int, list[Any]]] = []
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
                self._waiting[key] = [None] * len(self._channels)
            elif channel == 0 and key != time_us:
                key = self._stamp(key, time_us)
            row = self._waiting[key]
            if row[channel] is not None:
                self.counts.duplicate += 1
                return
            row[channel] = values
            if None not in row:
                self._newest = max(self._newest, key)
            self._release()

    def take(self) -> tuple[np.ndarray, np.ndarray]:
        """Whole samples since the last call: times (K,) [µs] and values (K, channels, 10)."""
        with self._lock:
            whole, self._whole = self._whole, []
        if not whole:
            return np.empty(0, np.int64), np.empty((0, len(self._channels), wire.AXES))
        return np.array([key for key, _ in whole], np.int64), np.array([row for _, row in whole])

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
        self._times, self._waiting = [], {}
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
        return time_us

    def _release(self) -> None:
        while self._times:
            key = self._times[0]
            row = self._waiting[key]
            patient = self._newest - key <= _PATIENCE * self._period and len(self._times) <= _MOST_WAITING
            follows = self._given < 0 or key - self._given < 1.5 * self._period
            if patient and (None in row or not follows):
                return
            if None in row:
                for name, values in zip(self._channels, row, strict=True):
                    if values is None:
                        self.counts.missing[name] = self.counts.missing.get(name, 0) + 1
            else:
                self._whole.append((key, row))
                self._count += 1
                self._came.notify_all()
            self._given = key
            del self._times[0], self._waiting[key]


class BrokerLink:
    """A subscription to what the C5G Open node publishes.

    Args:
        broker: host and port.
        topic: above the channels, like `robot/arm1`.
        period: of the samples [s].
        timeout: for the connection and for the first messages [s].
        on_loss: called once, in a thread of its own, where the broker is lost.
        user: of the broker, where it wants one; password_from: where that user's password is.

    Raises:
        DriverError: no broker, or it says nothing on one of the topics.
        ProtocolError: what comes is not what the node publishes.
    """

    def __init__(
        self,
        broker: tuple[str, int],
        topic: str,
        period: float,
        timeout: float,
        on_loss: Callable[[DriverError], None],
        user: str = "",
        password_from: str = "",
    ) -> None:
        from drivers.transports.cnr.broker_client import BrokerClient

        self.peer = "{}:{}".format(*broker)
        self.joiner = Joiner(wire.CHANNELS, period * 1e6)
        self._topic = topic
        self._channels = {f"{topic}/{name}": channel for channel, name in enumerate(wire.CHANNELS)}
        self._heard: set[int] = set()
        self._on_loss = on_loss
        self._closing = False
        self._ready = threading.Event()
        self._fault: DriverError | None = None
        self._client = BrokerClient()
        if user or password_from:
            self._client.username_pw_set(user or None, read_secret(password_from) if password_from else None)
        self._client.on_connect = self._connected
        self._client.on_disconnect = self._disconnected
        self._client.on_message = self._message
        try:
            self._client.connect(*broker, keepalive=_KEEP_ALIVE)
        except (OSError, ValueError) as error:
            raise DriverError(
                f"no broker answers at {self.peer}: {error}; is it running? Without C5G Open, say mqtt=none in the "
                "address: 50 samples a second then, enough to watch and too few to identify"
            ) from None
        self._client.loop_start()
        try:
            self._wait_for_all(timeout)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leave the broker; never raises."""
        self._closing = True
        with contextlib.suppress(OSError, ValueError):
            self._client.disconnect()
        self._client.loop_stop()

    def check(self, timeout: float) -> None:
        """The broker is there, and samples come.

        Raises:
            DriverError: it is not, or they do not.
        """
        came = self._fault is None and self.joiner.wait(timeout)
        if self._fault is not None:
            raise self._fault
        if not came:
            raise DriverError(f"no whole sample came within {timeout:g} s: {self.silent()}")

    def silent(self) -> str:
        """What the broker lacks, for a message."""
        topics = ", ".join(f"{self._topic}/{name}" for name in self.joiner.silent_channels())
        return f"nothing on {topics} at {self.peer}; does the C5G Open node run, and are the drives on?"

    def _wait_for_all(self, timeout: float) -> None:
        self._ready.wait(timeout)
        if self._fault is not None:
            raise self._fault
        quiet = [f"{self._topic}/{name}" for k, name in enumerate(wire.CHANNELS) if k not in self._heard]
        if quiet:
            raise DriverError(
                f"the broker at {self.peer} has nothing on {', '.join(quiet)} within {timeout:g} s; does the C5G Open "
                "node run, and are the drives on? If its topics have other names: topic= in the address"
            )

    # From here on in the thread of the broker's client.

    def _connected(self, client: Any, _: Any, __: Any, reason: Any, ___: Any) -> None:
        if reason.is_failure:
            self._fail(DriverError(f"the broker at {self.peer} refuses the connection: {reason}"))
            return
        client.subscribe([(name, 0) for name in self._channels])

    def _disconnected(self, _: Any, __: Any, ___: Any, reason: Any, ____: Any) -> None:
        if not self._closing:
            self._fail(
                DriverError(f"the broker at {self.peer} is gone ({reason}); start it again, then run the command again")
            )

    def _message(self, _: Any, __: Any, message: Any) -> None:
        channel = self._channels.get(message.topic)
        if channel is None:
            return
        try:
            time_us, values = wire.decode_joints(message.payload)
        except ProtocolError as error:
            self.joiner.counts.damaged += 1
            if not self._ready.is_set():
                self._fail(ProtocolError(f"{message.topic} at {self.peer}: {error}; is an older C5G Open node there?"))
            return
        self.joiner.add(channel, time_us, values)
        if not self._ready.is_set():
            self._heard.add(channel)
            if len(self._heard) == len(self._channels):
                self._ready.set()

    def _fail(self, error: DriverError) -> None:
        self._fault = error
        if self._ready.is_set():
            self._on_loss(error)
        self._ready.set()
