"""Messages of the primary interface: what the controller says of the program that a client sent.

Big-endian. A package is int32 length, header included, uint8 type. Of type 20 are messages: uint64 timestamp, int8
source, uint8 kind, then what the kind has. Of type 16 are states: sub-packages of int32 length and uint8 type.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.errors import ProtocolError
from drivers.texts import ALARM, printable

#: Size and type of a package, its first bytes; the largest size.
HEAD, LONGEST = struct.Struct(">iB"), 1 << 20
_BEFORE = struct.Struct(">QbB")
_STATE, _MESSAGE, _ROBOT_MODE = 16, 20, 0
_ERROR, _KEY, _EXCEPTION = 6, 7, 10
#: Levels of an error: 3 is a violation, 4 a fault, 5 critical.
_VIOLATION, _LEVELS = 3, 128


@dataclass(frozen=True)
class ProgramChange:
    """The controller says that a program of this name has started, or has stopped."""

    name: str
    started: bool


@dataclass(frozen=True)
class ProgramFault:
    """A runtime exception or an error of the controller; `line` and `column` from 1, 0 where it has none.

    `fatal`: the program cannot go on.
    """

    message: str
    line: int = 0
    column: int = 0
    fatal: bool = True

    def __str__(self) -> str:
        position = f"line {self.line} column {self.column}: " if self.line else ""
        return f"{position}{printable(self.message, ALARM)}"


@dataclass(frozen=True)
class Presence:
    """`real` is False where a simulator of the controller answers."""

    real: bool


def meaning(kind: int, content: bytes) -> Iterator[ProgramChange | ProgramFault | Presence]:
    """What a package says.

    Raises:
        ProtocolError: it is shorter than its kind.
    """
    try:
        if kind == _STATE:
            yield from _state(content)
        elif kind == _MESSAGE:
            yield from _message(_BEFORE.unpack_from(content)[2], content[_BEFORE.size :])
    except struct.error:
        raise ProtocolError("a message of the primary interface is shorter than its kind") from None


def _state(content: bytes) -> Iterator[Presence]:
    at = 0
    while at < len(content):
        size, kind = HEAD.unpack_from(content, at)
        if size < HEAD.size:
            raise ProtocolError("a state of the primary interface is damaged")
        if kind == _ROBOT_MODE:
            yield Presence(bool(struct.unpack_from(">Q?", content, at + HEAD.size)[1]))
        at += size


def _message(kind: int, content: bytes) -> Iterator[ProgramChange | ProgramFault]:
    if kind == _KEY:
        _, _, length = struct.unpack_from(">iiB", content)
        title, text = _text(content[9 : 9 + length]), _text(content[9 + length :])
        if change := re.fullmatch("PROGRAM_XXX_(STARTED|STOPPED)", title):
            yield ProgramChange(text, change[1] == "STARTED")
    elif kind == _EXCEPTION:
        line, column = struct.unpack_from(">II", content)
        yield ProgramFault(_text(content[8:]), line, column)
    elif kind == _ERROR:
        code, argument, level = struct.unpack_from(">iii", content)
        text = f"C{code}A{argument} {_text(content[20:])}".strip()
        yield ProgramFault(text, fatal=level % _LEVELS >= _VIOLATION)


def _text(raw: bytes) -> str:
    return raw.decode("latin-1").strip("\0")
