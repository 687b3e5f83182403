"""Blocks of registers as data: fields with their kinds, packed with a checksum."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from drivers.errors import ProtocolError


class RegisterKind(Protocol):
    """How one field is packed; `size` in bytes, a multiple of two."""

    name: str
    size: int

    def pack(self, value: Any) -> bytes: ...

    def unpack(self, data: bytes) -> Any: ...


class NumberField:
    """A number in `struct` notation."""

    def __init__(self, name: str, code: str) -> None:
        self.name = name
        self._struct = struct.Struct(">" + code)
        self.size = self._struct.size

    def pack(self, value: Any) -> bytes:
        return self._struct.pack(value)

    def unpack(self, data: bytes) -> Any:
        return self._struct.unpack(data)[0]


class Text:
    """UTF-8, filled up with zeros; cut at a character where it is too long."""

    def __init__(self, size: int) -> None:
        self.name = f"text of {size} bytes"
        self.size = size

    def pack(self, value: str) -> bytes:
        data = value.encode("utf-8")[: self.size].decode("utf-8", "ignore").encode("utf-8")
        return data.ljust(self.size, b"\0")

    def unpack(self, data: bytes) -> str:
        try:
            return data.rstrip(b"\0").decode("utf-8")
        except UnicodeDecodeError as error:
            raise ProtocolError(f"a text is not UTF-8: {error.reason}") from None


class Raw:
    """Bytes as they are."""

    def __init__(self, size: int) -> None:
        self.name = f"{size} bytes"
        self.size = size

    def pack(self, value: bytes) -> bytes:
        if len(value) > self.size:
            raise ValueError(f"at most {self.size} bytes are expected, not {len(value)}")
        return value.ljust(self.size, b"\0")

    def unpack(self, data: bytes) -> bytes:
        return data


class ManyFields:
    """So many of one kind; a tuple in Python, filled up with its zero."""

    def __init__(self, kind: RegisterKind, count: int) -> None:
        self.name = f"{count} × {kind.name}"
        self.size = count * kind.size
        self._kind = kind

    def pack(self, value: Sequence[Any]) -> bytes:
        data = b"".join(self._kind.pack(item) for item in value)
        if len(data) > self.size:
            raise ValueError(f"{len(value)} items, where {self.size // self._kind.size} fit")
        return data.ljust(self.size, b"\0")

    def unpack(self, data: bytes) -> tuple[Any, ...]:
        step = self._kind.size
        return tuple(self._kind.unpack(data[at : at + step]) for at in range(0, self.size, step))


U16, U32, F32, F64 = NumberField("u16", "H"), NumberField("u32", "I"), NumberField("f32", "f"), NumberField("f64", "d")


@dataclass(frozen=True)
class Field:
    """One value of a block."""

    name: str
    kind: RegisterKind
    meaning: str


class Block:
    """Fields at consecutive registers from `address` on, and their CRC-32."""

    def __init__(
        self, name: str, address: int, access: str, meaning: str, *rows: tuple[str, RegisterKind, str]
    ) -> None:
        self.name = name
        self.address = address
        self.access = access
        self.meaning = meaning
        self.fields = tuple(Field(*row) for row in rows)
        self.registers = sum(field.kind.size for field in self.fields) // 2 + 2

    @property
    def end(self) -> int:
        """The first register after it."""
        return self.address + self.registers

    def pack(self, **values: Any) -> list[int]:
        """The registers of these values; every field is named."""
        body = b"".join(field.kind.pack(values.pop(field.name)) for field in self.fields)
        if values:
            raise TypeError(f"block {self.name} has no field {', '.join(values)}")
        return list(struct.unpack(f">{self.registers}H", body + struct.pack(">I", zlib.crc32(body))))

    def unpack(self, registers: Sequence[int]) -> dict[str, Any]:
        """The values in registers.

        Raises:
            ProtocolError: their checksum is wrong, or a text is none.
        """
        data = struct.pack(f">{len(registers)}H", *registers)
        body, checksum = data[:-4], data[-4:]
        if len(registers) != self.registers or struct.pack(">I", zlib.crc32(body)) != checksum:
            raise ProtocolError(f"the {self.name} registers are damaged: their checksum is wrong")
        values, at = {}, 0
        for field in self.fields:
            values[field.name] = field.kind.unpack(body[at : at + field.kind.size])
            at += field.kind.size
        return values
