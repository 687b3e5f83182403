"""Listens to an arm on ROS 2 that somebody else moves: its samples and set-points, complete and in order."""

from __future__ import annotations

import functools
import importlib.util
import os
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from drivers.errors import ConfigurationError, DriverError, ProtocolError
from drivers.protocol import SampleBlock
from drivers.transports.ros2.dds import Dds
from drivers.transports.ros2.ros import Ros
from drivers.wire.ros2 import (
    JOINT_STATES,
    JointSample,
    JointStateReader,
    RosAddress,
    SetPoint,
    SetPointReader,
    columns,
    names_in,
)

#: Time [s] to wait for a publisher: those of killed programs are remembered for 20 s and delay discovery.
PATIENCE = 30.0
#: Messages of this time [s] are kept until joints and rate are known from them.
_SETTLING = 1.0
#: Share of a lateness of at most one period that is forgotten at each sample: by 1 % two clocks never differ.
#: Of 200 losses in 20 000 samples with 20 % jitter and 500 ppm drift: 200 found at 0.02, 201 at 0.1, 142 at 0.002.
_FORGOTTEN = 0.01
_TURN = 0.05  # s
_Read = TypeVar("_Read")


class WatchedArm:
    """Samples and set-points from the bytes of messages. The first ones wait until `settle`.

    The joints are those of the controller, where it publishes its state, else those of the largest message. Messages
    without all of them are counted and left out.
    """

    def __init__(self) -> None:
        self.joints: tuple[str, ...] = ()
        self.others: set[str] = set()  # joints of the messages that are not in the log
        self.rate = 0.0  # Hz, the median
        self.samples = self.set_points = 0
        self.lost = 0  # by gaps in the stamps
        self.longest = 0.0  # s, the longest of them
        self.clock_steps = 0  # stamps older than the one before
        self.foreign = 0  # messages without all of the joints
        self.unreadable = 0  # states of the controller in another layout
        self.damaged = 0  # joint states that cannot be read
        self._first: list[tuple[bool, bytes]] = []
        self._readers: tuple[JointStateReader, SetPointReader] | None = None
        self._samples: list[JointSample] = []
        self._set_points: list[SetPoint] = []
        self._numbers: list[int] = []
        self._last: float | None = None
        self._behind = self._behind_before = 0.0  # periods
        self._period = 0.0

    @property
    def seen(self) -> bool:
        """Whether a joint state has come."""
        return self.samples > 0 or any(not state for state, _ in self._first)

    def take(self, state: bool, data: bytes) -> None:
        """A JointState, or (`state`) a JointTrajectoryControllerState."""
        if self._readers is None:
            self._first.append((state, bytes(data)))
        elif state:
            self._take_set_point(self._readers[1], data)
        else:
            self._take_sample(self._readers[0], data)

    def settle(self) -> None:
        """Decide on joints and rate, by what has come.

        Raises:
            ProtocolError: no message can be read.
        """
        samples = [names for state, data in self._first if not state and (names := _or_none(names_in, data))]
        if not samples:
            raise ProtocolError(f"no message on {JOINT_STATES} can be read: is it sensor_msgs/msg/JointState?")
        wanted = next((names for state, data in self._first if state and (names := _or_none(names_in, data))), ())
        complete = [names for names in samples if wanted and {*wanted} <= {*names}]
        self.joints = wanted if complete else max(samples, key=len)
        self.others = {name for names in samples for name in names} - {*self.joints}
        reader = JointStateReader(self.joints)
        read = (_or_none(reader.read, data) for state, data in self._first if not state)
        steps = np.diff([sample.stamp for sample in read if sample is not None])
        steps = steps[steps > 0.0]
        self._period = float(np.median(steps)) if len(steps) else 0.0
        self.rate = 1.0 / self._period if self._period else 0.0
        self._readers = reader, SetPointReader(self.joints)
        waiting, self._first = self._first, []
        for state, data in waiting:
            self.take(state, data)

    def new_samples(self, received: float) -> SampleBlock | None:
        """What has come since the last call; `received` is the time of this computer [s]."""
        samples, self._samples = self._samples, []
        numbers, self._numbers = self._numbers, []
        if not samples:
            return None
        time, position, velocity, effort = columns(samples, "stamp", "position", "velocity", "effort")
        speed = velocity if np.isfinite(velocity).any() else None
        return SampleBlock(np.array(numbers), time, position, speed, effort, None, None, received)

    def new_set_points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Stamps (K,) [s], positions and velocities (K, n) since the last call."""
        points, self._set_points = self._set_points, []
        if not points:
            return None
        stamp, position, velocity = columns(points, "stamp", "position", "velocity")
        return stamp, position, velocity

    def _take_sample(self, reader: JointStateReader, data: bytes) -> None:
        try:
            sample = reader.read(data)
        except ProtocolError:
            self.damaged += 1
            return
        if sample is None:
            self.foreign += 1
            return
        self._count_losses(sample.stamp)
        self._numbers.append(self.samples + self.lost)
        self._samples.append(sample)
        self.samples += 1

    def _take_set_point(self, reader: SetPointReader, data: bytes) -> None:
        try:
            set_point = reader.read(data)
        except ProtocolError:
            self.unreadable += 1
            return
        if set_point is not None:
            self._set_points.append(set_point)
            self.set_points += 1

    def _count_losses(self, stamp: float) -> None:
        """A late sample is followed by a short step, a lost one is not: what both of two samples are behind is lost."""
        before, self._last = self._last, stamp
        if before is None or not self._period:
            return
        step = stamp - before
        if step < 0.0:
            self.clock_steps += 1
            self._behind = self._behind_before = 0.0
            return
        self._behind += step / self._period - 1.0 - _FORGOTTEN * min(max(self._behind, -1.0), 1.0)
        lost = round(min(self._behind, self._behind_before))
        if lost > 0:
            self.lost += lost
            self._behind -= lost
        if step > 1.5 * self._period:
            self.longest = max(self.longest, step)
        self._behind_before = self._behind


class RosWatch:
    """Subscriptions to one arm that is not driven from here.

    Args:
        address: as of the driver.
        tell: takes messages on what is waited for.

    Raises:
        ConfigurationError: no such address, or neither rclpy nor cyclonedds here.
        DriverError: the domain cannot be joined.
    """

    def __init__(self, address: str, tell: Callable[[str], None]) -> None:
        self.target = RosAddress.of(address)
        self.observed = WatchedArm()
        self.without = ""  # why there are no set-points
        self._tell = tell
        self._node = _listener(self.target.domain)

    def open(self, patience: float = PATIENCE) -> None:
        """Subscribe, and wait for the first samples.

        Raises:
            DriverError: nobody publishes, or something else; the message says on which topic.
        """
        states = self.target.name(JOINT_STATES)
        self._tell(f"waiting up to {patience:g} s for {states} in domain {self.target.domain}")
        until = time.monotonic() + patience
        while self._node.best_effort(states) is None:
            self._wait_or_fail(until, f"nobody publishes {states} in domain {self.target.domain}")
        self._node.raw("sensor_msgs.msg", "JointState", states, functools.partial(self.observed.take, False))
        topic = self.target.name(self.target.controller, "controller_state")
        try:
            take = functools.partial(self.observed.take, True)
            self._node.raw("control_msgs.msg", "JointTrajectoryControllerState", topic, take)
        except DriverError as error:
            self.without = str(error)
        while not self.observed.seen:
            self._wait_or_fail(until, f"{states} has a publisher, and no message of it arrives")
        settled = time.monotonic() + _SETTLING
        while time.monotonic() < settled:
            self._node.spin_once(_TURN)

    def receive(self) -> None:
        """Take what has come, or wait for it a short time."""
        self._node.spin_once(_TURN)

    def close(self) -> None:
        """End the subscriptions."""
        self._node.close()

    def _wait_or_fail(self, until: float, what: str) -> None:
        if time.monotonic() >= until:
            reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "not set")
            raise DriverError(
                f"{what}; check domain, namespace and joint_state_broadcaster, and that the network lets multicast "
                f"through, else set ROS_STATIC_PEERS (ROS_AUTOMATIC_DISCOVERY_RANGE is {reach})"
            )
        self._node.spin_once(_TURN)


def _listener(domain: int) -> Ros | Dds:
    if importlib.util.find_spec("rclpy") is not None:
        return Ros(domain, f"calibration_agent_watch_{os.getpid()}")
    if importlib.util.find_spec("cyclonedds") is not None:
        return Dds(domain)
    raise ConfigurationError(
        "--watch needs ROS 2 or cyclonedds: source ROS 2, or pip install 'calibration-agent[dds]' "
        "(Python 3.11 to 3.13, x86-64)"
    )


def _or_none(read: Callable[[bytes], _Read], data: bytes) -> _Read | None:
    try:
        return read(data)
    except ProtocolError:
        return None
