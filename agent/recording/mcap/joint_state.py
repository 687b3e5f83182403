"""`sensor_msgs/msg/JointState` in CDR, many messages at a time.

As long as names and array lengths stay the same, every number of a message lies at the same offset. So one message is
parsed for its layout, and all others of that layout are read and written as columns of a byte array (K, L).

CDR (OMG DDSI-RTPS 2.3, 10): 4 bytes of encapsulation (second byte 1: little endian), then the fields, each aligned to
its own size counted from the end of those 4 bytes; a string is a uint32 length, its bytes and a NUL; a sequence is a
uint32 length and its elements. JointState is a header (stamp int32 + uint32, frame_id), names and three sequences of
float64, each as long as the names or empty.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SCHEMA_NAME = "sensor_msgs/msg/JointState"
_SEPARATOR = "=" * 80
SCHEMA_TEXT = f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_SEPARATOR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_STAMP = 4
_AFTER_STAMP = 12
_NANO = 1_000_000_000


@dataclass(frozen=True, eq=False)
class JointStateLayout:
    """Where the numbers of a message lie, for given names and array lengths.

    template (L,) bytes of one such message; structure (L,) 255 where every message of this layout has the byte of the
    template, 0 where it has its own (numbers) or where the byte means nothing (padding); arrays: offset and length of
    position, velocity and effort; order: `<` or `>`.
    """

    names: tuple[str, ...]
    template: np.ndarray
    structure: np.ndarray
    arrays: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
    order: str

    @property
    def whole(self) -> bool:
        """Whether the message holds a position for every name, and velocity and effort for all or none."""
        n = len(self.names)
        (_, position), (_, velocity), (_, effort) = self.arrays
        return position == n and velocity in (0, n) and effort in (0, n)

    def matches(self, messages: np.ndarray) -> np.ndarray:
        """(K,) which of the messages (K, L) have this layout."""
        return ~np.any((messages ^ self.template) & self.structure, axis=1)

    def stamps(self, messages: np.ndarray) -> np.ndarray:
        """(K,) header stamps [ns] of messages (K, L)."""
        raw = np.ascontiguousarray(messages[:, _STAMP:_AFTER_STAMP])
        fields = raw.view(np.dtype([("sec", self.order + "i4"), ("nanosec", self.order + "u4")]))[:, 0]
        return fields["sec"].astype(np.int64) * _NANO + fields["nanosec"]

    def array(self, messages: np.ndarray, index: int) -> np.ndarray | None:
        """(K, n) positions (index 0), velocities (1) or efforts (2) of messages (K, L); None where they are empty."""
        offset, length = self.arrays[index]
        if length == 0:
            return None
        raw = np.ascontiguousarray(messages[:, offset : offset + 8 * length])
        return raw.view(self.order + "f8").astype(float, copy=False)

    def fill(self, messages: np.ndarray, stamps: np.ndarray, arrays: Sequence[np.ndarray | None]) -> None:
        """Write K messages into the bytes (K, L): stamps (K,) [ns] and the arrays (K, n) that the layout has."""
        messages[:] = self.template
        fields = np.empty(len(stamps), dtype=[("sec", self.order + "i4"), ("nanosec", self.order + "u4")])
        fields["sec"], fields["nanosec"] = np.divmod(stamps, _NANO)
        messages[:, _STAMP:_AFTER_STAMP] = fields.view(np.uint8).reshape(len(stamps), 8)
        for (offset, length), values in zip(self.arrays, arrays, strict=True):
            if length:
                numbers = np.ascontiguousarray(values, dtype=self.order + "f8")
                messages[:, offset : offset + 8 * length] = numbers.view(np.uint8)


def layout_for(
    names: Sequence[str], velocity: bool = True, effort: bool = True, position: bool = True
) -> JointStateLayout:
    """The layout of messages with these names, an empty frame_id, and position, velocity and effort or not."""
    data = bytearray(b"\x00\x01\x00\x00" + bytes(8))
    data += struct.pack("<I", 1) + b"\0"
    data += bytes(-len(data) % 4) + struct.pack("<I", len(names))
    for name in names:
        text = name.encode() + b"\0"
        data += bytes(-len(data) % 4) + struct.pack("<I", len(text)) + text
    for present in (position, velocity, effort):
        data += bytes(-len(data) % 4) + struct.pack("<I", len(names) if present else 0)
        if present:
            data += bytes((4 - len(data)) % 8) + bytes(8 * len(names))
    return parse_layout(bytes(data))


def parse_layout(message: bytes) -> JointStateLayout:
    """The layout of one message.

    Raises:
        ValueError: not a JointState in plain CDR.
    """
    if len(message) < _AFTER_STAMP or message[0] != 0 or message[1] > 1:
        raise ValueError("not plain CDR")
    cursor = _Cursor(message)
    cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.length()))
    position, velocity, effort = (cursor.numbers() for _ in range(3))
    return JointStateLayout(
        names=names,
        template=np.frombuffer(message, np.uint8),
        structure=np.frombuffer(bytes(cursor.structure), np.uint8),
        arrays=(position, velocity, effort),
        order=cursor.order,
    )


def from_ros1(message: bytes) -> bytes:
    """The CDR of a message in the serialisation of ROS 1: packed, little endian, with a sequence number in its header.

    Raises:
        ValueError: not a JointState.
    """
    at = 12

    def taken(size: int) -> bytes:
        nonlocal at
        part, at = message[at : at + size], at + size
        if len(part) < size:
            raise ValueError("the message ends within a field")
        return part

    def count() -> int:
        return int.from_bytes(taken(4), "little")

    taken(count())  # frame_id
    names = [taken(count()).decode() for _ in range(count())]
    arrays = [np.frombuffer(taken(8 * count()), "<f8") for _ in range(3)]
    data = bytearray(b"\x00\x01\x00\x00" + message[4:12] + struct.pack("<I", 1) + b"\0")
    data += bytes(-len(data) % 4) + struct.pack("<I", len(names))
    for text in (name.encode() + b"\0" for name in names):
        data += bytes(-len(data) % 4) + struct.pack("<I", len(text)) + text
    for values in arrays:
        data += bytes(-len(data) % 4) + struct.pack("<I", len(values))
        data += (bytes((4 - len(data)) % 8) if len(values) else b"") + values.tobytes()
    return bytes(data)


class _Cursor:
    """Walks over a message and marks the bytes that make up its structure."""

    def __init__(self, message: bytes):
        self.message = message
        self.order = "<" if message[1] else ">"
        self.structure = bytearray(len(message))
        self.structure[:2] = b"\xff\xff"
        self._at = _AFTER_STAMP

    def length(self) -> int:
        self._at += -self._at % 4
        raw = self._take(4, structure=True)
        return int.from_bytes(raw, "little" if self.order == "<" else "big")

    def text(self) -> str:
        return self._take(self.length(), structure=True).rstrip(b"\0").decode()

    def numbers(self) -> tuple[int, int]:
        length = self.length()
        if length:
            self._at += (4 - self._at) % 8
        offset = self._at
        self._take(8 * length, structure=False)
        return offset, length

    def _take(self, size: int, structure: bool) -> bytes:
        start, stop = self._at, self._at + size
        if stop > len(self.message):
            raise ValueError("the message ends within a field")
        if structure:
            self.structure[start:stop] = b"\xff" * size
        self._at = stop
        return self.message[start:stop]
