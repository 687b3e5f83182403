"""Columns of numbers out of CSV, MAT and Parquet files."""

from __future__ import annotations

import contextlib
import csv
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, needed
from agent.recording.table_sizes import check_mat, number_columns

#: Columns that one matrix of a MAT file may hold; a wider one is no table of samples.
_MAX_COLUMNS = 256


@dataclass(frozen=True, eq=False)
class ColumnTable:
    """Columns (S,) by name, in the order of the file, NaN where a field is no number; constants by name.

    A matrix (S, k) named q is columns q[1] to q[k]. Columns of a MAT file may differ in length. `words` has the first
    field of a column that is no number, where there is one.
    """

    path: Path
    columns: dict[str, np.ndarray]
    constants: dict[str, float]
    words: dict[str, str] = field(default_factory=dict)

    def name(self, key: str | int) -> str | None:
        """Of a column by name, or by number from 1; None if there is none."""
        if isinstance(key, int):
            return list(self.columns)[key - 1] if 1 <= key <= len(self.columns) else None
        return key if key in self.columns else None

    def column(self, key: str | int) -> np.ndarray | None:
        """(S,) by name, or by number from 1; None if there is none."""
        name = self.name(key)
        return None if name is None else self.columns[name]

    def matrix(self, name: str) -> list[str]:
        """Names of the columns of a matrix, q[1], q[2], …; empty if there is none of that name."""
        return [column for column in self.columns if column.startswith(f"{name}[")]


