"""Columns of numbers out of files, each by the library that knows the format.

A few megabytes of a compressed file may hold gigabytes, so its size in memory is found out before it is read.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from agent.core import InputError, needed
from agent.recording.text_tables import ColumnTable, Row, read_text, table_of_rows

#: Columns that one matrix of a MAT file may hold; a wider one is no table of samples.
_MAX_COLUMNS = 256
#: Numbers that one table may hold: an hour of 37 columns at 500 Hz, 512 MiB in memory.
_MOST_VALUES = 2**26
_MAT_HEADER, _MAT_TAG, _MAT_COMPRESSED = 128, 8, 15  # bytes, bytes, data type
_PIECE = 2**20  # bytes


def read_table(path: Path) -> ColumnTable:
    """Read a file by its ending.

    Raises:
        InputError: no such file, another ending, or nothing in it that can be read.
    """
    ending = path.suffix.lower()
    if ending not in _READERS:
        raise InputError(f"{path}: tables end in {', '.join(_READERS)}; this one ends in {path.suffix or 'nothing'}")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    kind, reader = _READERS[ending]
    try:
        table = reader(path)
    except InputError:
        raise
    except (MemoryError, RecursionError):
        raise InputError(f"{path}: takes more memory, or is nested deeper, than a table of samples") from None
    except OSError as error:
        if error.strerror:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
        raise InputError(f"{path}: not a readable {kind} file: {error}") from None
    except Exception as error:  # libraries raise whatever a damaged file leads them to
        advice = "; save plain arrays, not objects: np.savez(file, t=t, q=q)" if "pickle" in str(error) else ""
        raise InputError(f"{path}: not a readable {kind} file: {error}{advice}") from None
    if not any(len(column) for column in table.columns.values()):
        raise InputError(f"{path}: no columns of numbers in it")
    return table


def _check_values(path: Path, values: int) -> None:
    """Raise InputError if these are more numbers than a table may hold."""
    if values > _MOST_VALUES:
        raise InputError(
            f"{path}: holds more than {_MOST_VALUES} numbers ({_MOST_VALUES >> 17} MiB in memory), the limit for one "
            "table; split the recording, or leave out columns that are not needed"
        )


def _check_unzipped(path: Path) -> None:
    """Check what a zipped table (.npz, .xlsx) says it unpacks to; any other file takes no more than its own size."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            _check_values(path, sum(entry.file_size for entry in file.infolist()) // 8)


