"""The kinds of field that a message or a block of registers is made of.

Messages are little-endian, registers big-endian; neither has padding between fields.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from io import BytesIO
from typing import Any, Protocol

from drivers.errors import ProtocolError

MAX_TEXT = 4096


def take(payload: BytesIO, count: int) -> bytes:
    """The next `count` bytes.

    Raises:
        ProtocolError: the payload is shorter.
    """
    piece = payload.read(count)
    if len(piece) < count:
        end = payload.tell()
        raise ProtocolError(f"a message ends after {end} bytes where at least {end - len(piece) + count} are needed")
    return piece


class FieldKind(Protocol):
    """Packing of one field."""

    def pack(self, value: Any) -> bytes: ...

    def unpack(self, payload: BytesIO) -> Any: ...


class Number:
    """A fixed-size number in `struct` notation, byte order included."""

    def __init__(self, code: str, name: str = "") -> None:
        self.name = name
        self._struct = struct.Struct(code)
        self.size = self._struct.size

    def pack(self, value: Any) -> bytes:
        return self._struct.pack(value)

    def unpack(self, payload: BytesIO) -> Any:
        return self._struct.unpack(take(payload, self.size))[0]


class Boolean:
    """One byte, 0 or 1."""

    def pack(self, value: bool) -> bytes:
        return b"\x01" if value else b"\x00"

    def unpack(self, payload: BytesIO) -> bool:
        byte = take(payload, 1)[0]
        if byte > 1:
            raise ProtocolError(f"a truth value is {byte}, neither 0 nor 1")
        return bool(byte)


class Utf8:
    """Length (2 bytes), then UTF-8. Longer text is cut at a character when it is packed."""

    def pack(self, value: str) -> bytes:
        data = _cut(value, MAX_TEXT)
        return struct.pack("<H", len(data)) + data

    def unpack(self, payload: BytesIO) -> str:
        (size,) = struct.unpack("<H", take(payload, 2))
        if size > MAX_TEXT:
            raise ProtocolError(f"a text of {size} bytes; at most {MAX_TEXT} are allowed")
        return _decoded(take(payload, size))


class Blob:
    """Length (4 bytes), then bytes."""

    def pack(self, value: bytes) -> bytes:
        return struct.pack("<I", len(value)) + value

    def unpack(self, payload: BytesIO) -> bytes:
        (size,) = struct.unpack("<I", take(payload, 4))
        return take(payload, size)


class Padded:
    """`size` bytes; fewer are filled up with zeros, which stay."""

    def __init__(self, size: int) -> None:
        self.name = f"{size} bytes"
        self.size = size

    def pack(self, value: bytes) -> bytes:
        if len(value) > self.size:
            raise ValueError(f"at most {self.size} bytes are expected, not {len(value)}")
        return value.ljust(self.size, b"\0")

    def unpack(self, payload: BytesIO) -> bytes:
        return take(payload, self.size)


class PaddedText:
    """UTF-8 in `size` bytes, filled up with zeros; cut at a character where it is too long."""

    def __init__(self, size: int) -> None:
        self.name = f"text of {size} bytes"
        self.size = size

    def pack(self, value: str) -> bytes:
        return _cut(value, self.size).ljust(self.size, b"\0")

    def unpack(self, payload: BytesIO) -> str:
        return _decoded(take(payload, self.size).rstrip(b"\0"))


class Many:
    """Count (1 byte), then that number of values of another kind; a tuple in Python."""

    def __init__(self, kind: FieldKind) -> None:
        self._kind = kind

    def pack(self, value: tuple[Any, ...]) -> bytes:
        return struct.pack("<B", len(value)) + b"".join(self._kind.pack(item) for item in value)

    def unpack(self, payload: BytesIO) -> tuple[Any, ...]:
        (count,) = take(payload, 1)
        return tuple(self._kind.unpack(payload) for _ in range(count))


class FixedKind(FieldKind, Protocol):
    """A kind that always has the same `size` [bytes]; `name` is for people."""

    name: str
    size: int


class Repeated:
    """`count` of one kind; a tuple in Python, filled up with zeros."""

    def __init__(self, kind: FixedKind, count: int) -> None:
        self.name = f"{count} × {kind.name}"
        self.size = count * kind.size
        self._kind = kind
        self._count = count

    def pack(self, value: Sequence[Any]) -> bytes:
        if len(value) > self._count:
            raise ValueError(f"{len(value)} items, where {self._count} fit")
        return b"".join(map(self._kind.pack, value)).ljust(self.size, b"\0")

    def unpack(self, payload: BytesIO) -> tuple[Any, ...]:
        return tuple(self._kind.unpack(payload) for _ in range(self._count))


def _cut(text: str, size: int) -> bytes:
    return text.encode("utf-8")[:size].decode("utf-8", "ignore").encode("utf-8")


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ProtocolError(f"a text is not UTF-8: {error.reason}") from None
