"""Blocks of registers as data: fields with their kinds, sizes in whole registers, packed with a checksum."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

from drivers.errors import ProtocolError
from drivers.wire.fields import FixedKind, Number

U16, U32, F32, F64 = Number(">H", "u16"), Number(">I", "u32"), Number(">f", "f32"), Number(">d", "f64")


@dataclass(frozen=True)
class Field:
    """One value of a block."""

    name: str
    kind: FixedKind
    meaning: str


class Block:
    """Fields at consecutive registers from `address` on, and their CRC-32."""

    def __init__(self, name: str, address: int, access: str, meaning: str, *rows: tuple[str, FixedKind, str]) -> None:
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
        left = BytesIO(body)
        return {field.name: field.kind.unpack(left) for field in self.fields}
