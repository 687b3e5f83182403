"""Names and bytes of ROS 2 that a JointTrajectoryController and its joint_state_broadcaster use.

A JointState in CDR (little endian, after four bytes of encapsulation; offsets count from there):

    int32 sec, uint32 nanosec, string frame_id, string[] name, float64[] position, velocity, effort

A string is its length with the final zero byte, and its bytes; each number stands at a multiple of its size.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from drivers.errors import ConfigurationError, ProtocolError
from drivers.texts import MANY, NAME, printable, public_address

JOINT_STATES, DESCRIPTION, MANAGER = "joint_states", "robot_description", "controller_manager"
_ADDRESS = re.compile(r"ros2://(\d{1,3})((?:/[A-Za-z_]\w*)+)((?:,beside=[\w/]+)*)", re.ASCII)
_DOMAINS = 232  # the ports of higher ones are beyond 65535
_ENCAPSULATION, _LITTLE = 4, b"\x00\x01\x00\x00"
_JOINTS = 256  # that one message may name: grippers and other groups may be among them


@dataclass(frozen=True)
class RosAddress:
    """`ros2://DOMAIN/NAMESPACE/CONTROLLER`, the namespace of any depth or none.

    `beside`: nodes that may hold a client of the controller, named by `,beside=NODE`; they do not command it.
    """

    domain: int
    namespace: str
    controller: str
    beside: tuple[str, ...] = ()

    @classmethod
    def of(cls, address: str) -> RosAddress:
        """Raises:
        ConfigurationError: not such an address.
        """
        match = _ADDRESS.fullmatch(str(address).strip())
        if match is None or int(match[1]) > _DOMAINS:
            raise ConfigurationError(
                f"address {public_address(address)!r}: ros2://DOMAIN/NAMESPACE/CONTROLLER is expected, such as "
                f"ros2://0/joint_trajectory_controller; the domain is 0 to {_DOMAINS}, a namespace may be left out"
            )
        *namespace, controller = match[2].strip("/").split("/")
        companions = tuple(part.removeprefix("beside=") for part in match[3].split(",") if part)
        return cls(int(match[1]), "".join(f"/{part}" for part in namespace), controller, companions)

    def name(self, *parts: str) -> str:
        """An absolute name in the namespace."""
        return "/".join((self.namespace, *parts))

    @property
    def node(self) -> str:
        """Name of the controller's node."""
        return self.name(self.controller)

    @property
    def action(self) -> str:
        """Name of its action."""
        return self.name(self.controller, "follow_joint_trajectory")


@dataclass(frozen=True, eq=False)
class JointSample:
    """One JointState: stamp [s], and position, velocity and effort (n,) in the order that was asked for; NaN where the
    message has none."""

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


@dataclass(frozen=True, eq=False)
class SetPoint:
    """One JointTrajectoryControllerState: stamp [s], position and velocity (n,) of its reference, and the factor of its
    speed."""

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    scaling: float


def columns(rows: Sequence[JointSample] | Sequence[SetPoint], *names: str) -> list[np.ndarray]:
    """These fields of samples or set-points, each as one array (K,) or (K, n)."""
    return [np.array([getattr(row, name) for row in rows]) for name in names]


Read = TypeVar("Read", bound=JointSample | SetPoint)


class JointReader(Generic[Read]):
    """Numbers by joint from CDR bytes that begin with a header and names.

    Names are looked up once, and again where they or their number change. Messages without all of the joints are other
    groups' and give None.
    """

    topic = ""
    arrays = 0  # of numbers, that are read

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._known: list[tuple[int, bytes]] = []  # where the texts are: what is between them is not defined
        self._begin = 0  # of the first array
        self._order: np.ndarray | None = None
        self._count = 0
        self._missing = np.full(len(self._joints), np.nan)

    def read(self, data: bytes) -> Read | None:
        """What the message says, in the order of the joints; None where it has not all of them.

        Raises:
            ProtocolError: another type, or damaged.
        """
        try:
            if not (self._known and all(data.startswith(text, offset) for offset, text in self._known)):
                self._look(data)
            at = self._begin
            arrays = []
            for _ in range(self.arrays):
                array, at = _numbers(data, at)
                arrays.append(array)
            if self._order is None:
                return None
            sec, nanosec = struct.unpack_from("<iI", data, _ENCAPSULATION)
            return self._made(data, sec + 1e-9 * nanosec, [self._ordered(array) for array in arrays])
        except (struct.error, ValueError, IndexError) as error:  # UnicodeDecodeError is a ValueError
            self._known = []
            raise ProtocolError(f"a message on {self.topic} is damaged, or of another type: {error}") from None

    def _made(self, data: bytes, stamp: float, rows: list[np.ndarray]) -> Read:
        raise NotImplementedError

    def _look(self, data: bytes) -> None:
        self._known, names, self._begin = _names(data)
        self._count = len(names)
        if len({*names}) != len(names):
            raise ValueError("it names a joint twice")
        self._order = np.array([names.index(joint) for joint in self._joints]) if {*self._joints} <= {*names} else None

    def _ordered(self, array: np.ndarray) -> np.ndarray:
        if len(array) == 0:
            return self._missing
        if len(array) != self._count:
            raise ValueError(f"{len(array)} numbers for {self._count} joints")
        ordered: np.ndarray = array[self._order]
        return ordered


