"""Frames and messages of the binary TCP link; docs/wire-tcp.md is the same for people.

A frame is ``magic(4) version(1) type(1) reserved(2) length(4) request(4) payload(length) crc32(4)``, little-endian;
the CRC-32 (IEEE 802.3, as in zlib) covers everything before it. `request` pairs an answer with its question and is 0
in what nobody asked for. One class below is one message: its annotations, in order, are its fields.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, fields
from io import BytesIO
from typing import Annotated, Any, ClassVar, Self, dataclass_transform, get_type_hints

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire.fields import Blob, Boolean, FieldKind, Many, Number, Padded, Utf8
from drivers.wire.stream import StreamDecoder

MAGIC = b"CALK"
VERSION = 1
HEADER = struct.Struct("<4sBBHII")
TRAILER = struct.Struct("<I")

MAX_REQUEST_PAYLOAD = 64 * 1024  # client to controller
MAX_REPLY_PAYLOAD = 1024 * 1024  # controller to client
UPLOAD_BLOCK = 32 * 1024
MAX_BATCH = 1000  # samples in one frame
MAX_JOINTS = 16
MAX_SEQUENCE = 2**62

U16 = Annotated[int, Number("<H")]
U32 = Annotated[int, Number("<I")]
U64 = Annotated[int, Number("<Q")]
F64 = Annotated[float, Number("<d")]
Flag = Annotated[bool, Boolean()]
Text = Annotated[str, Utf8()]
Texts = Annotated[tuple[str, ...], Many(Utf8())]
Floats = Annotated[tuple[float, ...], Many(Number("<d"))]
Bytes = Annotated[bytes, Blob()]
Bytes16 = Annotated[bytes, Padded(16)]

MESSAGES: dict[int, Any] = {}  # by type number


@dataclass_transform(frozen_default=True)
class FrameMessage:
    """A frozen dataclass whose annotated fields are a message's layout, under a type number.

    A subclass is written `class Stop(FrameMessage, number=0x08)`; it is packed field by field.
    """

    TYPE: ClassVar[int]
    LAYOUT: ClassVar[tuple[tuple[str, FieldKind], ...]]

    def __init_subclass__(cls, number: int) -> None:
        dataclass(frozen=True)(cls)
        hints = get_type_hints(cls, include_extras=True)
        cls.TYPE = number
        cls.LAYOUT = tuple((item.name, hints[item.name].__metadata__[0]) for item in fields(cls))  # type: ignore
        MESSAGES[number] = cls

    def pack(self) -> bytes:
        return b"".join(kind.pack(getattr(self, name)) for name, kind in self.LAYOUT)

    @classmethod
    def unpack(cls, payload: bytes) -> Any:
        stream = BytesIO(payload)
        values = {name: kind.unpack(stream) for name, kind in cls.LAYOUT}
        if more := len(stream.read()):
            raise ProtocolError(f"a message has {more} bytes more than its fields")
        return cls(**values)


class Hello(FrameMessage, number=0x01):
    """First message of a client: the newest version it speaks and the watchdog it would like."""

    version: U16
    watchdog_ms: U32
    client: Text


class Welcome(FrameMessage, number=0x81):
    """The version and the watchdog that are in force from now on, both ways."""

    version: U16
    watchdog_ms: U32


class Identify(FrameMessage, number=0x02):
    """Request for the identity."""


class IdentityReply(FrameMessage, number=0x82):
    """`period` [s] of interpolation and sampling."""

    robot: Text
    serial: Text
    controller: Text
    version: Text
    joint_names: Texts
    period: F64


class AskStatus(FrameMessage, number=0x03):
    """Request for the status."""


class StatusReply(FrameMessage, number=0x83):
    """`drivers.protocol.Status`, field by field."""

    drives_on: Flag
    mode: Text
    emergency_stop: Flag
    alarms: Texts
    override: F64
    cell_closed: Flag
    moving: Flag
    program: Text
    checksum: Text
    position: Floats
    emulator: Flag


class UploadBegin(FrameMessage, number=0x04):
    """A program of `size` bytes is coming; `checksum` is the SHA-256 (hex) of its bytes."""

    name: Text
    size: U32
    checksum: Text


class UploadBlock(FrameMessage, number=0x05):
    """The bytes from `offset` on; blocks come in order."""

    offset: U32
    data: Bytes


class UploadEnd(FrameMessage, number=0x06):
    """Check, translate and store what came."""


class Stored(FrameMessage, number=0x86):
    """The SHA-256 (hex) of the text as it is stored now."""

    name: Text
    checksum: Text


class Start(FrameMessage, number=0x07):
    """Run the program once. A `motion_id` is good for one start, ever."""

    name: Text
    checksum: Text
    motion_id: Bytes16


class Started(FrameMessage, number=0x87):
    """The motion with this id has begun."""

    motion_id: Bytes16


class Stop(FrameMessage, number=0x08):
    """Come to rest on the path. Answered by `Done` at once; `End` follows when the arm rests."""


class Fetch(FrameMessage, number=0x09):
    """Send samples again, out of the ring: at most `count`, the first at or after sequence number `first`."""

    first: U64
    count: U32


class Heartbeat(FrameMessage, number=0x0A):
    """I am here. Either way, never answered."""


class AskTemperatures(FrameMessage, number=0x0B):
    """How warm are the motors? A controller from before there was this question refuses it."""


class TemperaturesReply(FrameMessage, number=0x8B):
    """One a joint [°C]; none where the controller measures none."""

    celsius: Floats


class AskFrames(FrameMessage, number=0x0C):
    """Which frames are in force? A controller from before there was this question refuses it."""


class FramesReply(FrameMessage, number=0x8C):
    """Each as the six numbers of a POS: x, y, z [mm], Euler angles a, e, r [deg] about the moving axes z, y, z."""

    base: Floats
    tool: Floats
    uframe: Floats


class Done(FrameMessage, number=0x80):
    """The request was carried out and there is nothing more to say."""


class End(FrameMessage, number=0x91):
    """The motion is over and the arm rests; `samples` is how many there were, `reason` an `EndReason`."""

    reason: U16
    samples: U64
    message: Text


class Refused(FrameMessage, number=0xFF):
    """The request was refused: a `Refusal`, a sentence for people, and a position in program text (from 1; 0: none)."""

    code: U16
    line: U32
    column: U32
    message: Text


@dataclass(frozen=True, eq=False)
class Samples:
    """K consecutive samples of n joints, from sequence number `first`.

    time_ns (K,) int64 controller time; position, velocity, torque, reference_position, reference_velocity (K, n).
    Payload: ``first(8) count(2) joints(1) time_ns(8·K)``, then the five arrays in that order, sample by sample.
    """

    TYPE: ClassVar[int] = 0x90
    _HEAD: ClassVar[struct.Struct] = struct.Struct("<QHB")

    first: int
    time_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    reference_position: np.ndarray
    reference_velocity: np.ndarray

    @classmethod
    def size(cls, count: int, joints: int) -> int:
        """Bytes of the payload."""
        return cls._HEAD.size + count * (8 + 5 * joints * 8)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The five arrays (K, n), in the order of the payload."""
        return self.position, self.velocity, self.torque, self.reference_position, self.reference_velocity

    def pack(self) -> bytes:
        count, joints = self.position.shape
        arrays = (self.time_ns.astype("<i8"), *(column.astype("<f8") for column in self.columns))
        return b"".join((self._HEAD.pack(self.first, count, joints), *(array.tobytes() for array in arrays)))

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Raises:
        ProtocolError: the payload does not fit its own head.
        """
        if len(payload) < cls._HEAD.size:
            raise ProtocolError("a sample message is shorter than its head")
        first, count, joints = cls._HEAD.unpack_from(payload)
        if not 1 <= count <= MAX_BATCH or not 1 <= joints <= MAX_JOINTS or first > MAX_SEQUENCE:
            raise ProtocolError(f"a sample message announces {count} samples of {joints} joints from {first}")
        if len(payload) != cls.size(count, joints):
            raise ProtocolError(
                f"a sample message of {len(payload)} bytes, where its head announces {cls.size(count, joints)}"
            )
        time_ns = np.frombuffer(payload, "<i8", count, cls._HEAD.size)
        values = np.frombuffer(payload, "<f8", 5 * count * joints, cls._HEAD.size + 8 * count)
        return cls(first, time_ns, *values.astype(float, copy=False).reshape(5, count, joints))


MESSAGES[Samples.TYPE] = Samples


@dataclass(frozen=True)
class Frame:
    """One frame whose checksum is right; its payload is not looked at yet."""

    type: int
    request: int
    payload: bytes


def encode(message: Any, request: int = 0) -> bytes:
    """The frame of a message."""
    payload = message.pack()
    head = HEADER.pack(MAGIC, VERSION, message.TYPE, 0, len(payload), request)
    return head + payload + TRAILER.pack(zlib.crc32(payload, zlib.crc32(head)))


def decode(frame: Frame) -> Any:
    """The message in a frame.

    Raises:
        ProtocolError: unknown type, or a payload that does not fit it.
    """
    codec = MESSAGES.get(frame.type)
    if codec is None:
        raise ProtocolError(f"unknown message type 0x{frame.type:02x}")
    return codec.unpack(frame.payload)


class FrameDecoder(StreamDecoder[Frame]):
    """Frames of at most `max_payload` bytes."""

    def __init__(self, max_payload: int) -> None:
        super().__init__()
        self._max_payload = max_payload

    def _next(self) -> Frame | None:
        buffer = self._buffer
        prefix = bytes(buffer[: len(MAGIC)])
        if not MAGIC.startswith(prefix):
            raise ProtocolError(f"this is not the calibration link: a frame begins with {prefix!r}")
        if len(buffer) < HEADER.size:
            return None
        _, version, kind, reserved, length, request = HEADER.unpack_from(buffer)
        if version != VERSION or reserved:
            raise ProtocolError(f"a frame of version {version}; this end speaks version {VERSION}")
        if length > self._max_payload:
            raise ProtocolError(f"a frame announces {length} bytes; at most {self._max_payload} are allowed")
        end = HEADER.size + length
        if len(buffer) < end + TRAILER.size:
            return None
        body = bytes(buffer[:end])
        if TRAILER.unpack_from(buffer, end)[0] != zlib.crc32(body):
            raise ProtocolError(f"a frame of type 0x{kind:02x} is damaged: its checksum is wrong")
        del buffer[: end + TRAILER.size]
        return Frame(kind, request, body[HEADER.size :])
