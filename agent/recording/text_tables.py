"""Rows of text, as CSV files and spreadsheets have them, to columns of numbers.

The longest block of rows is the table; lines above it with as many fields are its names. A cell may hold a number, a
date or time of day, or a vector, which becomes one column per element.
"""

from __future__ import annotations

import contextlib
import csv
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from agent.core import InputError, counted
from agent.recording.column_table import ColumnTable

_HIDDEN = re.compile(r'"[^"]*"|\[[^\]]*\]|\([^)]*\)')
_VECTOR = re.compile(r"(?:[a-z_.]+\()?(?:'\w',)?\s*\[([^\[\]]*)\][^\[\]]*|[({]([^\[\]]*)[)}]")
_BETWEEN = re.compile(r"[\s,;|]+")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+\.\d*")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?|[-+]?\d+,")
_DATE = re.compile(r"\d{4}-?\d\d-?\d\d[T ]\d\d:?\d\d")
_CLOCK = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)")
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
class Row:
    """Fields of a line. A comment may still hold the names of the columns."""

    fields: list[str]
    comment: bool = False


def read_text(path: Path) -> ColumnTable:
    """Comma, semicolon, tab, | or blanks between the fields, which may stand in double quotes; decimal commas where the
    comma separates nothing."""
    content = path.read_bytes()
    if (table := _packed_table(path, content)) is not None:
        return table
    encoding = "utf-16" if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig"
    lines = [line for line in content.decode(encoding, errors="replace").splitlines() if line.strip()]
    return _plain_table(path, lines) or table_of_rows(path, _rows(lines))


def table_of_rows(path: Path, rows: Sequence[Row]) -> ColumnTable:
    """The longest block of rows of numbers, with the names above it.

    Raises:
        InputError: no row of numbers.
    """
    cells = [[] if row.comment else [_cell(field) for field in row.fields] for row in rows]
    widths = Counter(len(row) for row in cells if _is_data(row))
    if not widths:
        raise InputError(
            f"{path}: no line of numbers in it; export numbers like 1234.5 with commas, semicolons, tabs, | or blanks "
            "between them, as UTF-8, or as UTF-16 with a byte order mark"
        )
    width = widths.most_common(1)[0][0]
    start, stop = max(_blocks(rows, cells, width), key=lambda block: sum(map(_is_data, cells[block[0] : block[1]])))
    heads = _heads(rows, cells, start, width)
    kept = [(row, values) for row, values in zip(rows[start:stop], cells[start:stop], strict=True) if not row.comment]
    left_out = sum(map(_is_data, cells)) - sum(map(_is_data, cells[start:stop]))
    notes = () if not left_out else (f"{counted(left_out, 'row')} of numbers outside the longest block, left out",)
    return _columns(path, kept, heads, width, notes)


