"""Bags of ROS: a folder with its `metadata.yaml`, sqlite3 files, ROS 1 bags, and files that are compressed as a whole.

A row of the table `messages` is a CDR message of a row of `topics`, as a message of an MCAP file is one of its channel
(rosbag2_storage_default_plugins, sqlite_storage.cpp), and one reader decodes both.
"""

from __future__ import annotations

import gzip
import re
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any, Protocol
from urllib.parse import quote

import lz4.frame
import zstandard

from agent.core import InputError, needed, open_regular, read_yaml

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


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, in the order of recording.

    A recorder that was killed leaves no `metadata.yaml`: then files named NAME_0.mcap, NAME_1.mcap, … are the bag.

    Raises:
        InputError: no bag, or one whose files are missing.
    """
    path = folder / METADATA
    if not path.is_file():
        numbered = [(file, match) for file in folder.iterdir() if (match := _NUMBERED.fullmatch(file.name))]
        if numbered and len({match[1] for _, match in numbered}) == 1:
            return [file for file, _ in sorted(numbered, key=lambda entry: int(entry[1][2]))]
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
        present = [
            candidate
            for candidate in (file, file.with_name(f"{file.name}.zstd"), file.with_suffix(""))
            if candidate.is_file()
        ]
        if not present:
            raise InputError(f"{file}: is missing, although {path} names it")
        files.append(present[0])
    return files


def too_much(path: Path, most: int) -> str:
    """The text about a file that unpacks to more than the `most` bytes that are allowed."""
    times = most / max(path.stat().st_size, 1)
    return (
        f"{path}: unpacks to more than {times:.0f} times its size ({most >> 20} MiB), as no recording of a motion does"
    )


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[IO[bytes], str]]:
    """A file and the path of what is in it: a temporary file where it is compressed as a whole (zstd, gzip, lz4).

    Raises:
        InputError: it is no regular file, or unpacks to more than any recording does.
    """
    with open_regular(path) as file:
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


class _BagTaker(Protocol):
    """Who takes the topics and messages of a bag; numbers are those of the bag."""

    def channel(self, number: int, topic: str, kind: str, encoding: str, definition: str = "") -> bool: ...
    def message(self, channel: int, data: bytes, received: int = 0) -> None: ...


def read_database(path: Path, file: str, messages: _BagTaker) -> int:
    """Take the topics of a sqlite3 bag and the messages of those that are read; `path` is named in errors.

    Returns:
        Bytes that are missing at its end, where it is cut off after messages that can be read.

    Raises:
        InputError: no sqlite3 file, or none of a bag.
    """
    count = 0
    try:
        with closing(sqlite3.connect(f"file:{quote(str(Path(file).resolve()))}?mode=ro", uri=True)) as connection:
            connection.execute("PRAGMA writable_schema=ON")  # else a file that is cut off is not opened at all
            topics = connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            definitions = _definitions(connection)
            wanted = [
                number
                for number, topic, kind, encoding in topics
                if messages.channel(number, str(topic), str(kind), str(encoding), definitions.get(str(kind), ""))
            ]
            marks = ",".join("?" * len(wanted))
            # in the order of the file, in which they were recorded: a sort would need all of it
            for number, data, received in connection.execute(
                f"SELECT topic_id, data, timestamp FROM messages WHERE topic_id IN ({marks})", wanted
            ):
                messages.message(number, bytes(data), max(int(received), 0))
                count += 1
    except (sqlite3.Error, TypeError, UnicodeError) as error:
        if count == 0:
            raise InputError(f"{path}: no sqlite3 bag of ROS 2, or a damaged one: {error}") from None
        return _missing(file)
    return 0


def _definitions(connection: sqlite3.Connection) -> dict[str, str]:
    """Definitions of the message types that a sqlite3 bag holds, since ROS 2 Iron; empty where it has none."""
    try:
        rows = connection.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        return {str(kind): str(text) for kind, encoding, text in rows if encoding == "ros2msg"}
    except sqlite3.Error:
        return {}


def read_ros1(path: Path, file: str, messages: _BagTaker) -> int:
    """Take the topics of a ROS 1 bag and the messages of those that are read; `path` is named in errors.

    Returns:
        0: a bag that is cut off cannot be read.

    Raises:
        InputError: the library is not installed, or the bag was not closed or is damaged.
    """
    convert = f"rosbags-convert --src {path.name} --dst {path.stem}"
    what = f"{path}: is a ROS 1 bag: convert it with {convert}; reading it here"
    bags = needed("rosbags.rosbag1", what, "ros1")
    try:
        with bags.Reader(file) as reader:
            wanted = [
                connection
                for connection in reader.connections
                if messages.channel(connection.id, connection.topic, connection.msgtype, "ros1", connection.msgdef.data)
            ]
            for connection, received, raw in reader.messages(wanted) if wanted else ():
                messages.message(connection.id, bytes(raw), max(int(received), 0))
    except InputError:
        raise
    except Exception as error:  # rosbags raises whatever a damaged file leads it to
        raise InputError(
            f"{path}: a ROS 1 bag that was not closed by its recorder, or a damaged one ({error}): rosbag reindex "
            f"{path.name}"
        ) from None
    return 0


def _missing(file: str) -> int:
    """Bytes by which a sqlite3 file is shorter than its header says."""
    with open(file, "rb") as database:
        head = database.read(32)
        size = database.seek(0, 2)
    page = int.from_bytes(head[16:18], "big")
    return max(0, (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big") - size)
