"""The controller's program memory: takes programs in, translates and stores them by name, up to its size."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, replace

from agent.motion.pdl2 import Pdl2Error, Program, parse_program
from agent.robot import RobotDescription
from drivers.wire.reasons import Refusal

MAX_PROGRAM = 1024 * 1024  # bytes of one program
MEMORY = 4 * 1024 * 1024  # bytes of all programs
MAX_PROGRAMS = 64

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,31}")


class RefusedRequest(Exception):
    """A request that the controller does not carry out; line and column belong to program text, 0 for none."""

    def __init__(self, reason: Refusal, message: str, line: int = 0, column: int = 0) -> None:
        super().__init__(message)
        self.reason = reason
        self.line = line
        self.column = column


class Upload:
    """A program on its way in; `checksum` is the SHA-256 (hex) that was announced."""

    def __init__(self, name: str, size: int, checksum: str) -> None:
        self.name, self._size, self._checksum = name, size, checksum.lower()
        self._data = bytearray()

    def add(self, offset: int, data: bytes) -> None:
        """Take the next block.

        Raises:
            RefusedRequest: it is not the next, or too much.
        """
        if offset != len(self._data):
            raise RefusedRequest(Refusal.BAD_REQUEST, f"a block for byte {offset}, where {len(self._data)} comes next")
        if offset + len(data) > self._size:
            raise RefusedRequest(Refusal.TOO_LARGE, f"more than the {self._size} bytes that were announced")
        self._data += data

    def complete(self) -> bytes:
        """All of it.

        Raises:
            RefusedRequest: something is missing or damaged.
        """
        if len(self._data) != self._size:
            raise RefusedRequest(Refusal.BAD_REQUEST, f"{len(self._data)} of {self._size} bytes came")
        if hashlib.sha256(self._data).hexdigest() != self._checksum:
            raise RefusedRequest(Refusal.CHECKSUM, "the bytes that came are not those of the checksum; send them again")
        return bytes(self._data)


@dataclass(frozen=True, eq=False)
class StoredProgram:
    """A translated program under the name it was stored by, its text and the SHA-256 (hex) of that."""

    name: str
    program: Program
    text: bytes
    checksum: str


class ProgramMemory:
    """Programs by name, case-insensitive. Not thread-safe: the controller locks.

    `full`, `alter_next` and `refused_line` are faults: the memory is full, the stored text differs from the uploaded
    one, and the translator refuses a line (from 1; 0 for none).
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot, self._last = robot, ""
        self._programs: dict[str, StoredProgram] = {}
        self.full = self.alter_next = False
        self.refused_line = 0

    @property
    def last(self) -> StoredProgram | None:
        """The program that was stored last, if it still exists."""
        return self.find(self._last)

    def find(self, name: str) -> StoredProgram | None:
        """The program of this name."""
        return self._programs.get(name.lower())

    def check_room(self, name: str, size: int) -> None:
        """Raises:
        RefusedRequest: there is no space for that number of bytes under this name.
        """
        others = [len(stored.text) for key, stored in self._programs.items() if key != name.lower()]
        if self.full or len(others) >= MAX_PROGRAMS or sum(others) + size > MEMORY:
            raise RefusedRequest(Refusal.MEMORY_FULL, "the program memory is full; delete programs")

    def translate(self, name: str, data: bytes) -> Program:
        """The program that a text is.

        Raises:
            RefusedRequest: none, with line and column.
        """
        if self.refused_line:
            lines = data.decode("utf-8", "replace").splitlines()
            word = (lines[min(self.refused_line, len(lines)) - 1].split() or [""])[0] if lines else ""
            message = f"{word}: this translator does not know it here"
            raise RefusedRequest(Refusal.SYNTAX, message, self.refused_line, 1)
        try:
            return parse_program(data.decode("utf-8"), name, self._robot)
        except UnicodeDecodeError:
            raise RefusedRequest(Refusal.SYNTAX, f"program {name} is not UTF-8 text") from None
        except Pdl2Error as error:
            message = f"{error.word}: {error.reason}" if error.word else error.reason
            raise RefusedRequest(Refusal.SYNTAX, message, error.line, error.column) from None

    def keep(self, name: str, program: Program, data: bytes) -> StoredProgram:
        """Store a translated program; it replaces the one with its name."""
        if self.alter_next:
            data, self.alter_next = data + b" ", False
        stored = StoredProgram(name, program, data, hashlib.sha256(data).hexdigest())
        self._programs[name.lower()] = stored
        self._last = name
        return stored

    def alter(self) -> None:
        """A fault: every stored text is another one from now on, as its checksum tells."""
        for key, stored in self._programs.items():
            other = hashlib.sha256(stored.checksum.encode()).hexdigest()
            self._programs[key] = replace(stored, checksum=other)

    def clear(self) -> None:
        """Forget everything."""
        self._programs.clear()


def check_program(name: str, size: int) -> None:
    """Raises:
    RefusedRequest: no controller stores a program of this name or size.
    """
    if not _NAME.fullmatch(name):
        raise RefusedRequest(
            Refusal.BAD_REQUEST,
            f"{name!r} cannot name a program: 1 to 32 letters, digits or _, the first no digit",
        )
    if size > MAX_PROGRAM:
        raise RefusedRequest(Refusal.TOO_LARGE, f"{size} bytes; a program may have {MAX_PROGRAM}")