def _packed_table(path: Path, content: bytes) -> ColumnTable | None:
    """Two lines with names and types, then rows of big-endian numbers: what `record.py --binary` of UR writes."""
    names, _, rest = content[:_BLOCK].partition(b"\n")
    types, found, _ = rest.partition(b"\n")
    kinds = types.decode("ascii", errors="replace").replace(",", " ").split()
    labels = names.decode("ascii", errors="replace").replace(",", " ").split()
    if not found or not kinds or len(kinds) != len(labels) or not all(kind in _PACKED for kind in kinds):
        return None
    parts = [(label, *_PACKED[kind]) for label, kind in zip(labels, kinds, strict=True)]
    dtype = np.dtype([(label, f">{code}", (count,)) for label, code, count in parts])
    rows = np.frombuffer(content[len(names) + len(types) + 2 :], np.uint8)
    table = rows[: len(rows) // dtype.itemsize * dtype.itemsize].view(dtype)
    columns = {
        f"{label}_{k}" if count > 1 else label: table[label][:, k].astype(float)
        for label, _, count in parts
        for k in range(count)
    }
    return ColumnTable(path, columns, {})


def _plain_table(path: Path, lines: list[str]) -> ColumnTable | None:
    """The table where every line below the names is of plain numbers, as most are: read at once."""
    start = next((k for k, line in enumerate(lines) if not _is_comment(line) and _is_data(_cells(line))), None)
    if (
        start is None
        or '"' in lines[start]
        or _is_names(_row(lines[start], _separator(lines[start])).fields, _cells(lines[start]))
    ):
        return None
    separator = _separator(lines[start])
    plain = [line for line in lines[start:] if not _is_comment(line)]
    try:
        numbers = plain if separator == "," else [line.replace(",", ".") for line in plain]
        values = np.loadtxt(numbers, delimiter=separator, ndmin=2, comments=None)
    except ValueError:
        return None
    rows = [_row(line, separator) for line in lines[: start + 1]]
    heads = _heads(
        rows, [[] if row.comment else [_cell(field) for field in row.fields] for row in rows], start, values.shape[1]
    )
    return _named(path, heads, list(values.T), {}, ())


def _rows(lines: list[str]) -> list[Row]:
    """Fields of lines by the separator that most of them have; a quoted field may go over several lines."""
    bare = _HIDDEN.sub("", "\n".join(lines)).split("\n")
    separator = Counter(map(_separator, bare)).most_common(1)[0][0]
    if any('"' in line for line in lines):
        with contextlib.suppress(csv.Error):  # a field of very many characters
            return [_without_mark(fields) for fields in _quoted(lines, separator) if fields]
    return [_row(line, separator) for line in lines]


def _row(line: str, separator: str | None) -> Row:
    if '"' in line:
        with contextlib.suppress(csv.Error):
            return _without_mark(_quoted([line], separator)[0])
    if "[" in line or "(" in line:
        apart = re.escape(separator) if separator else r"\s+"
        fields = re.split(rf"{apart}(?![^\[\]]*\])(?![^()]*\))", line.strip() if separator is None else line)
    else:
        fields = line.split(separator)
    return _without_mark(fields)


def _quoted(lines: list[str], separator: str | None) -> list[list[str]]:
    return list(csv.reader((line + "\n" for line in lines), delimiter=separator or " ", skipinitialspace=True))


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


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%"))


def _cells(line: str) -> list[Cell]:
    return [_cell(field) for field in _row(line, _separator(line)).fields]


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
    try:
        return float(text)
    except ValueError:
        pass
    if _DECIMAL_COMMA.fullmatch(text):
        return float(text.replace(",", "."))
    clock = _CLOCK.fullmatch(text)
    if clock:
        return 3600.0 * int(clock[1]) + 60.0 * int(clock[2]) + float(clock[3].replace(",", "."))
    if _DATE.match(text):
        with contextlib.suppress(ValueError, OverflowError):
            date = datetime.fromisoformat(text.replace(",", "."))
            return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    return np.nan


def _is_data(cells: list[Cell]) -> bool:
    """Whether at least half of the fields that are not missing are numbers."""
    known = [cell for cell in cells if cell is not None]
    return 0 < len(known) <= 2 * sum(isinstance(cell, list) or cell == cell for cell in known)


def _is_names(fields: list[str], cells: list[Cell]) -> bool:
    """Whether fields are words, none of which stands for a missing number, or count the columns as `,0,1,2` does."""
    known = [cell for cell in cells if cell is not None]
    words = all(not isinstance(cell, list) and cell != cell for cell in known)
    counts = [range(first, first + len(cells)) for first in (-1, 0)]
    numbered = len(cells) > 2 and any(known == list(count)[1:] for count in counts) and not fields[0]
    return bool(known) and ((words and not any(field and field.lower() in _MISSING for field in fields)) or numbered)


def _blocks(rows: Sequence[Row], cells: list[list[Cell]], width: int) -> list[tuple[int, int]]:
    """[start, stop) of rows of numbers of that width, parted by other names or by lines of another kind."""
    blocks: list[tuple[int, int]] = []
    names: list[str] | None = None
    for k, row in enumerate(cells):
        if len(row) != width or not _is_data(row) or _is_names(rows[k].fields, row):
            continue
        between = range(blocks[-1][1], k) if blocks else range(k)
        strange = [j for j in between if not rows[j].comment and len(cells[j]) != width]
        heads = [rows[j].fields for j in between if len(cells[j]) == width and _is_names(rows[j].fields, cells[j])]
        if blocks and len(strange) < 2 and all(head == names for head in heads) and not (strange and heads):
            blocks[-1] = (blocks[-1][0], k + 1)
        else:
            blocks.append((k, k + 1))
            names = heads[0] if heads else None
    # what was torn off when the writer stopped belongs to the last block
    if sum(len(row) != width for row in cells[blocks[-1][1] :]) < 2:
        blocks[-1] = (blocks[-1][0], len(cells))
    return blocks


def _heads(rows: Sequence[Row], cells: list[list[Cell]], start: int, width: int) -> list[list[str]]:
    """Lines of names above a block, the first line first; fields that separators at the line's end leave are empty."""
    heads: list[list[str]] = []
    for row, values in zip(reversed(rows[:start]), reversed(cells[:start]), strict=True):
        if not row.comment and len(values) == width and _is_data(values) and not _is_names(row.fields, values):
            break
        fields = row.fields
        while len(fields) > width and not fields[-1]:
            fields = fields[:-1]
        numbers = [_cell(field) for field in fields] if row.comment else values
        if len(fields) == width and _is_names(fields, numbers[:width]):
            heads.insert(0, fields)
    above = [row.fields for row in rows[max(0, start - 1) : start]]
    if not heads and above and 1 < len(above[0]) < width and _is_names(above[0], [_cell(field) for field in above[0]]):
        heads = [[*above[0], *[""] * (width - len(above[0]))]]
    return heads


def _columns(
    path: Path, rows: Sequence[tuple[Row, list[Cell]]], heads: list[list[str]], width: int, notes: tuple[str, ...]
) -> ColumnTable:
    """Columns of rows; a column of vectors becomes a list of columns."""
    columns: list[np.ndarray] = []
    words: dict[int, str] = {}
    for place in range(width):
        column: list[Cell] = [values[place] if len(values) == width else np.nan for _, values in rows]
        for (row, values), cell in zip(rows, column, strict=True):
            if len(values) == width and isinstance(cell, float) and cell != cell:
                words[place] = row.fields[place]
                break
        lengths = Counter(len(cell) for cell in column if isinstance(cell, list))
        if not lengths:
            columns.append(np.array(column, float))
            continue
        size = lengths.most_common(1)[0][0]
        blank = [np.nan] * size
        columns.append(np.array([cell if isinstance(cell, list) and len(cell) == size else blank for cell in column]))
    return _named(path, heads, columns, words, notes)


def _named(
    path: Path, heads: list[list[str]], columns: list[np.ndarray], words: dict[int, str], notes: tuple[str, ...]
) -> ColumnTable:
    """Columns (S,), or (S, k) of a vector, by the names of the first head; the others are names too. A name that
    stands twice names none of them."""
    width = len(columns)
    found: dict[str, np.ndarray] = {}
    other_names: dict[str, str] = {}
    texts: dict[str, str] = {}
    names = [[field.strip("\"' ") for field in head] for head in heads]
    doubled = {name for head in names for name, count in Counter(head).items() if name and count > 1}
    for place in range(width):
        own = [head[place] for head in names if head[place] and head[place] not in doubled]
        name = own[0] if own and own[0] not in found else f"column {place + 1}"
        other_names |= {other: name for other in own if other not in other_names}
        column = columns[place]
        if place in words:
            texts[name] = words[place]
        if column.ndim == 2:
            found |= {f"{name}[{k + 1}]": part for k, part in enumerate(column.T)}
        else:
            found[name] = column
    return ColumnTable(path, found, {}, texts, other_names, frozenset(doubled), notes)
