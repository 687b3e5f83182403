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

from agent.core import InputError, needed, open_regular
from agent.recording.tables.text_rows import CELL, MOST_CELLS, Row, check_size
from agent.recording.tables.text_tables import ColumnTable, read_text, table_of_rows

#: Columns that one matrix of a MAT file may hold; a wider one is no table of samples.
_MAX_COLUMNS = 256
_MAT_HEADER, _MAT_TAG, _MAT_COMPRESSED = 128, 8, 15  # bytes, bytes, data type
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PIECE = 2**20  # bytes
#: From this mark of MATLAB 7.3 on, a variable is an object of a class.
_OBJECT = 2


def read_table(path: Path) -> ColumnTable:
    """Read a file by its ending.

    Raises:
        InputError: no such file, another ending, or nothing in it that can be read.
    """
    ending = path.suffix.lower()
    if ending not in _READERS:
        raise InputError(f"{path}: tables end in {', '.join(_READERS)}; this one ends in {path.suffix or 'nothing'}")
    kind, reader = _READERS[ending]
    try:
        open_regular(path).close()
        table = reader(path)
    except InputError:
        raise
    except (MemoryError, RecursionError):
        raise InputError(f"{path}: takes more memory, or is nested deeper, than a table of samples") from None
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        if error.strerror:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
        raise InputError(f"{path}: not a readable {kind} file: {error}") from None
    except Exception as error:  # libraries raise whatever a damaged file leads them to
        advice = "; save plain arrays, not objects: np.savez(file, t=t, q=q)" if "pickle" in str(error) else ""
        advice += "; in MATLAB or Octave, save it with: save -v7 FILE.mat" if kind == "MAT" else ""
        raise InputError(f"{path}: not a readable {kind} file: {error}{advice}") from None
    if not any(len(column) for column in table.columns.values()):
        raise InputError(f"{path}: no columns of numbers in it")
    return table


