"""cyclonedds instead of rclpy: topics as CDR bytes, for a computer without ROS 2. It only listens."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any
from xml.sax.saxutils import quoteattr

from drivers.errors import DriverError
from drivers.transports.ros2.ros import DEPTH

_AT_ONCE = 500  # messages that are taken in one call


class _Raw(bytes):
    """A message as it came; cyclonedds adds where it came from."""


class Dds:
    """A participant of one domain that hands on messages as bytes.

    Args:
        domain: ROS_DOMAIN_ID.

    Raises:
        DriverError: the domain cannot be joined.
    """

    def __init__(self, domain: int) -> None:
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.core import DDSException, WaitSet
        from cyclonedds.domain import Domain, DomainParticipant

        config = None if "CYCLONEDDS_URI" in os.environ else _configuration()
        try:
            self._domain = None if config is None else Domain(domain, config)
            self._participant = DomainParticipant(domain)
            self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            self._waiting = WaitSet(self._participant)
        except DDSException as error:
            raise DriverError(
                f"cyclonedds cannot join domain {domain}: {error}; is the network up, and CYCLONEDDS_URI right?"
            ) from None
        self._best_effort: dict[str, bool] = {}  # by topic
        self._readers: list[tuple[Any, Callable[[bytes], None]]] = []

    def best_effort(self, topic: str) -> bool | None:
        """Whether somebody publishes this topic as best effort; None where nobody publishes it."""
        from cyclonedds.qos import Policy

        for publication in self._publications.take(N=_AT_ONCE):
            if name := getattr(publication, "topic_name", ""):
                best = Policy.Reliability.BestEffort in publication.qos
                self._best_effort[name] = self._best_effort.get(name, False) or best
        return self._best_effort.get(f"rt{topic}")

    def raw(self, package: str, name: str, topic: str, take: Callable[[bytes], None]) -> None:
        """Subscribe to CDR bytes; best effort where somebody publishes so, else reliable."""
        from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        reliable = Policy.Reliability.Reliable(max_blocking_time=duration(seconds=1))
        reliability = Policy.Reliability.BestEffort if self.best_effort(topic) else reliable
        kind = message_types()[f"{package}.{name}"]
        qos = Qos(reliability, Policy.History.KeepLast(DEPTH))
        reader = DataReader(self._participant, Topic(self._participant, f"rt{topic}", kind), qos=qos)
        unread = ReadCondition(reader, ViewState.Any | SampleState.NotRead | InstanceState.Alive)
        self._waiting.attach(unread)
        self._readers.append((reader, take))

    def spin_once(self, timeout: float) -> None:
        """Handle what has come, or wait for it [s]."""
        if not self._readers:
            time.sleep(timeout)
            return
        self._waiting.wait(int(timeout * 1e9))
        for reader, take in self._readers:
            while messages := reader.take(N=_AT_ONCE):
                for message in messages:
                    if isinstance(message, _Raw):
                        take(message)

    def close(self) -> None:
        """Leave the domain."""
        self._readers.clear()
        self._participant = self._publications = self._waiting = self._domain = None


def _configuration() -> str | None:
    """What the variables of ROS 2 say about discovery, for cyclonedds; None for its own defaults."""
    local = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    peers = [peer for peer in os.environ.get("ROS_STATIC_PEERS", "").split(";") if peer.strip()]
    if not local and not peers:
        return None
    lo = '<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces></General>' if local else ""
    peers += ["127.0.0.1"] if local else []
    listed = "".join(f"<Peer Address={quoteattr(peer.strip())}/>" for peer in peers)
    discovery = f"<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>{listed}</Peers></Discovery>"
    return f"<CycloneDDS><Domain>{lo}{discovery}</Domain></CycloneDDS>".encode("ascii", "ignore").decode()


def message_types() -> dict[str, Any]:
    """Types by the names that rclpy gives them, with the fields that matching needs; their messages stay bytes."""
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import float64, int32, sequence, uint32

    def struct(package: str, kind: str, /, **fields: Any) -> Any:
        return make_idl_struct(f"{kind}_", f"{package}::msg::dds_::{kind}_", fields)

    numbers, texts = sequence[float64], sequence[str]
    stamp = struct("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
    duration = struct("builtin_interfaces", "Duration", sec=int32, nanosec=uint32)
    header = struct("std_msgs", "Header", stamp=stamp, frame_id=str)
    rows = dict.fromkeys(("positions", "velocities", "accelerations", "effort"), numbers)
    point = struct("trajectory_msgs", "JointTrajectoryPoint", **rows, time_from_start=duration)
    vector = struct("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
    rotation = struct("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
    pose = struct("geometry_msgs", "Transform", translation=vector, rotation=rotation)
    twist = struct("geometry_msgs", "Twist", linear=vector, angular=vector)
    free = {"transforms": sequence[pose], "velocities": sequence[twist], "accelerations": sequence[twist]}
    several = struct("trajectory_msgs", "MultiDOFJointTrajectoryPoint", **free, time_from_start=duration)
    states = dict.fromkeys(("position", "velocity", "effort"), numbers)
    points = dict.fromkeys(("reference", "feedback", "error", "output"), point)
    more = {f"multi_dof_{name}": several for name in points}
    types = {
        "sensor_msgs.msg.JointState": struct("sensor_msgs", "JointState", header=header, name=texts, **states),
        "control_msgs.msg.JointTrajectoryControllerState": struct(
            "control_msgs",
            "JointTrajectoryControllerState",
            **{"header": header, "joint_names": texts, **points, "multi_dof_joint_names": texts, **more},
            speed_scaling_factor=float64,
        ),
    }
    for kind in types.values():
        kind.deserialize = staticmethod(_Raw)
    return types
