"""What CNR's open socket programs and C5G Open node put on the wire; docs/real-robot.md is the same for people.

Sockets: 4-byte fields without padding. A header ``length msg_type comm_type reply_code``, where `length` counts what
follows it, then one of three records. Everything on the trajectory socket, answers included, is a `Point`.
Broker: JSON objects ``{"J1": …, …, "J10": …, "time": …}`` that end with a NUL byte.

Units here are the wire's: degrees, millimetres, amperes, m/s, milliseconds (sockets) and microseconds (broker).
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from enum import IntEnum
from operator import itemgetter
from typing import Any, ClassVar

from drivers.errors import ProtocolError
from drivers.wire.stream import StreamDecoder

TRAJECTORY_PORT, FEEDBACK_PORT, STATUS_PORT = 1212, 1213, 1214
AXES = 10  # of every array of joints, whatever the arm has
QUEUE_NODES = 200

#: The programs run on a little-endian processor and write integers and reals as they lie in memory.
LITTLE, BIG = "<", ">"


class MessageType(IntEnum):
    """`msg_type`."""

    PING = 1
    STATUS = 13
    POINT = 3001
    FINISHED = 3002  # the last point of the trajectory was sent
    FEEDBACK = 3004
    START = 3010
    STOP = 3011
    CANCEL = 3012
    SHUTDOWN = 3020


class CommType(IntEnum):
    """`comm_type`."""

    TOPIC = 1
    REQUEST = 2
    REPLY = 3


class ReplyCode(IntEnum):
    """`reply_code`; requests carry none."""

    NONE = 0
    SUCCESS = 1
    FAILURE = 2


class QueueStatus(IntEnum):
    """`queue_status` of an answer: may the next point come?"""

    READY = 1
    BUSY = 2
    ERROR = 3  # the sequence number is not the next one


class Mode(IntEnum):
    """`mode` of a status."""

    INVALID = -1
    MANUAL = 1
    AUTO = 2


@dataclass(frozen=True)
class Point:
    """A via-point, and what commands and their answers are made of. Joints in degrees, `linear_vel` in m/s.

    `fly_tolerance` [mm] is how far the arm may pass by the point.
    """

    FIELDS: ClassVar[str] = "iiiff10fi"

    arm: int = 1
    queue_status: int = 0
    sequence_number: int = 0
    fly_tolerance: float = 0.0
    linear_vel: float = 0.0
    joints: tuple[float, ...] = (0.0,) * AXES
    digital_output: int = 0


@dataclass(frozen=True)
class Feedback:
    """Where the arm is, some 50 times a second. Frames: x, y, z [mm], Euler angles a, e, r [deg]; `time` [ms]."""

    FIELDS: ClassVar[str] = "i6f6f6f10f10f6fiii"

    arm: int
    base: tuple[float, ...]
    user: tuple[float, ...]
    tool: tuple[float, ...]
    joints: tuple[float, ...]  # deg
    currents: tuple[float, ...]  # A
    cartesian: tuple[float, ...]
    last_point_processed: int
    time: int
    is_moving: int


@dataclass(frozen=True)
class StatusMessage:
    """State of the controller: 1 is yes, 0 no, -1 not known; `mode` is a `Mode`."""

    FIELDS: ClassVar[str] = "iiiiiii"

    drives_powered: int
    e_stopped: int
    error_code: int
    in_error: int
    in_motion: int
    mode: int
    motion_possible: int


Record = Point | Feedback | StatusMessage


@dataclass(frozen=True)
class Message:
    """A header without its length, and its record."""

    type: int
    comm: int
    reply: int
    record: Record


_HEADER = "iiii"
_LARGEST = 4096  # bytes; a length beyond is no length
_RECORDS: dict[int, type[Record]] = {MessageType.STATUS: StatusMessage, MessageType.FEEDBACK: Feedback}
#: Values of each field.
_SHAPES = {
    record: tuple(int(count or 1) for count in re.findall(r"(\d*)[if]", record.FIELDS))
    for record in (Point, Feedback, StatusMessage)
}
_STRUCTS = {(record, order): struct.Struct(order + record.FIELDS) for record in _SHAPES for order in (LITTLE, BIG)}
_HEADERS = {order: struct.Struct(order + _HEADER) for order in (LITTLE, BIG)}


def encode(message: Message, order: str = LITTLE) -> bytes:
    """The bytes of a message.

    Raises:
        ValueError: an array of another length than its field.
    """
    record = message.record
    values: list[Any] = []
    for value, count in zip(astuple(record), _SHAPES[type(record)], strict=True):
        items = value if count > 1 else (value,)
        if len(items) != count:
            raise ValueError(f"a field of {type(record).__name__} has {len(items)} values; {count} are expected")
        values += items
    try:
        body = _STRUCTS[type(record), order].pack(*values)
    except struct.error as error:
        raise ValueError(f"{type(record).__name__}: {error}") from None
    length = _HEADERS[order].size - 4 + len(body)
    return _HEADERS[order].pack(length, message.type, message.comm, message.reply) + body


class MessageDecoder(StreamDecoder[Message]):
    """Messages of the socket programs; `order` is None until the first length told it."""

    def __init__(self, order: str | None = None) -> None:
        super().__init__()
        self.order = order

    def _next(self) -> Message | None:
        if len(self._buffer) < 4:
            return None
        if self.order is None:
            self.order = _order_of(self._buffer)
        header = _HEADERS[self.order]
        if len(self._buffer) < header.size:
            self._check_length(struct.unpack_from(self.order + "i", self._buffer)[0])
            return None
        length, kind, comm, reply = header.unpack_from(self._buffer)
        self._check_length(length)
        record = _RECORDS.get(kind, Point)
        layout = _STRUCTS[record, self.order]
        if length != header.size - 4 + layout.size:
            raise ProtocolError(
                f"a message of type {kind} announces {length} bytes; "
                f"{header.size - 4 + layout.size} are expected: is an older version of the socket programs there?"
            )
        if len(self._buffer) < 4 + length:
            return None
        values = iter(layout.unpack_from(self._buffer, header.size))
        del self._buffer[: 4 + length]
        fields: list[Any] = [
            next(values) if count == 1 else tuple(next(values) for _ in range(count)) for count in _SHAPES[record]
        ]
        return Message(kind, comm, reply, record(*fields))

    def _check_length(self, length: int) -> None:
        if not 0 < length <= _LARGEST:
            raise ProtocolError(f"these are not the socket programs: a message announces {length} bytes")


def _order_of(data: bytearray) -> str:
    for order in (LITTLE, BIG):
        if 0 < struct.unpack_from(order + "i", data)[0] <= _LARGEST:
            return order
    raise ProtocolError(f"these are not the socket programs: a message begins with {bytes(data[:4])!r}")


#: What the C5G Open node publishes under `TOPIC`, one topic each.
TOPIC = "robot/arm1"
POSITIONS, VELOCITIES = "real_joints_positions", "real_joints_velocities"
TARGET_POSITIONS, TARGET_VELOCITIES = "target_joints_positions", "target_joints_velocities"
CURRENTS = "motor_currents"
CHANNELS = (POSITIONS, VELOCITIES, TARGET_POSITIONS, TARGET_VELOCITIES, CURRENTS)

_LONGEST_JOINTS = 4096  # bytes
_LATEST_US = 2**53  # µs, 285 years: a float still has every one of them
_KEYS = tuple(f"J{axis}" for axis in range(1, AXES + 1))
_values = itemgetter(*_KEYS)


def encode_joints(values: Sequence[float], time_us: int) -> bytes:
    """What a topic carries: up to ten values, joint side (currents: of the motors), and their time."""
    padded = [*map(float, values), *[0.0] * (AXES - len(values))]
    return json.dumps({**dict(zip(_KEYS, padded, strict=True)), "time": int(time_us)}).encode() + b"\0"


def decode_joints(payload: bytes) -> tuple[int, tuple[float, ...]]:
    """Time [µs] and the ten values of a topic's message.

    Raises:
        ProtocolError: not such a message.
    """
    if len(payload) > _LONGEST_JOINTS:
        raise ProtocolError(f"a message of {len(payload)} bytes; the C5G Open node's have some hundreds")
    try:
        data = json.loads(payload.rstrip(b"\0").decode())
        time_us, values = int(data["time"]), _values(data)
        finite = all(map(math.isfinite, values))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ProtocolError(f"not a message of the C5G Open node: {type(error).__name__}: {error}") from None
    if abs(time_us) > _LATEST_US:
        raise ProtocolError("a message of the C5G Open node has a time that no clock shows")
    if not finite:
        raise ProtocolError("a message of the C5G Open node has values that are no numbers")
    return time_us, values


#: A text file in the folder of the programs, written once by whoever sets the link up: what no socket tells.
IDENTITY_FILE = "agent_identity.json"
#: Another one there: the name of the program that a start without points runs.
PROGRAM_FILE = "agent_program.txt"