def _check_unzipped(path: Path) -> None:
    """Check what a zipped table (.npz, .xlsx) says it unpacks to; any other file takes no more than its own size."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            check_size(path, sum(entry.file_size for entry in file.infolist()) // 8)


def _check_cells(path: Path) -> None:
    """Look for a text in a workbook that is longer than any cell of Excel (32 767 characters) can be."""
    with zipfile.ZipFile(path) as file:
        for entry in file.infolist():
            with file.open(entry) as part:
                while len(piece := part.read(_PIECE)) == _PIECE:
                    if b"<" not in piece:
                        raise InputError(
                            f"{path}: {entry.filename} holds a text of {_PIECE >> 20} MiB or more, and cells of Excel "
                            "hold 32 767 characters: this is no table of samples; export one"
                        )


def _check_mat(path: Path) -> None:
    """Unpack every compressed variable (versions 5 to 7) in pieces, and keep none; a damaged file is left to SciPy."""
    unpacked = 0
    with open_regular(path) as file:
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
                    check_size(path, unpacked // 8)
                    data = unpack.unconsumed_tail
            file.seek(end)


class _Variables:
    """Columns, constants and MATLAB objects of a file of named arrays."""

    def __init__(self) -> None:
        self.columns: dict[str, np.ndarray] = {}
        self.constants: dict[str, float] = {}
        self.objects: dict[str, str] = {}

    def add(self, name: str, value: Any) -> None:
        """Numbers of a variable: scalars, vectors, matrices (samples along the longer side), fields of structs."""
        for part in getattr(value, "_fieldnames", ()):  # as SciPy reads a struct of MATLAB
            self.add(f"{name}.{part}", getattr(value, part))
        array = np.asarray(value)
        if type(value).__name__ == "MatlabOpaque":  # an object; before SciPy 1.18 its name is a field, not the key
            about = dict(zip(array.dtype.names or (), map(_ascii, array.reshape(-1)[0]), strict=True))
            self.objects[about.get("s0", name)] = about.get("s2") or about.get("_Class", "class")
            return
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

    def table(self, path: Path) -> ColumnTable:
        """All of it."""
        return ColumnTable(path, self.columns, self.constants, objects=self.objects)


def _ascii(text: Any) -> str:
    return text.decode("ascii", errors="replace") if isinstance(text, bytes) else str(text)


def _read_mat(path: Path) -> ColumnTable:
    from scipy.io import loadmat

    with open_regular(path) as file:
        if file.read(len(_HDF5)) == _HDF5:  # of another tool than MATLAB, whose header comes first
            return _read_hdf5(path)
    _check_mat(path)
    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:  # MATLAB 7.3 is HDF5
        return _read_hdf5(path)
    variables = _Variables()
    for name, value in content.items():
        if not name.startswith("__"):
            variables.add(name, value)
    return variables.table(path)


def _read_hdf5(path: Path) -> ColumnTable:
    """Datasets by their path, `log/q` as `log.q`, in files of MATLAB 7.3 too."""
    h5py = needed("h5py", f"{path}: reading HDF5 (MATLAB 7.3)", "tables")
    variables, sizes = _Variables(), list[int]()

    def take(name: str, item: Any) -> None:
        kind = _ascii(item.attrs.get("MATLAB_class", b"double"))
        if item.attrs.get("MATLAB_object_decode", 0) >= _OBJECT:
            variables.objects[name.replace("/", ".")] = kind
        elif isinstance(item, h5py.Dataset) and item.shape and not name.startswith("#") and kind != "char":
            sizes.append(item.size)
            check_size(path, sum(sizes))
            # MATLAB stores its matrices column by column, so they come transposed
            variables.add(name.replace("/", "."), item[()].T if "MATLAB_class" in item.attrs else item[()])

    with h5py.File(path, "r") as file:
        file.visititems(take)
    return variables.table(path)


def _read_numpy(path: Path) -> ColumnTable:
    """Arrays by name; of a single array, the columns by number, or by the names of its fields."""
    _check_unzipped(path)
    variables, content = _Variables(), np.load(path, allow_pickle=False)
    if isinstance(content, np.ndarray):
        variables.add("" if content.dtype.names else "column", content)
        # as in a text file without names
        columns = {name.replace("column[", "column ").rstrip("]"): values for name, values in variables.columns.items()}
        return ColumnTable(path, columns, variables.constants)
    for name in content.files:
        variables.add(name, content[name])
    return variables.table(path)


def _read_workbook(path: Path) -> ColumnTable:
    """The sheet with the most rows. Cells are counted as they come: one cell far off makes a row of 16 384."""
    openpyxl = needed("openpyxl", f"{path}: reading Excel", "tables")
    _check_unzipped(path)
    _check_cells(path)
    book, longest, cells = openpyxl.load_workbook(path, read_only=True, data_only=True), list[Row](), 0
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # what the file says its size is need not be true
        rows = []
        for values in sheet.values:
            if any(value is not None for value in values):
                cells += len(values)
                check_size(path, cells, MOST_CELLS, CELL)
                rows.append(Row([_text(value) for value in values]))
        longest = max(longest, rows, key=len)
    book.close()
    return table_of_rows(path, longest)


def _text(value: Any) -> str:
    """A cell as a CSV file would have it."""
    if value is None:
        return ""
    if hasattr(value, "total_seconds"):  # a duration
        return str(value.total_seconds())
    return value.isoformat() if hasattr(value, "isoformat") else str(value).strip()


def _read_parquet(path: Path) -> ColumnTable:
    needed("pyarrow", f"{path}: reading Parquet", "tables")
    from pyarrow import parquet, types

    def numbers(kind: Any) -> bool:
        """Whether numbers or times may be in it; texts are never read."""
        while types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
            kind = kind.value_type
        if types.is_struct(kind):
            return any(numbers(part.type) for part in kind)
        return types.is_primitive(kind) or types.is_decimal(kind)

    with parquet.ParquetFile(path) as file:
        names = [column.name for column in file.schema_arrow if numbers(column.type)]
        groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
        parts = [(group.column(k), group.num_rows) for group in groups for k in range(group.num_columns)]
        sizes = [max(part.num_values, rows) for part, rows in parts if part.path_in_schema.split(".")[0] in names]
        check_size(path, sum(sizes))
        content = file.read(names).flatten()  # fields of structs become columns
    variables = _Variables()
    for name in content.column_names:
        values = _in_seconds(content.column(name)).to_numpy(zero_copy_only=False)
        if values.dtype.kind == "O" and len({np.shape(value) for value in values}) == 1 and np.ndim(values[0]) == 1:
            values = np.stack(values)
        variables.add(name, values)
    return variables.table(path)


def _in_seconds(column: Any) -> Any:
    """A column of Parquet; dates, times of day and durations as seconds, decimals as floats."""
    from pyarrow import compute, int32, int64, types

    if types.is_decimal(column.type):
        return column.cast("double")
    if not types.is_temporal(column.type) or types.is_interval(column.type):
        return column
    if types.is_date(column.type):
        return compute.multiply(column.cast("date32").cast(int32()).cast("double"), 86400.0)
    whole = column.cast(int32() if types.is_time32(column.type) else int64())
    return compute.divide(
        whole.cast("double", safe=False), {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[column.type.unit]
    )


#: Kind of a file, and what reads it, by its ending.
_READERS: dict[str, tuple[str, Callable[[Path], ColumnTable]]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".log"), ("text", read_text)),
    ".mat": ("MAT", _read_mat),
    **dict.fromkeys((".h5", ".hdf5"), ("HDF5", _read_hdf5)),
    **dict.fromkeys((".npy", ".npz"), ("NumPy", _read_numpy)),
    ".xlsx": (".xlsx", _read_workbook),
    ".parquet": ("Parquet", _read_parquet),
}
#: Endings of tables.
TABLES = tuple(_READERS)
