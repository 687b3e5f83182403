"""Bags of ROS 2: a folder with its `metadata.yaml`, and sqlite3 files, whose rows become records of an MCAP file.

A row of the table `messages` is a CDR message of a row of `topics`, as a message of an MCAP file is one of its channel
(rosbag2_storage_default_plugins, sqlite_storage.cpp). So one reader decodes both.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from mcap.opcode import Opcode

from agent.core import InputError, read_yaml

METADATA = "metadata.yaml"
DATABASE = ".db3"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, in the order of recording.

    Raises:
        InputError: no bag, or one whose files are missing or compressed as a whole.
    """
    path = folder / METADATA
    if not path.is_file():
        raise InputError(f"{folder}: is a folder without {METADATA}, so no bag of ROS 2; name the log files themselves")
    content = read_yaml(path)
    about = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    names = about.get("relative_file_paths") if isinstance(about, dict) else None
    if not isinstance(names, list) or not names:
        raise InputError(f"{path}: names no files of the bag (relative_file_paths)")
    files = [folder / Path(str(name)).name for name in names]  # older bags name them with their folder
    for file in files:
        if file.suffix not in (".mcap", DATABASE):
            raise InputError(f"{file}: neither .mcap nor .db3; unpack it first (ros2 bag convert writes a bag anew)")
        if not file.is_file():
            raise InputError(f"{file}: is missing, although {path} names it")
    return files


def database_records(path: Path, types: tuple[str, ...]) -> Iterator[bytes]:
    """The topics of a sqlite3 bag and the messages of those types, as MCAP records.

    Raises:
        InputError: no sqlite3 file, or none of a bag.
    """
    try:
        connection = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True)
        try:
            topics = connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            for number, name, kind, encoding in topics:
                yield _record(Opcode.SCHEMA, struct.pack("<H", number) + _texts(kind, "ros2msg", ""))
                yield _record(Opcode.CHANNEL, struct.pack("<HH", number, number) + _texts(name, encoding, ""))
            wanted = [number for number, _, kind, _ in topics if kind in types]
            marks = ",".join("?" * len(wanted))
            rows = connection.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp, id",
                wanted,
            )
            for number, stamp, data in rows:
                yield _record(Opcode.MESSAGE, _MESSAGE.pack(number, 0, stamp, stamp) + data)
        finally:
            connection.close()
    except (sqlite3.Error, struct.error, TypeError, AttributeError, UnicodeError) as error:
        raise InputError(f"{path}: no sqlite3 bag of ROS 2, or a damaged one: {error}") from None


def _record(opcode: Opcode, body: bytes) -> bytes:
    return _RECORD.pack(opcode, len(body)) + body


def _texts(*texts: str) -> bytes:
    return b"".join(struct.pack("<I", len(text.encode())) + text.encode() for text in texts)