def _check_mat(path: Path) -> None:
    """Unpack every compressed variable (versions 5 to 7) in pieces, and keep none; a damaged file is left to SciPy."""
    unpacked = 0
    with open(path, "rb") as file:
        order: Literal["big", "little"] = "big" if file.read(_MAT_HEADER)[-2:] == b"MI" else "little"
        while len(tag := file.read(_MAT_TAG)) == _MAT_TAG:
            kind, size = int.from_bytes(tag[:4], order), int.from_bytes(tag[4:], order)
            end = file.tell() + size
            unpack = zlib.decompressobj()
            while kind == _MAT_COMPRESSED and file.tell() < end and not unpack.eof:
                data = file.read(min(_PIECE, end - file.tell()))
                while data and not unpack.eof:
                    try:
                        unpacked += len(unpack.decompress(data, _PIECE))
                    except zlib.error:
                        return
                    _check_values(path, unpacked // 8)
                    data = unpack.unconsumed_tail
            file.seek(end)


class _Variables:
    """Columns and constants of a file of named arrays."""

    def __init__(self) -> None:
        self.columns: dict[str, np.ndarray] = {}
        self.constants: dict[str, float] = {}

    def add(self, name: str, value: Any) -> None:
        """Numbers of a variable: scalars, vectors, matrices (samples along the longer side), fields of structs."""
        for part in getattr(value, "_fieldnames", ()):  # as SciPy reads a struct of MATLAB
            self.add(f"{name}.{part}", getattr(value, part))
        array = np.asarray(value)
        for part in array.dtype.names or ():
            self.add(f"{name}.{part}".strip("."), array[part])
        if array.dtype.kind not in "biuf":
            return
        array = np.squeeze(array).astype(float)
        if array.size == 1:
            self.constants[name] = array.item()
        elif array.ndim == 1:
            self.columns[name] = array
        elif array.ndim == 2 and min(array.shape) <= _MAX_COLUMNS:
            samples = array if array.shape[0] >= array.shape[1] else array.T
            self.columns |= {f"{name}[{k + 1}]": column for k, column in enumerate(samples.T)}


def _read_mat(path: Path) -> ColumnTable:
    from scipy.io import loadmat

    _check_mat(path)
    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:  # MATLAB 7.3 is HDF5
        return _read_hdf5(path)
    found = _Variables()
    for name, value in content.items():
        if not name.startswith("__"):
            found.add(name, value)
    return ColumnTable(path, found.columns, found.constants)


def _read_hdf5(path: Path) -> ColumnTable:
    """Datasets by their path, `log/q` as `log.q`, in files of MATLAB 7.3 too."""
    h5py = needed("h5py", f"{path}: reading HDF5 (MATLAB 7.3)", "tables")
    found, sizes = _Variables(), list[int]()

    def take(name: str, item: Any) -> None:
        kind = item.attrs.get("MATLAB_class", b"double")
        if isinstance(item, h5py.Dataset) and item.shape and not name.startswith("#") and kind != b"char":
            sizes.append(item.size)
            _check_values(path, sum(sizes))
            # MATLAB stores its matrices column by column, so they come transposed
            found.add(name.replace("/", "."), item[()].T if "MATLAB_class" in item.attrs else item[()])

    with h5py.File(path, "r") as file:
        file.visititems(take)
    return ColumnTable(path, found.columns, found.constants)


def _read_numpy(path: Path) -> ColumnTable:
    """Arrays by name; of a single array, the columns by number, or by the names of its fields."""
    _check_unzipped(path)
    found, content = _Variables(), np.load(path, allow_pickle=False)
    if isinstance(content, np.ndarray):
        found.add("" if content.dtype.names else "column", content)
        # as in a text file without names
        columns = {name.replace("column[", "column ").rstrip("]"): values for name, values in found.columns.items()}
        return ColumnTable(path, columns, found.constants)
    for name in content.files:
        found.add(name, content[name])
    return ColumnTable(path, found.columns, found.constants)


def _read_workbook(path: Path) -> ColumnTable:
    """The sheet with the most rows."""
    openpyxl = needed("openpyxl", f"{path}: reading Excel", "tables")
    _check_unzipped(path)
    book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    sheets = [[[_text(value) for value in row] for row in sheet.values] for sheet in book.worksheets]
    book.close()
    return table_of_rows(path, [Row(row) for row in max(sheets, key=len, default=[]) if any(row)])


def _text(value: Any) -> str:
    """A cell as a CSV file would have it."""
    if value is None:
        return ""
    return value.isoformat() if hasattr(value, "isoformat") else str(value).strip()


def _read_parquet(path: Path) -> ColumnTable:
    needed("pyarrow", f"{path}: reading Parquet", "tables")
    from pyarrow import parquet, types

    def numbers(kind: Any) -> bool:
        """Whether numbers or times may be in it; texts are never read."""
        while types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
            kind = kind.value_type
        return any(numbers(part.type) for part in kind) if types.is_struct(kind) else types.is_primitive(kind)

    with parquet.ParquetFile(path) as file:
        names = [column.name for column in file.schema_arrow if numbers(column.type)]
        groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
        parts = [(group.column(k), group.num_rows) for group in groups for k in range(group.num_columns)]
        sizes = [max(part.num_values, rows) for part, rows in parts if part.path_in_schema.split(".")[0] in names]
        _check_values(path, sum(sizes))
        content = file.read(names).flatten()  # fields of structs become columns
    found = _Variables()
    for name in content.column_names:
        values = content.column(name).to_numpy(zero_copy_only=False)
        if values.dtype.kind == "O" and len({np.shape(value) for value in values}) == 1 and np.ndim(values[0]) == 1:
            values = np.stack(values)
        if values.dtype.kind == "M":
            values = values.astype("datetime64[ns]").astype(np.int64) / 1e9
        found.add(name, values)
    return ColumnTable(path, found.columns, found.constants)


#: Kind of a file, and what reads it, by its ending.
_READERS: dict[str, tuple[str, Callable[[Path], ColumnTable]]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".log"), ("text", read_text)),
    ".mat": ("MAT", _read_mat),
    **dict.fromkeys((".h5", ".hdf5"), ("HDF5", _read_hdf5)),
    **dict.fromkeys((".npy", ".npz"), ("NumPy", _read_numpy)),
    ".xlsx": (".xlsx", _read_workbook),
    ".parquet": ("Parquet", _read_parquet),
}