def read_table(path: Path) -> ColumnTable:
    """Read a file by its ending: .csv, .tsv, .txt, .dat, .mat, .parquet.

    Raises:
        InputError: no such file, another ending, or nothing in it that can be read.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: tables end in {', '.join(_READERS)}; {path.suffix or 'no ending'} is none of them")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        table = reader(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (MemoryError, RecursionError):
        raise InputError(f"{path}: takes more memory, or is nested deeper, than a table of samples") from None
    if not any(len(column) for column in table.columns.values()):
        raise InputError(f"{path}: no columns of numbers in it")
    return table


def _read_text(path: Path) -> ColumnTable:
    """Comma, semicolon, tab, | or blanks between the numbers, which may stand in double quotes; decimal commas where
    the comma separates nothing.

    Names come from the first line above the numbers that has as many fields, a comment (#, %) among them.
    """
    content = path.read_bytes()
    encoding = "utf-16" if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig"
    lines = [line for line in content.decode(encoding, errors="replace").splitlines() if line.strip()]
    start = next((k for k, line in enumerate(lines) if _is_data(line)), None)
    if start is None:
        raise InputError(
            f"{path}: no line of numbers in it; export numbers like 1234.5 with commas, semicolons, tabs, | or blanks "
            "between them, as UTF-8, or as UTF-16 with a byte order mark"
        )
    separator = _separator(lines[start])
    width = len(_split(lines[start], separator))
    names = [f"column {k + 1}" for k in range(width)]
    for line in lines[:start]:
        fields = _split(line.lstrip("#% \t") if _comment(line) else line, separator)
        if len(fields) == width:
            names = [field.strip("\"' ") for field in fields]
            break
    data = [line for line in lines[start:] if not _comment(line)]
    quoted = '"' if '"' in lines[start] else None
    words: dict[int, str] = {}
    try:
        plain = data if separator == "," else [line.replace(",", ".") for line in data]
        values = np.loadtxt(plain, delimiter=separator, ndmin=2, comments=None, quotechar=quoted)
    except ValueError:
        values, words = _read_broken(data, separator, width)
    if len(set(names)) < width:
        raise InputError(f"{path}: column names stand twice: {', '.join(names)}; make them differ, or use numbers")
    columns = dict(zip(names, values.T, strict=True))
    return ColumnTable(path, columns, {}, {names[place]: word for place, word in words.items()})


def _read_broken(lines: list[str], separator: str | None, width: int) -> tuple[np.ndarray, dict[int, str]]:
    """(S, width) numbers, NaN where a field is none and in rows of another width; the first such field by column."""
    values = np.full((len(lines), width), np.nan)
    words: dict[int, str] = {}
    for row, line in zip(values, lines, strict=True):
        fields = _split(line, separator)
        if len(fields) != width:
            continue
        row[:] = [_number(field if separator == "," else field.replace(",", ".")) for field in fields]
        for place in np.flatnonzero(np.isnan(row)).tolist():
            if fields[place]:
                words.setdefault(place, fields[place])
    return values, words


def _separator(line: str) -> str | None:
    return next((mark for mark in (";", "\t", ",", "|") if mark in line), None)


def _split(line: str, separator: str | None) -> list[str]:
    fields = line.split(separator)
    if '"' in line:
        with contextlib.suppress(csv.Error):  # a field of very many characters
            fields = next(csv.reader([line], delimiter=separator or " ", skipinitialspace=True))
    return [field.strip() for field in fields]


def _comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%"))


def _is_data(line: str) -> bool:
    """Whether at least half of the fields are numbers."""
    if _comment(line):
        return False
    fields = _split(line, _separator(line))
    return 2 * sum(not np.isnan(_number(field.replace(",", "."))) for field in fields) >= len(fields)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _read_mat(path: Path) -> ColumnTable:
    from scipy.io import loadmat

    check_mat(path)
    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        raise InputError(f"{path}: saved as MATLAB 7.3 (HDF5); save it with `save -v7`") from None
    except Exception as error:  # scipy raises whatever a damaged file leads it to
        raise InputError(f"{path}: not a readable MAT file: {error}") from None
    columns: dict[str, np.ndarray] = {}
    constants: dict[str, float] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _flatten(name, value, columns, constants)
    return ColumnTable(path, columns, constants)


def _flatten(name: str, value: Any, columns: dict[str, np.ndarray], constants: dict[str, float]) -> None:
    """Numbers of a MATLAB variable: scalars, vectors, matrices (samples along the longer side), fields of structs."""
    for part in getattr(value, "_fieldnames", ()):
        _flatten(f"{name}.{part}", getattr(value, part), columns, constants)
    if np.asarray(value).dtype.kind not in "biuf":
        return
    array = np.asarray(value, float)
    if array.size == 1:
        constants[name] = array.item()
    elif array.ndim == 1:
        columns[name] = array
    elif array.ndim == 2 and min(array.shape) <= _MAX_COLUMNS:
        samples = array if array.shape[0] >= array.shape[1] else array.T
        columns |= {f"{name}[{k + 1}]": column for k, column in enumerate(samples.T)}


def _read_parquet(path: Path) -> ColumnTable:
    needed("pyarrow", f"{path}: reading Parquet", "parquet")
    from pyarrow import ArrowException, parquet

    try:
        with parquet.ParquetFile(path) as file:
            content = file.read(number_columns(path, file))
    except ArrowException as error:
        raise InputError(f"{path}: not a readable Parquet file: {error}") from None
    columns: dict[str, np.ndarray] = {}
    for name in content.column_names:
        values = content.column(name).to_numpy(zero_copy_only=False)
        if values.dtype.kind == "M":
            columns[name] = values.astype("datetime64[ns]").astype(np.int64) / 1e9
        elif values.dtype.kind in "biuf":
            columns[name] = values.astype(float)
        elif values.dtype.kind == "O" and len({np.shape(value) for value in values}) == 1 and np.ndim(values[0]) == 1:
            stacked = np.stack(values)
            if stacked.dtype.kind in "biuf":
                columns |= {f"{name}[{k + 1}]": column.astype(float) for k, column in enumerate(stacked.T)}
    return ColumnTable(path, columns, {})


_READERS: dict[str, Callable[[Path], ColumnTable]] = {
    ".csv": _read_text,
    ".tsv": _read_text,
    ".txt": _read_text,
    ".dat": _read_text,
    ".mat": _read_mat,
    ".parquet": _read_parquet,
}
