"""`sensor_msgs/msg/JointState`, many messages at a time.

As long as names and array lengths stay the same, every number of a message lies at the same offset. One message is
parsed for its layout; all others of that layout are read and written as columns of a byte array (K, L).

CDR (OMG DDSI-RTPS 2.3, 10) begins with 4 bytes of encapsulation (second byte 1: little endian). Each field is aligned
to its own size, counted from the end of those bytes. A string is a uint32 length, its bytes and a NUL; a sequence is a
uint32 length and its elements. JointState is a header (stamp int32 + uint32, frame_id), names, and three sequences of
float64, each as long as the names or empty. ROS 1 has a sequence number instead of the encapsulation, packs the
same fields without alignment, little endian, and ends no string with a NUL.
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
_STAMP = slice(4, 12)
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
        fields = np.ascontiguousarray(messages[:, _STAMP]).view(self._stamp_type)[:, 0]
        return fields["sec"].astype(np.int64) * _NANO + fields["nanosec"]

    def array(self, messages: np.ndarray, index: int) -> np.ndarray | None:
        """(K, n) positions (index 0), velocities (1) or efforts (2) of messages (K, L); None where they are empty."""
        offset, length = self.arrays[index]
        if length == 0:
            return None
        raw = np.ascontiguousarray(messages[:, offset : offset + 8 * length])
        return raw.view(self.order + "f8").astype(float, copy=False)

    def filled(self, stamps: np.ndarray, arrays: Sequence[np.ndarray | None]) -> np.ndarray:
        """(K, L) bytes of messages with stamps (K,) [ns] and the arrays (K, n) that the layout has."""
        messages = np.tile(self.template, (len(stamps), 1))
        fields = np.empty(len(stamps), self._stamp_type)
        fields["sec"], fields["nanosec"] = np.divmod(stamps, _NANO)
        messages[:, _STAMP] = fields.view(np.uint8).reshape(len(stamps), 8)
        for (offset, length), values in zip(self.arrays, arrays, strict=True):
            if length:
                numbers = np.ascontiguousarray(values, dtype=self.order + "f8")
                messages[:, offset : offset + 8 * length] = numbers.view(np.uint8)
        return messages

    @property
    def _stamp_type(self) -> np.dtype:
        return np.dtype([("sec", self.order + "i4"), ("nanosec", self.order + "u4")])


def layout_for(
    names: Sequence[str], velocity: bool = True, effort: bool = True, position: bool = True
) -> JointStateLayout:
    """The CDR layout of messages with these names, an empty frame_id, and position, velocity and effort or not."""
    data = bytearray(b"\x00\x01\x00\x00" + bytes(8) + struct.pack("<I", 1) + b"\0")

    def add_length(length: int) -> None:
        data.extend(bytes(-len(data) % 4) + struct.pack("<I", length))

    add_length(len(names))
    for text in (name.encode() + b"\0" for name in names):
        add_length(len(text))
        data.extend(text)
    for present in (position, velocity, effort):
        add_length(len(names) if present else 0)
        if present:
            data.extend(bytes((4 - len(data)) % 8) + bytes(8 * len(names)))
    return parse_layout(bytes(data))


def parse_layout(message: bytes, ros1: bool = False) -> JointStateLayout:
    """The layout of one message, in CDR or in the serialisation of ROS 1.

    Raises:
        ValueError: not a JointState in this serialisation.
    """
    if len(message) < _STAMP.stop or not (ros1 or (message[0] == 0 and message[1] <= 1)):
        raise ValueError("not plain CDR")
    order = "<" if ros1 or message[1] else ">"
    structure = np.zeros(len(message), np.uint8)
    structure[:2] = 0 if ros1 else 255
    at = _STAMP.stop

    def take(size: int) -> slice:
        nonlocal at
        part = slice(at, at + size)
        if part.stop > len(message):
            raise ValueError("the message ends within a field")
        at = part.stop
        return part

    def align(size: int) -> None:
        nonlocal at
        at += 0 if ros1 else (4 - at) % size

    def length() -> int:
        align(4)
        part = take(4)
        structure[part] = 255
        return int.from_bytes(message[part], "little" if order == "<" else "big")

    def text() -> str:
        part = take(length())
        structure[part] = 255
        return message[part].rstrip(b"\0").decode()

    def numbers() -> tuple[int, int]:
        count = length()
        if count:
            align(8)
        return take(8 * count).start, count

    text()
    names = tuple(text() for _ in range(length()))
    arrays = (numbers(), numbers(), numbers())
    return JointStateLayout(names, np.frombuffer(message, np.uint8), structure, arrays, order)
