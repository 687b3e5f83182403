"""The kinds of field that a message is made of. Little-endian, packed without padding."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Annotated, Any, Protocol, TypeVar, dataclass_transform, get_type_hints

from drivers.errors import ProtocolError

MAX_TEXT = 4096


class Cursor:
    """Reads a payload front to back; never beyond its end."""

    def __init__(self, payload: bytes) -> None:
        self._payload = payload
        self._position = 0

    def take(self, count: int) -> bytes:
        """The next `count` bytes.

        Raises:
            ProtocolError: the payload is shorter.
        """
        end = self._position + count
        if end > len(self._payload):
            raise ProtocolError(f"a message ends after {len(self._payload)} bytes where at least {end} are needed")
        piece = self._payload[self._position : end]
        self._position = end
        return piece

    def finish(self) -> None:
        """Raises:
        ProtocolError: something is left over.
        """
        left = len(self._payload) - self._position
        if left:
            raise ProtocolError(f"a message has {left} bytes more than its fields")


class FieldKind(Protocol):
    """How one field is packed."""

    def pack(self, value: Any) -> bytes: ...

    def unpack(self, cursor: Cursor) -> Any: ...


class Number:
    """A fixed-size number in `struct` notation."""

    def __init__(self, code: str) -> None:
        self._struct = struct.Struct("<" + code)

    def pack(self, value: Any) -> bytes:
        return self._struct.pack(value)

    def unpack(self, cursor: Cursor) -> Any:
        return self._struct.unpack(cursor.take(self._struct.size))[0]


class Boolean:
    """One byte, 0 or 1."""

    def pack(self, value: bool) -> bytes:
        return b"\x01" if value else b"\x00"

    def unpack(self, cursor: Cursor) -> bool:
        byte = cursor.take(1)[0]
        if byte > 1:
            raise ProtocolError(f"a truth value is {byte}, neither 0 nor 1")
        return bool(byte)


class Utf8:
    """Length (2 bytes), then UTF-8. Longer text is cut at a character when it is packed."""

    def pack(self, value: str) -> bytes:
        data = value.encode("utf-8")[:MAX_TEXT]
        data = data.decode("utf-8", "ignore").encode("utf-8")
        return struct.pack("<H", len(data)) + data

    def unpack(self, cursor: Cursor) -> str:
        (size,) = struct.unpack("<H", cursor.take(2))
        if size > MAX_TEXT:
            raise ProtocolError(f"a text of {size} bytes; at most {MAX_TEXT} are allowed")
        try:
            return cursor.take(size).decode("utf-8")
        except UnicodeDecodeError as error:
            raise ProtocolError(f"a text is not UTF-8: {error.reason}") from None


class Blob:
    """Length (4 bytes), then bytes."""

    def pack(self, value: bytes) -> bytes:
        return struct.pack("<I", len(value)) + value

    def unpack(self, cursor: Cursor) -> bytes:
        (size,) = struct.unpack("<I", cursor.take(4))
        return cursor.take(size)


class Fixed:
    """Exactly `size` bytes."""

    def __init__(self, size: int) -> None:
        self._size = size

    def pack(self, value: bytes) -> bytes:
        if len(value) != self._size:
            raise ValueError(f"{self._size} bytes are expected, not {len(value)}")
        return value

    def unpack(self, cursor: Cursor) -> bytes:
        return cursor.take(self._size)


class Many:
    """Count (1 byte), then so many of another kind; a tuple in Python."""

    def __init__(self, kind: FieldKind) -> None:
        self._kind = kind

    def pack(self, value: tuple[Any, ...]) -> bytes:
        return struct.pack("<B", len(value)) + b"".join(self._kind.pack(item) for item in value)

    def unpack(self, cursor: Cursor) -> tuple[Any, ...]:
        (count,) = cursor.take(1)
        return tuple(self._kind.unpack(cursor) for _ in range(count))


U16 = Annotated[int, Number("H")]
U32 = Annotated[int, Number("I")]
U64 = Annotated[int, Number("Q")]
F64 = Annotated[float, Number("d")]
Flag = Annotated[bool, Boolean()]
Text = Annotated[str, Utf8()]
Texts = Annotated[tuple[str, ...], Many(Utf8())]
Floats = Annotated[tuple[float, ...], Many(Number("d"))]
Bytes = Annotated[bytes, Blob()]
Bytes16 = Annotated[bytes, Fixed(16)]


_Message = TypeVar("_Message")
MESSAGES: dict[int, Any] = {}  # by type number


@dataclass_transform(frozen_default=True)
def message(number: int) -> Callable[[type[_Message]], type[_Message]]:
    """Class decorator: a frozen dataclass whose annotated fields are the message's layout, under this type number."""

    def decorate(cls: type[_Message]) -> type[_Message]:
        cls = dataclass(frozen=True)(cls)
        hints = get_type_hints(cls, include_extras=True)
        cls.TYPE = number  # type: ignore[attr-defined]
        cls.LAYOUT = tuple((item.name, hints[item.name].__metadata__[0]) for item in fields(cls))  # type: ignore
        MESSAGES[number] = cls
        return cls

    return decorate


class MessageFields:
    """Packs a message field by field."""

    TYPE: int
    LAYOUT: tuple[tuple[str, FieldKind], ...]

    def pack(self) -> bytes:
        return b"".join(kind.pack(getattr(self, name)) for name, kind in self.LAYOUT)

    @classmethod
    def unpack(cls, payload: bytes) -> Any:
        cursor = Cursor(payload)
        values = {name: kind.unpack(cursor) for name, kind in cls.LAYOUT}
        cursor.finish()
        return cls(**values)
