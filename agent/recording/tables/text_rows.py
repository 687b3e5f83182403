"""A line of text to its fields, and a field to its value: a number, a date or time of day, or a vector."""

from __future__ import annotations

import contextlib
import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from agent.core import InputError

_HIDDEN = re.compile(r'"[^"]*"|\[[^\[\]]*\]|\([^()]*\)')
_VECTOR = re.compile(r"(?:[a-z_.]+\()?(?:'\w',)?\s*\[([^\[\]]*)\][^\[\]]*|[({]([^\[\]]*)[)}]")
_BETWEEN = re.compile(r"[\s,;|]+")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+\.\d*")
_NUMBER, _PLAIN = re.compile(r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eEdD][-+]?\d+)?"), str.maketrans(",dD", ".ee")
_DATE = re.compile(r"\d{4}-?\d\d-?\d\d[T ]\d\d:?\d\d")
_CLOCK = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)")
_KIND = {"[": "[", "]": "[", "(": "(", ")": "("}
#: Characters of the longest number: more digits are no measurement, and take long to read.
_LONGEST = 400
#: Fields of the widest row, the columns of a sheet of Excel.
_WIDEST = 2**14
#: Numbers that one table may hold: an hour of 37 columns at 500 Hz, 512 MiB in memory.
MOST_VALUES = 2**26
#: Cells of text, 16 columns of as many rows as Excel allows, and bytes of one.
MOST_CELLS, CELL = 2**24, 64
#: What programs write for a number that is missing.
_MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "inf", "-inf"}
#: A number, the numbers of a vector, NaN for a word, None for what is missing.
Cell = float | list[float] | None


class Row:
    """Fields of a line. A comment has no data, but it may hold the names of the columns."""

    def __init__(self, fields: list[str], comment: bool = False):
        self.fields = fields
        self.comment = comment

    @cached_property
    def cells(self) -> list[Cell]:
        """The values of the fields."""
        return [_cell(field) for field in self.fields]

    @property
    def width(self) -> int:
        """Number of data fields."""
        return 0 if self.comment else len(self.fields)

    @cached_property
    def is_data(self) -> bool:
        """Whether at least half of the fields that are not missing are numbers."""
        known = [cell for cell in self.cells if cell is not None]
        return not self.comment and 0 < len(known) <= 2 * sum(isinstance(cell, list) or cell == cell for cell in known)

    @cached_property
    def is_names(self) -> bool:
        """Whether fields are words, none of which stands for a missing number, or count the columns as in `,0,1,2`."""
        known = [cell for cell in self.cells if cell is not None]
        words = all(not isinstance(cell, list) and cell != cell for cell in known)
        counts = [list(range(first, first + len(self.fields)))[1:] for first in (-1, 0)]
        if len(self.fields) > 2 and not self.fields[0] and known in counts:
            return True
        return bool(known) and words and not any(text and text.lower() in _MISSING for text in self.fields)


def check_size(path: Path, count: int, most: int = MOST_VALUES, size: int = 8) -> None:
    """Raise InputError if these are more values, each of `size` bytes, than a table may hold."""
    if count > most:
        raise InputError(
            f"{path}: holds more than {most} values ({most * size >> 20} MiB in memory), the limit for one "
            "table; split the recording, or leave out columns that are not needed"
        )


def check_width(path: Path, row: int, width: int) -> None:
    """Raise InputError if a row has more fields than a table of samples has columns."""
    if width > _WIDEST:
        raise InputError(f"{path}: row {row} has more than {_WIDEST} fields: this is no table of samples, one in a row")


def parse_rows(path: Path, lines: list[str]) -> list[Row]:
    """Fields of lines by the separator that most of them have; a quoted field may go over several lines."""
    quoted = any('"' in line for line in lines)
    bare = _HIDDEN.sub("", "\n".join(lines)).split("\n") if quoted else lines or [""]
    separator = Counter(map(separator_of, bare)).most_common(1)[0][0]
    if quoted:
        with contextlib.suppress(csv.Error):  # a field of very many characters
            return _counted(path, (_without_mark(fields) for fields in _quoted(lines, separator) if fields))
    return _counted(path, (parse_row(line, separator) for line in lines))


def _counted(path: Path, rows: Iterable[Row]) -> list[Row]:
    """The rows, whose cells are counted as they come.

    Raises:
        InputError: more than a table may hold.
    """
    counted, cells = list[Row](), 0
    for row in rows:
        check_width(path, len(counted) + 1, len(row.fields))
        cells += len(row.fields)
        check_size(path, cells, MOST_CELLS, CELL)
        counted.append(row)
    return counted


def parse_row(line: str, separator: str | None) -> Row:
    if '"' in line:
        with contextlib.suppress(csv.Error):
            return _without_mark(next(_quoted([line], separator)))
    if "[" in line or "(" in line:
        return _without_mark(_outside_brackets(line.strip() if separator is None else line, separator))
    return _without_mark(line.split(separator))


def _outside_brackets(line: str, separator: str | None) -> list[str]:
    """Fields between separators that stand in no [] or (): the next bracket of a kind does not close one.

    From the end on, each mark is looked at once.
    """
    apart = r"\s+" if separator is None else re.escape(separator)
    fields, stop, following = [], len(line), {"[": "", "(": ""}
    for mark in reversed([*re.finditer(rf"[\[\]()]|{apart}", line)]):
        if mark[0] in _KIND:
            following[_KIND[mark[0]]] = mark[0]
        elif following["["] != "]" and following["("] != ")":
            fields.append(line[mark.end() : stop])
            stop = mark.start()
    return [line[:stop], *reversed(fields)]


def _quoted(lines: list[str], separator: str | None) -> Iterator[list[str]]:
    return csv.reader((line + "\n" for line in lines), delimiter=separator or " ", skipinitialspace=True)


def _without_mark(fields: list[str]) -> Row:
    """A comment without its mark, which may be a field of its own."""
    fields = [field.strip() for field in fields]
    if not fields[0].startswith(("#", "%")):
        return Row(fields)
    first = fields[0].lstrip("#% \t")
    return Row([first, *fields[1:]] if first else fields[1:], comment=True)


def separator_of(line: str) -> str | None:
    bare = _HIDDEN.sub("", line)
    return next((mark for mark in (";", "\t", ",", "|") if mark in bare), None)


def _cell(text: str) -> Cell:
    """The value of a field; vectors look like `[0.1, 0.2]` or `0.1 0.2`."""
    if text.lower() in _MISSING:
        return None
    number = _number(text)
    if number == number or len(text) < 3 or _THOUSANDS.fullmatch(text):
        return number
    inner = _VECTOR.fullmatch(text)
    parts = [part for part in _BETWEEN.split(inner[1] or inner[2] or "" if inner else text) if part]
    values = [_number(part) for part in parts]
    known = all(value == value or part.lower() == "nan" for part, value in zip(parts, values, strict=True))
    return values if known and (len(values) > 1 or (inner and values)) else np.nan


def _number(text: str) -> float:
    """A number (Fortran writes 1D-3, others 0,001), a time of day or a date [s]; NaN for anything else."""
    if len(text) > _LONGEST:
        return np.nan
    try:
        return float(text)
    except ValueError:
        pass
    if _NUMBER.fullmatch(text):
        return float(text.translate(_PLAIN))
    if clock := _CLOCK.fullmatch(text):
        return 3600.0 * int(clock[1]) + 60.0 * int(clock[2]) + float(clock[3].replace(",", "."))
    if _DATE.match(text):
        with contextlib.suppress(ValueError, OverflowError):
            date = datetime.fromisoformat(text.replace(",", "."))
            return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    return np.nan
