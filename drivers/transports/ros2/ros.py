"""rclpy in one context: nodes, polled subscriptions, parameters, cancelling; types come from the robot's distribution.

No executor reads samples: a callback for each message costs a busy computer more time than there is between two. They
wait in the middleware and are taken all at once, turn by turn.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DriverError
from drivers.joint_trajectory import RATES
from drivers.transports.ros2.following import brake_point
from drivers.wire.ros2 import RosAddress

#: Samples that wait in the middleware: at 10 a busy process loses one in ten, at 2000 it loses nothing.
DEPTH = 2000
#: Fast DDS by UDP alone. By shared memory, 2 of 29 agents that were killed kept the emulator from publishing for 3.0 s,
#: as by a lock that they held.
_TRANSPORT = "FASTDDS_BUILTIN_TRANSPORTS", "UDPv4"
#: rmw_fastrtps adds shared memory to a discovery range of LOCALHOST, so a profile says the same instead.
_RANGE, _LOCAL = "ROS_AUTOMATIC_DISCOVERY_RANGE", str(Path(__file__).with_name("local_udp.xml"))
_PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"  # of Fast DDS 2 (Jazzy) and 3 (Kilted)
_ANSWERS = 0.015  # s between two looks for answers: one takes as long as ten samples


def typed(package: str, name: str) -> Any:
    """A type of the sourced distribution, or None where its package is not there."""
    try:
        return getattr(importlib.import_module(package), name)
    except ImportError:
        return None


def needed(package: str, name: str) -> Any:
    """A type of the sourced distribution.

    Raises:
        DriverError: it is not there.
    """
    kind = typed(package, name)
    if kind is None:
        raise DriverError(f"the ROS 2 that is sourced here has no {package}.{name}; install {package.split('.')[0]}")
    return kind


@functools.cache
def _begins() -> bool:
    """Whether ROS 2 begins in this process only now: Fast DDS reads profiles once."""
    return "rclpy" not in sys.modules


@contextlib.contextmanager
def _udp_alone() -> Iterator[None]:
    """While rclpy begins: by UDP alone. What the user has chosen stays: middleware, transports, profile, peers."""
    asked = os.environ.get(_RANGE, "")
    from rclpy.utilities import get_rmw_implementation_identifier

    local = (
        os.environ.setdefault(*_TRANSPORT) == _TRANSPORT[1]
        and (_begins() and asked == "LOCALHOST" and not os.environ.get("ROS_STATIC_PEERS"))
        and get_rmw_implementation_identifier().startswith("rmw_fastrtps")
        and all(os.environ.setdefault(name, _LOCAL) == _LOCAL for name in _PROFILES)
    )
    if local:
        os.environ[_RANGE] = "SYSTEM_DEFAULT"
    try:
        yield
    finally:
        if local:
            os.environ[_RANGE] = asked


class Ros:
    """A node of our own, and its executor.

    Args:
        domain: ROS_DOMAIN_ID.
        name: of the node.

    Raises:
        DriverError: no ROS 2 here, or too old a one.
    """

    def __init__(self, domain: int, name: str) -> None:
        _begins()
        try:
            import rclpy
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.node import Node
        except ImportError as error:
            raise DriverError(
                f"this Python has no ROS 2 from Jazzy on ({error}): source it first, as with `source "
                "/opt/ros/jazzy/setup.bash`, and use a Python environment with --system-site-packages; "
                f"{sys.executable} is in use"
            ) from None
        self.context = rclpy.Context()
        no_handlers = rclpy.SignalHandlerOptions.NO  # or SIGTERM would end nothing
        with _udp_alone():
            rclpy.init(context=self.context, domain_id=domain, signal_handler_options=no_handlers)
        options = {"start_parameter_services": False, "enable_rosout": False}
        self.node, self._listener = (
            Node(each, context=self.context, use_global_arguments=False, **options)
            for each in (name, f"{name}_listener")
        )
        self._polled: list[tuple[Any, Any, Callable[[bytes], None]]] = []
        self._executor, self._answers_due = SingleThreadedExecutor(context=self.context), 0.0
        self._executor.add_node(self.node)
        #: rclpy loses the answer to a goal that comes before the goal is noted: whoever sends one holds this.
        self.sending = threading.RLock()

    def spin_once(self, timeout: float) -> None:
        """Handle all messages that come within `timeout` [s], and an answer, where one is there."""
        time.sleep(timeout)
        if time.monotonic() >= self._answers_due:
            self._answers_due = time.monotonic() + _ANSWERS
            with self.sending:
                self._executor.spin_once(timeout_sec=0.0)
        self.take_messages()

    def take_messages(self) -> None:
        """Handle the messages that have come."""
        for subscription, kind, take in self._polled.copy():
            for _ in range(DEPTH):
                message = subscription.handle.take_message(kind, True)
                if message is None:
                    break
                take(message[0])

    def spin_for(self, seconds: float) -> None:
        """Handle what comes for some time [s]."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.spin_once(0.02)

    def best_effort(self, topic: str) -> bool | None:
        """Whether somebody publishes this topic as best effort; None where nobody publishes it."""
        from rclpy.qos import ReliabilityPolicy

        infos = self.node.get_publishers_info_by_topic(topic)
        best = [info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in infos]
        return any(best) if best else None

    def raw(self, package: str, name: str, topic: str, take: Callable[[bytes], None], depth: int = DEPTH) -> None:
        """Subscribe to CDR bytes; best effort where somebody publishes so, else reliable. `spin_once` hands them out.

        Raises:
            DriverError: the type is not there.
        """
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        kind = needed(package, name)
        reliability = ReliabilityPolicy.BEST_EFFORT if self.best_effort(topic) else ReliabilityPolicy.RELIABLE
        quality = QoSProfile(depth=depth, reliability=reliability)
        subscription = self._listener.create_subscription(kind, topic, take, quality, raw=True)
        self._polled.append((subscription, kind, take))

    def commands(self, target: RosAddress) -> Any:
        """A publisher of trajectories to the controller."""
        kind = needed("trajectory_msgs.msg", "JointTrajectory")
        return self.node.create_publisher(kind, target.name(target.controller, "joint_trajectory"), 10)

    def parameters(
        self, node: str, timeout: float, wait: Callable[[Callable[[], bool], float], bool]
    ) -> dict[str, Any]:
        """All parameters of a node by their names; empty where it does not answer in time."""
        from rclpy.parameter import parameter_value_to_python
        from rclpy.parameter_client import AsyncParameterClient

        client = AsyncParameterClient(self.node, node)
        if not wait(client.services_are_ready, timeout):
            return {}
        listed = client.list_parameters([], 0)
        if not wait(listed.done, timeout):
            return {}
        names = [str(name) for name in listed.result().result.names][:2000]
        asked = client.get_parameters(names)
        if not wait(asked.done, timeout):
            return {}
        values = asked.result().values
        return {name: parameter_value_to_python(value) for name, value in zip(names, values, strict=False)}

    def cancel_all(self, target: RosAddress) -> None:
        """Cancel every goal of the controller, whoever sent it; needs no control_msgs. Returns at once."""
        kind = typed("action_msgs.srv", "CancelGoal")
        client = self.node.create_client(kind, f"{target.action}/_action/cancel_goal")
        if client.service_is_ready() or client.wait_for_service(0.2):
            client.call_async(kind.Request())  # no id and no stamp: all of them

    def close(self) -> None:
        """End the node; never raises."""
        ends = (self.node.destroy_node, self._listener.destroy_node, self.context.try_shutdown)
        for end in (self._executor.shutdown, *ends):
            with contextlib.suppress(Exception):  # what is left of it ends with the process
                end()


def send_brake(
    publisher: Any, joints: Iterable[str], strength: np.ndarray, position: np.ndarray, velocity: np.ndarray
) -> float:
    """Send the one point that brings an arm to rest from this state (n,); how long that takes [s]."""
    seconds, goal = brake_point(position, velocity, strength)
    publisher.publish(trajectory_message(joints, [(seconds, goal, 0.0 * goal)]))
    return seconds


def trajectory_message(joints: Iterable[str], points: Sequence[Sequence[Any]]) -> Any:
    """A JointTrajectory that begins at once, of points (time [s], positions, velocities and, where given,
    accelerations)."""
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    message = JointTrajectory(joint_names=list(joints))
    for time_from_start, *rows in points:
        point = JointTrajectoryPoint(**dict(zip(RATES, (np.asarray(row).tolist() for row in rows), strict=False)))
        set_time(point.time_from_start, time_from_start)
        message.points.append(point)
    return message


def set_time(message: Any, seconds: float) -> None:
    """Set a Time or Duration."""
    message.sec, message.nanosec = divmod(round(seconds * 1e9), 10**9)
