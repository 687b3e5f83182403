"""Rows of text, as CSV files and spreadsheets have them, to columns of numbers.

The longest block of rows is the table; lines above it with as many fields are its names. A vector becomes one column
per element.
"""

from __future__ import annotations

import codecs
import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from agent.core import InputError, counted, open_regular
from agent.recording.tables.text_rows import Cell, Row, check_size, check_width, parse_row, parse_rows, separator_of

#: Characters of a line: 64 for each field of the widest row.
_LONGEST_LINE = 2**20
#: Types of UR's RTDE: code of NumPy, and how many of them.
_PACKED = {
    **{"BOOL": ("u1", 1), "UINT8": ("u1", 1), "UINT32": ("u4", 1), "UINT64": ("u8", 1), "INT32": ("i4", 1)},
    **{"DOUBLE": ("f8", 1), "VECTOR3D": ("f8", 3), "VECTOR6D": ("f8", 6)},
    **{"VECTOR6INT32": ("i4", 6), "VECTOR6UINT32": ("u4", 6)},
}
_BLOCK = 2**16


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
        self, marker: str | int, values: Sequence[float | str], shared: Sequence[str | int]
    ) -> ColumnTable | None:
        """This table with a matrix instead of each column, such as q[pan], q[lift]: NaN but in rows whose `marker` has
        the value. Columns in `shared` stay. None if there is no such marker, or no row with one of the values.
        """
        if (name := self.name(marker)) is None:
            return None
        marks = np.array(self.words.get(name, self.columns[name].tolist()), dtype=object)
        rows = {str(value): marks == value for value in values}
        if not all(np.any(own) for own in rows.values()):
            return None
        columns = dict[str, np.ndarray]()
        for title, column in self.columns.items():
            if title in [name, *map(self.name, shared)]:
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
    return _plain_table(path, lines) or table_of_rows(path, parse_rows(path, lines))


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
    data_rows = [row for row in rows[start:stop] if not row.comment]
    for index in range(width):
        column: list[Cell] = [row.cells[index] if row.width == width else np.nan for row in data_rows]
        texts = [
            row.fields[index] if row.width == width and isinstance(cell, float) and cell != cell else ""
            for row, cell in zip(data_rows, column, strict=True)
        ]
        if any(texts):
            words[index] = texts
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
    start = next((k for k, line in enumerate(lines) if parse_row(line, separator_of(line)).is_data), None)
    if start is None:
        return None
    separator = separator_of(lines[start])
    if '"' in lines[start] or parse_row(lines[start], separator).is_names:
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
    heads = _heads([parse_row(line, separator) for line in lines[: start + 1]], start, values.shape[1])
    return _named(path, heads, list(values.T), {}, ())


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
    for index, column in enumerate(columns):
        own = [head[index] for head in names if head[index] and head[index] not in doubled]
        name = own[0] if own and own[0] not in by_name else f"column {index + 1}"
        other_names |= {other: name for other in own if other not in other_names}
        if index in words:
            texts[name] = words[index]
        if column.ndim == 2:
            by_name |= {f"{name}[{k + 1}]": part for k, part in enumerate(column.T)}
        else:
            by_name[name] = column
    return ColumnTable(path, by_name, {}, texts, other_names, frozenset(doubled), notes)
