"""The register map of the Modbus link, as data; docs/modbus-registers.csv is the same table.

Holding registers, big-endian, read with function 3 and written with function 16. A block is read or written as a
whole; its last two registers are the CRC-32 (IEEE 802.3, as in zlib) of the bytes before them, so that neither a
damaged byte nor a half-finished update passes for a value.
"""

from __future__ import annotations

import csv
import io
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire.fields import FixedKind, Number, Padded, PaddedText as Text, Repeated

MAGIC = 0x43414C4B  # "CALK"
VERSION = 1
MAX_READ = 125  # registers in one read
MAX_WRITE = 123  # registers in one write
MAX_JOINTS = 12
NAMES_PER_BLOCK = 6
UPLOAD_BYTES = 216  # of a program in one write
UNIT = 1
RING = 4096  # first register
RING_REGISTERS = 61_440


class Flag(IntFlag):
    """Bits of `status.flags`."""

    DRIVES_ON = 1
    EMERGENCY_STOP = 2
    CELL_CLOSED = 4
    MOVING = 8
    EMULATOR = 16


class Command(IntEnum):
    """Values of `command.command`."""

    OPEN = 1  # take the controller; the watchdog asked for is in watchdog_ms
    RELEASE = 2  # give it back; an arm that moves is brought to rest
    UPLOAD_BEGIN = 3  # a program of `size` bytes with this SHA-256 is coming through the upload block
    UPLOAD_END = 4  # check, translate and store it
    START = 5  # run the program once
    STOP = 6  # bring the arm to rest on its path


class OutcomeCode(IntEnum):
    """Values of `answer.outcome`."""

    WORKING = 0
    DONE = 1
    REFUSED = 2


class MotionState(IntEnum):
    """Values of `progress.state`."""

    NONE = 0
    RUNNING = 1
    ENDED = 2


MODES = {"auto": 1, "teach": 2}

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
        stream = io.BytesIO(body)
        return {field.name: field.kind.unpack(stream) for field in self.fields}


