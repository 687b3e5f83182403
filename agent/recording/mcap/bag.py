"""Bags of ROS: a folder with its `metadata.yaml`, sqlite3 files, ROS 1 bags, and files that are compressed as a whole.

A row of the table `messages` is a CDR message of a row of `topics`, as a message of an MCAP file is one of its channel
(rosbag2_storage_default_plugins, sqlite_storage.cpp). So rows become records of an MCAP file, and one reader decodes
both.
"""

from __future__ import annotations

import gzip
import re
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any
from urllib.parse import quote

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from agent.core import InputError, needed, read_yaml

METADATA = "metadata.yaml"
#: First bytes of a sqlite3 file, of a ROS 1 bag, and of whatever zstd has compressed.
SQLITE, ROS1, ZSTD = b"SQLite format 3\0", b"#ROSBAG V", b"\x28\xb5\x2f\xfd"
#: Limit of the unpacked size, in times the size of the file: logs shrink to a tenth.
MOST_TIMES = 500
_COMPRESSED: dict[bytes, Callable[[IO[bytes]], Any]] = {
    ZSTD: lambda file: zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(file, read_across_frames=True),
    b"\x1f\x8b": lambda file: gzip.GzipFile(fileobj=file),
    b"\x04\x22\x4d\x18": lz4.frame.LZ4FrameFile,
}
_BLOCK = 2**20
_NUMBERED = re.compile(r"(.+)_(\d+)\.(?:mcap|db3)(?:\.\w+)?")
_JOINT_STATE = "sensor_msgs/msg/JointState"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")