class JointStateReader(JointReader[JointSample]):
    """Reads JointStates of these joints."""

    topic, arrays = JOINT_STATES, 3

    def _made(self, data: bytes, stamp: float, rows: list[np.ndarray]) -> JointSample:
        return JointSample(stamp, *rows)


class SetPointReader(JointReader[SetPoint]):
    """Reads JointTrajectoryControllerStates from Jazzy on: reference first, the speed scaling factor last."""

    topic, arrays = "controller_state", 2

    def _made(self, data: bytes, stamp: float, rows: list[np.ndarray]) -> SetPoint:
        return SetPoint(stamp, rows[0], rows[1], _scaling(data, self._begin))


def _names(data: bytes) -> tuple[list[tuple[int, bytes]], list[str], int]:
    """Where the texts of header and names are, with their bytes; the names; and where the first array begins."""
    if bytes(data[:4]) != _LITTLE:
        raise ValueError("not in little-endian CDR")
    at = _aligned(_string(data, 12)[1], 4)
    (count,) = struct.unpack_from("<I", data, at)
    if count > _JOINTS:
        raise ValueError(f"{count} joints")
    texts, names = [(12, bytes(data[12:16])), (at, bytes(data[at : at + 4]))], []
    at += 4
    for _ in range(count):
        begin = _aligned(at, 4)
        name, at = _string(data, begin)
        texts.append((begin, bytes(data[begin:at])))
        names.append(name)
    return texts, names, at


def _aligned(at: int, size: int) -> int:
    return at + -(at - _ENCAPSULATION) % size


def _string(data: bytes, at: int) -> tuple[str, int]:
    at = _aligned(at, 4)
    (length,) = struct.unpack_from("<I", data, at)
    if not 0 < length <= 4 * NAME or at + 4 + length > len(data):
        raise ValueError("a text without an end")
    return printable(bytes(data[at + 4 : at + 3 + length]).decode("utf-8")), at + 4 + length


def _numbers(data: bytes, at: int) -> tuple[np.ndarray, int]:
    at = _aligned(at, 4)
    (count,) = struct.unpack_from("<I", data, at)
    if count > _JOINTS:
        raise ValueError(f"{count} numbers")
    at = _aligned(at + 4, 8) if count else at + 4
    return np.frombuffer(data, "<f8", count, at), at + 8 * count


def _scaling(data: bytes, at: int) -> float:
    """The last number of a JointTrajectoryControllerState: four points lie before it, and four of several degrees of
    freedom, which are empty."""
    for _ in range(4):
        for _ in range(4):
            _, at = _numbers(data, at)
        at = _aligned(at, 4) + 8
    empty = struct.unpack_from("<I", data, at)
    at += 4
    for _ in range(4):
        empty += struct.unpack_from("<III", data, at)
        at += 20
    if any(empty):
        raise ValueError("joints of several degrees of freedom")
    (scaling,) = struct.unpack_from("<d", data, _aligned(at, 8))
    return float(scaling)


def names_in(data: bytes) -> tuple[str, ...]:
    """Names of the joints in a JointState or a JointTrajectoryControllerState, in its order.

    Raises:
        ProtocolError: another type, damaged, or no names of an arm.
    """
    try:
        return joints_of(_names(data)[1])
    except (struct.error, ValueError, IndexError) as error:
        raise ProtocolError(f"a message is damaged, or of another type: {error}") from None


def joints_of(names: Sequence[object]) -> tuple[str, ...]:
    """Names of joints as a controller says them.

    Raises:
        ProtocolError: none, or more than any arm has.
    """
    joints = tuple(str(name) for name in names)
    if not 1 <= len(joints) <= MANY or len(set(joints)) != len(joints):
        raise ProtocolError(f"the controller names {len(joints)} joints, of which {len(set(joints))} differ")
    return joints
