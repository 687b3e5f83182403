"""What the C5G Open node publishes: messages of five topics, joined to rows, and the controller's samples of these.

The published node sleeps one period, reads the last snapshot, and stamps it with its PC's clock: rows are uneven, show
a snapshot twice or leave one out, and their currents may be of the snapshot after that of their positions. But the
controller makes set-points at an even period T, so a row read at t has snapshot n = floor((t - p) / T), and only the
phase p is unknown. It is the one for which the set-points are smoothest over n.
"""

from __future__ import annotations

import bisect
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from drivers.errors import DriverError, ProtocolError
from drivers.secrets import read_secret
from drivers.transports.cnr.address import CnrAddress
from drivers.wire import cnr as wire
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
        self._given = 0  # of them: rows before are kept to tell the phase
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
        if stop <= self._given:
            return rows.times[:0], rows.values[:0]
        if self._phase is None or self._seen - self._estimated >= _EVERY:
            self._estimated = self._seen
            self._find_phase(self._rows)
        assert self._phase is not None
        given = self._samples(self._rows, self._given, stop, self._phase)
        first = max(0, stop - _BEHIND)  # a few of those that are given out still tell the phase
        self._rows, self._given = self._rows.part(slice(first, None)), stop - first
        return given

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
        place = (rows.times - phase) / period
        number = np.floor(place)
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
        ahead = np.median(number - np.floor(place))  # where the set-points say that the phase is a period off
        currents = np.maximum.accumulate(np.maximum(number, np.floor(place + rows.late / period) + ahead))
        kinds, at = np.unique(currents, return_index=True)
        series = rows.values[at, _CURRENT]
        values[:, _CURRENT] = np.column_stack([np.interp(number[chosen], kinds, column) for column in series.T])
        self._count(stop - start, len(chosen), int(np.sum(~np.isin(number[chosen], kinds))))
        if self._zero is None:  # fixed once: times stay even where the phase moves
            self._zero = phase + 0.5 * period
        return (self._zero + number[chosen] * period).astype(np.int64), values

    def _count(self, rows: int, given: int, between: int) -> None:
        facts = self._facts
        self._facts = NodeFacts(
            facts.rows + rows,
            repeated=facts.repeated + rows - given,
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
        self._given = self._newest = _NEVER  # time of the last sample given out or up, and of the newest whole one

    def add(self, channel: int, time_us: int, values: tuple[float, ...]) -> None:
        """Take one message."""
        with self._lock:
            if time_us < self._given - _BACK_US:
                self.restarts += 1
                self._waiting, self._given, self._newest = [], _NEVER, _NEVER
            sample = self._find(channel, time_us)
            if sample is None:
                if time_us <= self._given + _SAME * self._period:
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
        place = bisect.bisect_left(self._waiting, time_us, key=_time)
        near = self._waiting[max(0, place - 1) : place + 1]
        if near and near[-1].time == time_us:
            return near[-1]
        same = [
            sample
            for sample in near
            if abs(sample.time - time_us) <= _SAME * self._period and sample.values[channel] is None
        ]
        return min(same, key=lambda sample: abs(sample.time - time_us), default=None)

    def _release(self) -> None:
        while self._waiting:
            sample = self._waiting[0]
            patient = self._newest - sample.time <= _PATIENCE * self._period and len(self._waiting) <= _MOST_WAITING
            step = sample.time - self._given
            follows = self._given < 0 or step < 1.5 * self._step
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
            if self._given > 0:
                self._step += (min(max(step, self._period), 2 * self._period) - self._step) / _STEPS
            self._given = sample.time
            del self._waiting[0]


_LOOK = 0.5  # s in which topics have to come that a motion can be recorded without
#: Channels without which nothing can be recorded; velocities follow from positions.
_NEEDED = {wire.CHANNELS.index(name) for name in (wire.POSITIONS, wire.TARGET_POSITIONS, wire.CURRENTS)}
_MEASURED = 0.6  # s in which the pace of the samples is measured
_KEEP_ALIVE = 60  # s: a broker's sign of life waits behind its samples, and samples that stop are noticed earlier
#: Of one packet [bytes]; a message of the node has a few hundred. MQTT allows 256 MiB, and the library takes them.
_LONGEST_PACKET = 64 * 1024

_log = logging.getLogger(__name__)


class _BrokerClient(Client):
    """Connects once; a packet that is too long ends the connection before its content is received."""

    def __init__(self) -> None:
        super().__init__(CallbackAPIVersion.VERSION2, reconnect_on_failure=False)

    def _sock_recv(self, bufsize: int) -> bytes:
        if bufsize > _LONGEST_PACKET:
            raise ConnectionError(f"a packet of {bufsize} bytes")
        return super()._sock_recv(bufsize)


class BrokerLink:
    """A subscription to what the C5G Open node publishes.

    Parameters
    ----------
    address : that has a broker, its topic and its user.
    period : of the samples [s].
    timeout : for the connection and for the first messages [s].
    on_loss : called once, in a thread of its own, where the broker is lost.

    Raises:
        DriverError: no broker, or it says nothing on one of the topics.
        ProtocolError: what comes is not what the node publishes.
    """

    def __init__(
        self, address: CnrAddress, period: float, timeout: float, on_loss: Callable[[DriverError], None]
    ) -> None:
        assert address.broker is not None
        host, port = address.broker
        self.peer = f"mqtt=…:{port}"  # nothing of an address's options is printed
        self.joiner = Joiner(wire.CHANNELS, period * 1e6)
        self.clock = SnapshotClock(period * 1e6)
        self._channels = {f"{address.topic}/{name}": channel for channel, name in enumerate(wire.CHANNELS)}
        self._heard: set[int] = set()
        self._on_loss = on_loss
        self._closing = False
        self._ready = threading.Event()
        self._fault: DriverError | None = None
        self._client = _BrokerClient()
        if address.broker_user or address.broker_password_from:
            place = address.broker_password_from
            self._client.username_pw_set(address.broker_user or None, read_secret(place) if place else None)
        self._client.on_connect = self._connected
        self._client.on_disconnect = self._disconnected
        self._client.on_message = self._message
        try:
            self._client.connect(host, port, keepalive=_KEEP_ALIVE)
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
        until = time.monotonic() + timeout
        while came and not self.clock.has_enough and time.monotonic() < until:  # are their times even?
            self.joiner.wait(timeout)
        if self._fault is not None:
            raise self._fault
        if not came:
            raise DriverError(f"no whole sample came within {timeout:g} s: {self.silent()}")

    def pace(self) -> float:
        """Seconds of samples that come in a second; it takes a moment to see."""
        began, first = time.monotonic(), self.joiner.newest
        while time.monotonic() - began < _MEASURED and self.joiner.wait(_MEASURED):
            pass
        return (self.joiner.newest - first) * 1e-6 / (time.monotonic() - began)

    def begin(self) -> None:
        """A motion is about to start: count anew from here on; says so where rows are not the controller's samples."""
        before = self.clock.active
        self.joiner.forget_counts()
        self.clock.begin()
        facts = self.clock.facts
        if self.clock.active and not before:
            _log.warning(
                "the C5G Open node at %s publishes %.0f rows/s, uneven by %.2f ms: times come from the set-points, "
                "velocities that it does not fill from positions; samples that it leaves out are missing",
                self.peer,
                1 / facts.period,
                1e3 * facts.jitter,
            )

    def take(self) -> tuple[np.ndarray, np.ndarray]:
        """Samples since the last call: times (K,) [µs] and values (K, 5, 10)."""
        return self.clock.add(self.joiner.take())

    @property
    def facts(self) -> dict[str, str]:
        """Counts of lost and late messages since `begin`, for the log."""
        return {**self.joiner.counts.facts, **self.clock.facts.facts}

    def silent(self) -> str:
        """Missing topics of the broker, for a message."""
        topics = ", ".join(self.joiner.silent_channels())
        return f"nothing on {topics} at {self.peer}; does the C5G Open node run, and are the drives on?"

    def _wait_for_all(self, timeout: float) -> None:
        until = time.monotonic() + timeout
        while not self._ready.wait(_LOOK) and time.monotonic() < until and not self._heard >= _NEEDED:
            pass
        if self._fault is not None:
            raise self._fault
        absent = set(range(len(wire.CHANNELS))) - self._heard
        if absent and not absent & _NEEDED:
            self.joiner.leave_out(absent)
            self.clock.leave_out(absent)
            self._ready.set()
            return
        quiet = [wire.CHANNELS[k] for k in sorted(absent)]
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
                self._fail(
                    ProtocolError(f"{wire.CHANNELS[channel]} at {self.peer}: {error}; is an older C5G Open node there?")
                )
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