class CutOffError(Exception):
    """A file ends before its content does; `missing` bytes."""

    def __init__(self, missing: int):
        super().__init__(f"{missing} bytes missing")
        self.missing = missing


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, in the order of recording.

    A recorder that was killed leaves no `metadata.yaml`: then files named NAME_0.mcap, NAME_1.mcap, … are the bag.

    Raises:
        InputError: no bag, or one whose files are missing.
    """
    path = folder / METADATA
    if not path.is_file():
        numbered = [(file, found) for file in folder.iterdir() if (found := _NUMBERED.fullmatch(file.name))]
        if numbered and len({found[1] for _, found in numbered}) == 1:
            return [file for file, _ in sorted(numbered, key=lambda one: int(one[1][2]))]
        raise InputError(f"{folder}: is a folder without {METADATA}, so no bag of ROS 2; name the log files themselves")
    content = read_yaml(path)
    about = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    names = about.get("relative_file_paths") if isinstance(about, dict) else None
    if not isinstance(names, list) or not names:
        raise InputError(f"{path}: names no files of the bag (relative_file_paths)")
    files = []
    for name in names:
        file = folder / Path(str(name)).name  # older bags name them with their folder
        # some recorders name files as they were before compression, some people unpack them
        there = [one for one in (file, file.with_name(f"{file.name}.zstd"), file.with_suffix("")) if one.is_file()]
        if not there:
            raise InputError(f"{file}: is missing, although {path} names it")
        files.append(there[0])
    return files


def too_much(path: Path, most: int) -> str:
    """What to say of a file that unpacks to more than the `most` bytes that are allowed."""
    times = most / max(path.stat().st_size, 1)
    return (
        f"{path}: unpacks to more than {times:.0f} times its size ({most >> 20} MiB), as no recording of a motion does"
    )


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[IO[bytes], str]]:
    """A file and the path of what is in it: a temporary file where it is compressed as a whole (zstd, gzip, lz4).

    Raises:
        InputError: it unpacks to more than any recording does.
    """
    with open(path, "rb") as file:
        start = file.read(len(ZSTD))
        file.seek(0)
        opener = next((opener for magic, opener in _COMPRESSED.items() if start.startswith(magic)), None)
        if opener is None:
            yield file, str(path)
            return
        with NamedTemporaryFile() as plain:
            most = max(MOST_TIMES * path.stat().st_size, _BLOCK)
            try:
                with opener(file) as stream:
                    while block := stream.read(_BLOCK):
                        plain.write(block)
                        if plain.tell() > most:
                            raise InputError(too_much(path, most))
            except (EOFError, zstandard.ZstdError, gzip.BadGzipFile, RuntimeError):
                pass  # cut off: what is in it is read as far as it goes
            plain.flush()
            plain.seek(0)
            yield plain, plain.name


def database_records(path: Path, file: str, types: tuple[str, ...]) -> Iterator[bytes]:
    """The topics of a sqlite3 bag and the messages of those types, as MCAP records; `path` is named in messages.

    Raises:
        InputError: no sqlite3 file, or none of a bag.
        CutOffError: after the messages that can be read, where the file is cut off.
    """
    count = 0
    try:
        connection = sqlite3.connect(f"file:{quote(str(Path(file).resolve()))}?mode=ro", uri=True)
        try:
            connection.execute("PRAGMA writable_schema=ON")  # else a file that is cut off is not opened at all
            topics = connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            for number, name, kind, encoding in topics:
                yield from _channel(number, name, kind, encoding)
            wanted = [number for number, _, kind, _ in topics if kind in types]
            marks = ",".join("?" * len(wanted))
            # in the order of the file, in which they were recorded: a sort would need all of it
            rows = connection.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})", wanted
            )
            for number, stamp, data in rows:
                yield _record(Opcode.MESSAGE, _MESSAGE.pack(number, 0, stamp, stamp) + data)
                count += 1
        finally:
            connection.close()
    except (sqlite3.Error, struct.error, TypeError, AttributeError, UnicodeError) as error:
        if count:
            raise CutOffError(_missing(file)) from None
        raise InputError(f"{path}: no sqlite3 bag of ROS 2, or a damaged one: {error}") from None


def ros1_records(path: Path, file: str) -> Iterator[bytes]:
    """The topics of a ROS 1 bag and its joint states, as MCAP records; `path` is named in messages.

    Raises:
        InputError: the library is not installed, or the bag was not closed or is damaged.
    """
    convert = f"rosbags-convert --src {path.name} --dst {path.stem}"
    what = f"{path}: is a ROS 1 bag: convert it with {convert}; reading it here"
    bags = needed("rosbags.rosbag1", what, "ros1")
    try:
        with bags.Reader(file) as reader:
            for connection in reader.connections:
                yield from _channel(connection.id, connection.topic, connection.msgtype, "ros1")
            wanted = [one for one in reader.connections if one.msgtype == _JOINT_STATE]
            for connection, stamp, raw in reader.messages(wanted) if wanted else ():
                yield _record(Opcode.MESSAGE, _MESSAGE.pack(connection.id, 0, stamp, stamp) + raw)
    except InputError:
        raise
    except Exception as error:  # rosbags raises whatever a damaged file leads it to
        raise InputError(
            f"{path}: a ROS 1 bag that was not closed by its recorder, or a damaged one ({error}): rosbag reindex "
            f"{path.name}"
        ) from None


def _missing(file: str) -> int:
    """Bytes by which a sqlite3 file is shorter than its header says."""
    with open(file, "rb") as database:
        head = database.read(32)
        size = database.seek(0, 2)
    page = int.from_bytes(head[16:18], "big")
    return max(0, (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big") - size)


def _channel(number: int, name: str, kind: str, encoding: str) -> Iterator[bytes]:
    yield _record(Opcode.SCHEMA, struct.pack("<H", number) + _texts(kind, "ros2msg", ""))
    yield _record(Opcode.CHANNEL, struct.pack("<HH", number, number) + _texts(name, encoding, ""))


def _record(opcode: Opcode, body: bytes) -> bytes:
    return _RECORD.pack(opcode, len(body)) + body


def _texts(*texts: str) -> bytes:
    return b"".join(struct.pack("<I", len(text.encode())) + text.encode() for text in texts)
