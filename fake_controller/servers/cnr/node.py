"""The C5G Open node of the fake, ideal or as published: samples on five topics of an MQTT broker."""

from __future__ import annotations

import contextlib
import secrets
import threading
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from agent.robot import RobotDescription
from drivers.wire.cnr import (
    CHANNELS,
    CURRENTS,
    POSITIONS,
    TARGET_POSITIONS,
    TARGET_VELOCITIES,
    TOPIC,
    VELOCITIES,
    encode_joints,
)
from fake_controller.execution import Slice
from fake_controller.faults import Faults
from fake_controller.servers.base import NoBrokerError

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


class LoopingNode:
    """As the published node does it: a loop sleeps `period` [s], reads the last positions and then the last currents.

    So a snapshot comes twice, or not at all, currents may be of the next one, and stamps are the PC's.
    """

    def __init__(self, period: float) -> None:
        self._period = period * 1e9
        self._rng = np.random.default_rng(19)
        self._next = -np.inf  # when the loop reads positions [ns], and how much later currents
        self._late = 0.0
        self._pending: tuple[np.ndarray, Slice] | None = None

    def turns(self, time_ns: np.ndarray, samples: Slice) -> tuple[Slice, list[Publication]]:
        """What is published of samples (K,) that follow those of before, and the samples that it is taken from.

        The last samples stay for the next call.
        """
        if self._pending is not None:
            time_ns = np.concatenate([self._pending[0], time_ns])
            pairs = zip(self._pending[1].columns, samples.columns, strict=True)
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
        self._pending = time_ns[first:], samples.part(slice(first, None))
        return samples, made


#: The node's clock: what it shows when the controller's shows nothing [µs], and how much faster it runs.
CLOCK_OFFSET, CLOCK_DRIFT = 1_234_567_890, 5e-6
TORQUE_CONSTANT = 1.0  # N·m/A of motors whose description has none
_PACE = 50  # samples between two looks at how far the broker is
_AHEAD = 2  # of these that may be under way
_PATIENCE = 5.0  # s for the broker


class JointPublisher:
    """Publishes what the arm does; QoS 0, nothing retained.

    Args:
        broker: host and port.
        robot: whose motor currents are computed back from joint torque.
        faults: what becomes of the messages.
        cut: ends the connections to the controller, where a fault asks for that.
        waits: wait for the broker where it is slower than the arm, as only an emulated arm can.
        node: when it publishes, and what; without it every sample once, at the controller's own times.

    Raises:
        NoBrokerError: nobody there.
    """

    def __init__(
        self,
        broker: tuple[str, int],
        robot: RobotDescription,
        faults: Faults,
        cut: Callable[[], None],
        waits: bool,
        node: LoopingNode | None,
    ) -> None:
        # τ = Cᵀ diag(gear) τ_motor, and τ_motor = constant · current.
        constants = np.array([joint.torque_constant or TORQUE_CONSTANT for joint in robot.joints])
        self._to_currents = np.linalg.inv(robot.coupling) / (robot.gear_ratios * constants)
        self._faults, self._cut, self._waits, self._node = faults, cut, waits, node
        self._published = 0
        self._marker = f"fake_controller/{secrets.token_hex(8)}"
        self._returned = threading.Semaphore(0)
        self._ready = threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_connect = self._connected
        self._client.on_subscribe = self._subscribed
        self._client.on_message = lambda *_: self._returned.release()
        try:
            self._client.connect(*broker)
        except OSError as error:
            raise NoBrokerError(f"no MQTT broker at {broker[0]}:{broker[1]}: {error.strerror or error}") from None
        self._client.loop_start()
        if not self._ready.wait(_PATIENCE):
            self.close()
            raise NoBrokerError(f"whoever listens at {broker[0]}:{broker[1]} is no MQTT broker")

    def close(self) -> None:
        """Leave the broker."""
        self._client.disconnect()
        self._client.loop_stop()

    def currents(self, torque: np.ndarray) -> np.ndarray:
        """Motor currents (S, n) [A] of joint torques (S, n) [N·m]."""
        return torque @ self._to_currents

    def publish(self, time_ns: np.ndarray, samples: Slice, spare: bool) -> None:
        """Publish samples with their controller times (K,) [ns]; `spare` as in `Faults.send`."""
        turns: Iterable[Publication]
        if self._node is None:
            turns = (Publication(stamp, k, CURRENTS_LATE, k) for k, stamp in enumerate(time_ns.tolist()))
        else:
            samples, turns = self._node.turns(time_ns, samples)
        filled = float(self._node is None)  # the published node fills no velocities
        columns = {
            POSITIONS: np.degrees(samples.position),
            VELOCITIES: filled * np.degrees(samples.velocity),
            TARGET_POSITIONS: np.degrees(samples.reference_position),
            TARGET_VELOCITIES: filled * np.degrees(samples.reference_velocity),
            CURRENTS: self.currents(samples.torque),
        }
        rows = {channel: values.tolist() for channel, values in columns.items()}
        for publication in turns:
            stamp = round(publication.stamp * ((1 + CLOCK_DRIFT) / 1000)) + CLOCK_OFFSET
            for channel in self._channels():
                k, late = (
                    (publication.current, publication.late // 1000) if channel is CURRENTS else (publication.sample, 0)
                )
                self._send(f"{TOPIC}/{channel}", encode_joints(rows[channel][k], stamp + late), spare)
            self._published += 1
            if self._waits and self._published % _PACE == 0:
                self._keep_pace()

    def _channels(self) -> tuple[str, ...]:
        if self._faults.acts("broker_gone"):
            return ()
        return CHANNELS[:-1] if self._faults.acts("topic_missing") else CHANNELS

    def _send(self, topic: str, payload: bytes, spare: bool) -> None:
        with contextlib.suppress(ConnectionResetError):
            self._faults.send(payload, lambda data: self._client.publish(topic, data), self._cut, spare)

    def _keep_pace(self) -> None:
        """A marker that comes back says that the broker has had everything before it."""
        if self._client.is_connected():
            self._returned.acquire(timeout=_PATIENCE)
            self._client.publish(self._marker, b"")

    def _connected(self, client: Client, *_: Any) -> None:
        client.subscribe(self._marker)

    def _subscribed(self, *_: Any) -> None:
        self._returned = threading.Semaphore(_AHEAD)
        self._ready.set()
