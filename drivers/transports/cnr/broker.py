"""The subscription to what the C5G Open node publishes at a broker."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from drivers.errors import DriverError, ProtocolError
from drivers.secrets import read_secret
from drivers.transports.cnr.address import CnrAddress
from drivers.transports.cnr.joiner import Joiner
from drivers.transports.cnr.snapshot_clock import SnapshotClock
from drivers.wire import cnr as wire

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
            source = address.broker_password_from
            self._client.username_pw_set(address.broker_user or None, read_secret(source) if source else None)
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
