"""How much a compressed table would take in memory, found out before it is read: a few megabytes may hold gigabytes."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

from agent.core import InputError

#: Numbers that one table may hold: an hour of 37 columns at 500 Hz, 512 MiB in memory.
MOST_VALUES = 2**26
_MAT_HEADER, _MAT_TAG, _MAT_COMPRESSED = 128, 8, 15
_PIECE = 2**20  # bytes


def check_values(path: Path, values: int) -> None:
    """
    Raises:
        InputError: more numbers than a table may hold.
    """
    if values > MOST_VALUES:
        raise InputError(
            f"{path}: holds more than {MOST_VALUES} numbers ({MOST_VALUES >> 17} MiB in memory), the limit for one "
            "table; split the recording, or leave out columns that are not needed"
        )


def number_columns(path: Path, file: Any) -> list[str]:
    """Columns of a Parquet file that may hold numbers, and times; texts are never read.

    Raises:
        InputError: together they hold more than a table may.
    """
    from pyarrow import types

    def numbers(kind: Any) -> bool:
        if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
            kind = kind.value_type
        if types.is_struct(kind):
            return any(numbers(kind.field(k).type) for k in range(kind.num_fields))
        return any(
            is_one(kind) for is_one in (types.is_integer, types.is_floating, types.is_boolean, types.is_temporal)
        )

    names = [field.name for field in file.schema_arrow if numbers(field.type)]
    values = 0
    for group in (file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)):
        for part in (group.column(k) for k in range(group.num_columns)):
            if part.path_in_schema.split(".")[0] in names:
                values += max(part.num_values, group.num_rows)
    check_values(path, values)
    return names


def check_unzipped(path: Path) -> None:
    """Check what a zipped table (.npz, .xlsx) says it unpacks to; any other file takes no more than its own size.

    Raises:
        InputError: more numbers than a table may hold.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            check_values(path, sum(entry.file_size for entry in file.infolist()) // 8)


def check_mat(path: Path) -> None:
    """Unpack every compressed variable of a MAT file (versions 5 to 7) in pieces, and keep none.

    Raises:
        InputError: together they hold more than a table may. A damaged file is left to its reader.
    """
    unpacked = 0
    with open(path, "rb") as file:
        order = "big" if file.read(_MAT_HEADER)[-2:] == b"MI" else "little"
        while len(tag := file.read(_MAT_TAG)) == _MAT_TAG:
            kind, size = (int.from_bytes(part, order) for part in (tag[:4], tag[4:]))  # type: ignore[arg-type]
            if kind != _MAT_COMPRESSED:
                file.seek(size, 1)
                continue
            unpack, end = zlib.decompressobj(), file.tell() + size
            while file.tell() < end and not unpack.eof:
                data = file.read(min(_PIECE, end - file.tell()))
                while data and not unpack.eof:
                    try:
                        unpacked += len(unpack.decompress(data, _PIECE))
                    except zlib.error:
                        return
                    check_values(path, unpacked // 8)
                    data = unpack.unconsumed_tail
            file.seek(end)
