"""The one error of PDL2 text."""

from __future__ import annotations

from typing import NamedTuple

from agent.core import InputError


class TextPosition(NamedTuple):
    """Where a word of a program stands: line and column count from 1."""

    line: int
    column: int
    word: str


class Pdl2Error(InputError):
    """A program that cannot be read or run: `line`, `column` (from 1) and `word` say where, `reason` says why."""

    def __init__(self, reason: str, place: TextPosition, path: str = ""):
        self.reason = reason
        self.place = place
        self.path = path
        self.line, self.column, self.word = place
        where = f"{path or 'program'}:{place.line}:{place.column}"
        super().__init__(f"{where}: {shortened(place.word)}: {reason}" if place.word else f"{where}: {reason}")

    def within(self, path: str) -> Pdl2Error:
        """The same error, naming the file."""
        return type(self)(self.reason, self.place, path)


def shortened(word: str) -> str:
    """A word quoted for a message, cut where it is long."""
    return repr(word if len(word) <= 40 else word[:37] + "...")