IDENTITY = Block(
    "identity", 0, "read", "Who is there, and how the ring is laid out.",
    ("magic", U32, "0x43414C4B, \"CALK\""),
    ("version", U16, "1"),
    ("joints", U16, "n, 1 to 12"),
    ("period", U32, "of interpolation and sampling, ns"),
    ("slots", U16, "R, samples in the ring"),
    ("robot", Text(48), "type of the arm"),
    ("serial", Text(48), "of the arm"),
    ("controller", Text(48), "type of the controller"),
    ("software", Text(48), "version of the controller's software"),
)  # fmt: skip
NAMES = tuple(
    Block(
        f"joint names {first + 1} to {first + NAMES_PER_BLOCK}", 120 * (1 + first // NAMES_PER_BLOCK) + 8, "read",
        "In order; empty beyond n.",
        ("names", Repeated(Text(38), NAMES_PER_BLOCK), "one a joint"),
    )
    for first in range(0, MAX_JOINTS, NAMES_PER_BLOCK)
)  # fmt: skip
STATUS = Block(
    "status", 400, "read", "The state now.",
    ("flags", U16, "1 drives on, 2 emergency stop, 4 cell closed, 8 moving, 16 emulator"),
    ("mode", U16, "1 auto, 2 teach"),
    ("alarms", U16, "how many are active"),
    ("override", F32, "1 is 100 %"),
    ("position", Repeated(F64, MAX_JOINTS), "measured, joint side, rad (m)"),
    ("program", Text(32), "stored last; empty: none"),
    ("checksum", Padded(32), "SHA-256 of its text as stored"),
)  # fmt: skip
ALARMS = Block(
    "alarms", 500, "read", "The active alarms.",
    ("text", Text(240), "one a line"),
)  # fmt: skip
ANSWER = Block(
    "answer", 640, "read", "What became of the last command.",
    ("session", U32, "whose command"),
    ("request", U16, "which command"),
    ("outcome", U16, "0 working, 1 done, 2 refused"),
    ("refusal", U16, "why it was refused"),
    ("line", U32, "of the program; 0: none"),
    ("column", U32, "of the program; 0: none"),
    ("message", Text(140), "for people"),
    ("checksum", Padded(32), "upload end: SHA-256 of the text as stored"),
    ("watchdog", U32, "open: the one in force, ms"),
)  # fmt: skip
PROGRESS = Block(
    "progress", 760, "read", "The controller's heartbeat and the motion; to be read all the time.",
    ("heartbeat", U16, "goes on counting four times a watchdog or oftener"),
    ("session", U32, "who holds the controller; 0: nobody"),
    ("state", U16, "0 no motion yet, 1 running, 2 ended"),
    ("motion", Padded(16), "id of the motion"),
    ("samples", U32, "recorded so far"),
    ("oldest", U32, "sequence number of the first that is still kept"),
    ("reason", U16, "why it ended"),
)  # fmt: skip
END = Block(
    "end", 800, "read", "The last motion's end.",
    ("message", Text(200), "for people"),
)  # fmt: skip
FRAMES = Block(
    "frames", 920, "read",
    "The frames in force, each as the six numbers of a POS: x, y, z [mm], Euler angles a, e, r [deg] about the moving "
    "axes z, y, z. A controller of an older map has no such registers (exception 2).",
    ("base", Repeated(F64, 6), "$BASE"),
    ("tool", Repeated(F64, 6), "$TOOL"),
    ("uframe", Repeated(F64, 6), "$UFRAME"),
)  # fmt: skip
COMMAND = Block(
    "command", 1000, "write", "One command; taken once per session and request.",
    ("session", U32, "a number the client has drawn, not 0"),
    ("request", U16, "counts commands; a number that is not above the last is not taken again"),
    ("command", U16, "1 open, 2 release, 3 upload begin, 4 upload end, 5 start, 6 stop"),
    ("watchdog", U32, "open: the one asked for, ms"),
    ("name", Text(32), "of the program"),
    ("size", U32, "upload begin: bytes"),
    ("checksum", Padded(32), "upload begin, start: SHA-256 of the text"),
    ("motion", Padded(16), "start: id of the motion, good for one start ever"),
)  # fmt: skip
UPLOAD = Block(
    "upload", 1100, "write", "The bytes of a program from an offset on, in order.",
    ("session", U32, ""),
    ("offset", U32, "bytes"),
    ("count", U16, "bytes, 1 to 216"),
    ("data", Padded(UPLOAD_BYTES), "what is beyond `count` does not matter"),
)  # fmt: skip
HEARTBEAT = Block(
    "heartbeat", 1240, "write", "The client is there; to be written four times a watchdog.",
    ("session", U32, ""),
    ("count", U16, "goes up by one"),
    ("taken", U32, "the ring shows samples from this sequence number on"),
)  # fmt: skip

BLOCKS = (IDENTITY, *NAMES, STATUS, ALARMS, ANSWER, PROGRESS, END, FRAMES, COMMAND, UPLOAD, HEARTBEAT)


def slot_registers(joints: int) -> int:
    """Registers of one sample in the ring."""
    return 8 + 10 * joints


def slot_count(joints: int) -> int:
    """R, samples in the ring."""
    return RING_REGISTERS // slot_registers(joints)


def _slot_type(joints: int) -> np.dtype:
    return np.dtype([("sequence", ">u4"), ("time", ">i8"), ("values", ">f4", (5, joints)), ("checksum", ">u4")])


@dataclass(frozen=True, eq=False)
class Slots:
    """Samples out of the ring: sequence (K,), time_ns (K,), values (5, K, n) in the order of `SampleBlock`."""

    sequence: np.ndarray
    time_ns: np.ndarray
    values: np.ndarray


def pack_slots(first: int, time_ns: np.ndarray, columns: Sequence[np.ndarray]) -> np.ndarray:
    """Registers (K, slot registers) uint16 of samples from sequence number `first` on; `columns` are five (K, n)."""
    count, joints = columns[0].shape
    slots = np.zeros(count, _slot_type(joints))
    slots["sequence"] = np.arange(first, first + count)
    slots["time"] = time_ns
    slots["values"] = np.stack(columns, axis=1)
    rows = slots.view(np.uint8).reshape(count, -1)
    slots["checksum"] = [zlib.crc32(row[:-4].data) for row in rows]
    return rows.view(">u2").astype(np.uint16)


def unpack_slots(registers: np.ndarray, joints: int, first: int) -> Slots:
    """The whole, undamaged samples from sequence number `first` on in registers (K, slot registers); it stops at the
    first that is none: not written yet, overwritten, or torn."""
    data = registers.astype(">u2").tobytes()
    slots = np.frombuffer(data, _slot_type(joints))
    size = slots.dtype.itemsize
    good = 0
    while good < len(slots) and slots["sequence"][good] == first + good:
        if zlib.crc32(data[good * size : (good + 1) * size - 4]) != slots["checksum"][good]:
            break
        good += 1
    slots = slots[:good]
    values = np.moveaxis(slots["values"].astype(float), 1, 0)
    return Slots(np.arange(first, first + good), slots["time"].astype(np.int64), values)


def map_as_csv() -> str:
    """The register map, as in docs/modbus-registers.csv."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("block", "access", "register", "field", "type", "meaning"))
    for block in BLOCKS:
        rows.writerow((block.name, block.access, f"{block.address} to {block.end - 1}", "", "", block.meaning))
        at = block.address
        for field in block.fields:
            rows.writerow((block.name, block.access, at, field.name, field.kind.name, field.meaning))
            at += field.kind.size // 2
        rows.writerow((block.name, block.access, at, "checksum of the block", "u32", "CRC-32"))
    return text.getvalue()


if __name__ == "__main__":
    print(map_as_csv(), end="")
