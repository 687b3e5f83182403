"""Rows of text, as CSV files and spreadsheets have them, to columns of numbers.

The longest block of rows is the table; lines above it with as many fields are its names. A cell may hold a number, a
date or time of day, or a vector, which becomes one column per element.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from agent.core import InputError, counted, open_regular

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
#: Characters of a line: 64 for each field of the widest row, the 16 384 columns of a sheet of Excel.
_LONGEST_LINE, _WIDEST = 2**20, 2**14
#: Numbers that one table may hold: an hour of 37 columns at 500 Hz, 512 MiB in memory.
MOST_VALUES = 2**26
#: Cells of text, 16 columns of as many rows as Excel allows, and bytes of one.
MOST_CELLS, CELL = 2**24, 64
#: What programs write for a number that is missing.
_MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "inf", "-inf"}
#: Types of UR's RTDE: code of NumPy, and how many of them.
_PACKED = {
    **{"BOOL": ("u1", 1), "UINT8": ("u1", 1), "UINT32": ("u4", 1), "UINT64": ("u8", 1), "INT32": ("i4", 1)},
    **{"DOUBLE": ("f8", 1), "VECTOR3D": ("f8", 3), "VECTOR6D": ("f8", 6)},
    **{"VECTOR6INT32": ("i4", 6), "VECTOR6UINT32": ("u4", 6)},
}
_BLOCK = 2**16
#: A number, the numbers of a vector, NaN for a word, None for what is missing.
Cell = float | list[float] | None


@dataclass(frozen=True, eq=False)
class ColumnTable:
    """Columns (S,) by name, in the order of the file, NaN where a field is no number; constants by name.

    A matrix (S, k) named q is columns q[1] to q[k]. Columns of a MAT file may differ in length. `words` has the
    fields of a column that are no number, where there are any, and "" for the others; `other_names` the column of a
    name in another line of names; `doubled` names that several columns have; `notes` what there is to say about the
    file; `objects` the class of MATLAB's objects, which cannot be read.
    """

    path: Path
    columns: dict[str, np.ndarray]
    constants: dict[str, float] = field(default_factory=dict)
    words: dict[str, list[str]] = field(default_factory=dict)
    other_names: dict[str, str] = field(default_factory=dict)
    doubled: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    objects: dict[str, str] = field(default_factory=dict)

    def name(self, key: str | int) -> str | None:
        """Name of a column, found by name or by number from 1; None if there is no such column."""
        if isinstance(key, int):
            return list(self.columns)[key - 1] if 1 <= key <= len(self.columns) else None
        for text in (key, key.lstrip("#% "), _dotted(key)):  # a comment that holds the names, a path of HDF5
            name = text if text in self.columns else self.other_names.get(text, f"{text}[1]")
            if name in self.columns:
                return name
        return None

    def column(self, key: str | int) -> np.ndarray | None:
        """Column (S,), found by name or by number from 1; None if there is no such column."""
        name = self.name(key)
        return None if name is None else self.columns[name]

    def matrix(self, name: str) -> list[str]:
        """Names of the columns of a matrix, q[1], q[2], …; empty if there is none of that name."""
        names = (self.other_names.get(text, text) for text in (name, _dotted(name)))
        matrices = ([column for column in self.columns if column.startswith(f"{text}[")] for text in names)
        return next(filter(None, matrices), [])

    def of_each(
        self, marker: str | int, values: Sequence[float | str], kept: Sequence[str | int]
    ) -> ColumnTable | None:
        """This table with a matrix instead of each column, such as q[pan], q[lift]: NaN but in rows whose `marker` has
        the value. Columns in `kept` stay. None if there is no such marker, or no row with one of the values.
        """
        if (name := self.name(marker)) is None:
            return None
        marks = np.array(self.words.get(name, self.columns[name].tolist()), dtype=object)
        rows = {str(value): marks == value for value in values}
        if not all(np.any(own) for own in rows.values()):
            return None
        columns = dict[str, np.ndarray]()
        for title, column in self.columns.items():
            if title in [name, *map(self.name, kept)]:
                columns[title] = column
            else:
                columns |= {f"{title}[{value}]": np.where(own, column, np.nan) for value, own in rows.items()}
        return replace(self, columns=columns)

    def missing(self, names: Sequence[str | int]) -> str:
        """That it has none of these columns, what it has instead, and what to do."""
        matrices = Counter(name.partition("[")[0] for name in self.columns)
        rows = {name.partition("[")[0]: len(column) for name, column in self.columns.items()}
        has = [f"{name} ({rows[name]} x {count})" if count > 1 else name for name, count in matrices.items()]
        text = f"{self.path.name} has no column {', '.join(map(str, names))}; it has {', '.join(has) or 'none'}"
        objects = [f"{name}, a MATLAB {kind}" for name, kind in self.objects.items()]
        if not objects:
            return text
        return f"{text}, and {'; '.join(objects)}: save plain arrays of it, as in q = ts.Data; t = ts.Time"


def _dotted(path: str) -> str:
    """The name of a dataset of HDF5 by its path."""
    return path.strip("/").replace("/", ".")


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


def _windows(error: UnicodeError) -> tuple[str, int]:
    """What Windows means by bytes that are not UTF-8, such as the ° of `Angle [°]`, and where the rest begins."""
    if not isinstance(error, UnicodeDecodeError):
        raise error
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error("windows", _windows)


def read_text(path: Path) -> ColumnTable:
    """Comma, semicolon, tab, | or blanks between the fields, which may stand in double quotes; decimal commas where the
    comma separates nothing.

    Raises:
        InputError: no row of numbers, or more than a table may hold.
    """
    if (table := _packed_table(path)) is not None:
        return table
    lines = _lines(path)
    return _plain_table(path, lines) or table_of_rows(path, _rows(path, lines))


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


def _lines(path: Path) -> list[str]:
    """Lines that are not blank. A line without an end is not read to its end."""
    lines, number, characters = list[str](), 0, 0
    with open_regular(path) as file:
        marked = file.peek(2).startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = io.TextIOWrapper(file, "utf-16" if marked else "utf-8-sig", errors="windows")
        while line := text.readline(_LONGEST_LINE):
            number += 1
            if len(line) == _LONGEST_LINE:
                raise InputError(
                    f"{path}: line {number} has {_LONGEST_LINE} characters or more: this is no table with one "
                    "sample in a line; export one"
                )
            if line.strip():
                lines.append(line.rstrip("\n"))
                characters += len(line)
                check_size(path, characters // 16)
    return lines


def table_of_rows(path: Path, rows: Sequence[Row]) -> ColumnTable:
    """The longest block of rows of numbers, with the names above it.

    Raises:
        InputError: no row of numbers.
    """
    widths = Counter(row.width for row in rows if row.is_data)
    if not widths:
        raise InputError(
            f"{path}: no line of numbers in it; export numbers like 1234.5 with commas, semicolons, tabs, | or blanks "
            "between them, as UTF-8, or as UTF-16 with a byte order mark"
        )
    width = widths.most_common(1)[0][0]

    def size(block: tuple[int, int]) -> int:
        return sum(row.is_data for row in rows[slice(*block)])

    start, stop = block = max(_blocks(rows, width), key=size)
    left_out = sum(row.is_data for row in rows) - size(block)
    notes = (f"{counted(left_out, 'row')} of numbers outside the longest block, left out",) if left_out else ()
    columns: list[np.ndarray] = []
    words: dict[int, list[str]] = {}
    kept = [row for row in rows[start:stop] if not row.comment]
    for place in range(width):
        column: list[Cell] = [row.cells[place] if row.width == width else np.nan for row in kept]
        texts = [
            row.fields[place] if row.width == width and isinstance(cell, float) and cell != cell else ""
            for row, cell in zip(kept, column, strict=True)
        ]
        if any(texts):
            words[place] = texts
        lengths = Counter(len(cell) for cell in column if isinstance(cell, list))
        if lengths:
            blank = [np.nan] * lengths.most_common(1)[0][0]
            column = [cell if isinstance(cell, list) and len(cell) == len(blank) else blank for cell in column]
        columns.append(np.array(column, float))
    return _named(path, _heads(rows, start, width), columns, words, notes)


def _packed_table(path: Path) -> ColumnTable | None:
    """Two lines with names and types, then rows of big-endian numbers: what `record.py --binary` of UR writes."""
    with open_regular(path) as file:
        names, _, remainder = file.read(_BLOCK).partition(b"\n")
    types, newline, _ = remainder.partition(b"\n")
    labels, kinds = (line.decode("ascii", errors="replace").replace(",", " ").split() for line in (names, types))
    if not newline or not kinds or len(kinds) != len(labels) or not all(kind in _PACKED for kind in kinds):
        return None
    parts = [(label, *_PACKED[kind]) for label, kind in zip(labels, kinds, strict=True)]
    dtype = np.dtype([(label, f">{code}", (count,)) for label, code, count in parts])
    start = len(names) + len(types) + 2
    count = (path.stat().st_size - start) // dtype.itemsize
    check_size(path, count * sum(count for *_, count in parts))
    table = np.fromfile(path, dtype, count, offset=start)
    columns = {
        f"{label}_{k}" if count > 1 else label: table[label][:, k].astype(float)
        for label, _, count in parts
        for k in range(count)
    }
    return ColumnTable(path, columns)


def _plain_table(path: Path, lines: list[str]) -> ColumnTable | None:
    """The table where every line below the names is of plain numbers, as most are: read at once."""
    start = next((k for k, line in enumerate(lines) if _row(line, _separator(line)).is_data), None)
    if start is None:
        return None
    separator = _separator(lines[start])
    if '"' in lines[start] or _row(lines[start], separator).is_names:
        return None
    plain = [line for line in lines[start:] if not line.lstrip().startswith(("#", "%"))]
    width = len(lines[start].split(separator))
    check_width(path, start + 1, width)
    check_size(path, width * len(plain))
    try:
        # a generator lets signals in
        numbers = (line if separator == "," else line.replace(",", ".") for line in plain)
        values = np.loadtxt(numbers, delimiter=separator, ndmin=2, comments=None)
    except ValueError:
        return None
    heads = _heads([_row(line, separator) for line in lines[: start + 1]], start, values.shape[1])
    return _named(path, heads, list(values.T), {}, ())


def _rows(path: Path, lines: list[str]) -> list[Row]:
    """Fields of lines by the separator that most of them have; a quoted field may go over several lines."""
    quoted = any('"' in line for line in lines)
    bare = _HIDDEN.sub("", "\n".join(lines)).split("\n") if quoted else lines or [""]
    separator = Counter(map(_separator, bare)).most_common(1)[0][0]
    if quoted:
        with contextlib.suppress(csv.Error):  # a field of very many characters
            return _counted(path, (_without_mark(fields) for fields in _quoted(lines, separator) if fields))
    return _counted(path, (_row(line, separator) for line in lines))


def _counted(path: Path, rows: Iterable[Row]) -> list[Row]:
    """The rows, whose cells are counted as they come.

    Raises:
        InputError: more than a table may hold.
    """
    kept, cells = list[Row](), 0
    for row in rows:
        check_width(path, len(kept) + 1, len(row.fields))
        cells += len(row.fields)
        check_size(path, cells, MOST_CELLS, CELL)
        kept.append(row)
    return kept


def _row(line: str, separator: str | None) -> Row:
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


def _separator(line: str) -> str | None:
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


def _blocks(rows: Sequence[Row], width: int) -> list[tuple[int, int]]:
    """[start, stop) of rows of numbers of that width, parted by other names or by lines of another kind."""
    blocks: list[tuple[int, int]] = []
    names: list[str] | None = None
    for k, row in enumerate(rows):
        if row.width != width or not row.is_data or row.is_names:
            continue
        between = rows[blocks[-1][1] if blocks else 0 : k]
        strange = sum(not other.comment and other.width != width for other in between)
        heads = [other.fields for other in between if other.width == width and other.is_names]
        if blocks and strange < 2 and all(head == names for head in heads) and not (strange and heads):
            blocks[-1] = (blocks[-1][0], k + 1)
        else:
            blocks.append((k, k + 1))
            names = heads[0] if heads else None
    # what was torn off when the writer stopped belongs to the last block
    if sum(row.width != width for row in rows[blocks[-1][1] :]) < 2:
        blocks[-1] = (blocks[-1][0], len(rows))
    return blocks


def _heads(rows: Sequence[Row], start: int, width: int) -> list[list[str]]:
    """Lines of names above a block, the first line first; fields that separators at the line's end leave are empty."""
    heads: list[list[str]] = []
    for row in reversed(rows[:start]):
        if row.width == width and row.is_data and not row.is_names:
            break
        fields = list(row.fields)
        while len(fields) > width and not fields[-1]:
            fields.pop()
        if len(fields) == width and Row(fields).is_names:
            heads.insert(0, fields)
    if not heads and start and 1 < len(rows[start - 1].fields) < width and rows[start - 1].is_names:
        fields = rows[start - 1].fields
        heads = [[*fields, *[""] * (width - len(fields))]]
    return heads


def _named(
    path: Path, heads: list[list[str]], columns: list[np.ndarray], words: dict[int, list[str]], notes: tuple[str, ...]
) -> ColumnTable:
    """Columns (S,), or (S, k) of a vector, by the names of the first head; the others are names too. A name that
    stands twice names none of them."""
    by_name: dict[str, np.ndarray] = {}
    other_names: dict[str, str] = {}
    texts: dict[str, list[str]] = {}
    names = [[text.strip("\"' ") for text in head] for head in heads]
    doubled = {name for head in names for name, count in Counter(head).items() if name and count > 1}
    for place, column in enumerate(columns):
        own = [head[place] for head in names if head[place] and head[place] not in doubled]
        name = own[0] if own and own[0] not in by_name else f"column {place + 1}"
        other_names |= {other: name for other in own if other not in other_names}
        if place in words:
            texts[name] = words[place]
        if column.ndim == 2:
            by_name |= {f"{name}[{k + 1}]": part for k, part in enumerate(column.T)}
        else:
            by_name[name] = column
    return ColumnTable(path, by_name, {}, texts, other_names, frozenset(doubled), notes)
