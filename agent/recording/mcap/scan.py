"""What an MCAP file holds of joint states, whoever wrote it and however it ends.

Records are walked one after the other, without the index, so a file without one or cut off at any byte gives what it
has. Messages are only located on the way; those of one topic and length are decoded together.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from agent.core import InputError
from agent.recording.mcap.bag import (
    MOST_TIMES,
    ROS1,
    SQLITE,
    ZSTD,
    CutOffError,
    bag_files,
    database_records,
    ros1_records,
    too_much,
    unpacked,
)
from agent.recording.mcap.joint_state import JointStateLayout, from_ros1, parse_layout
from agent.recording.scratch import Scratch

_MAGIC = b"\x89MCAP0\r\n"
_LFS, _LFS_SIZE = b"version https://git-lfs", 32
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE_HEAD = 22
#: Located messages are decoded together once they take this much [bytes].
_BATCH = 2**20
#: Layouts of messages that one file may have; beyond, messages are not joint states of one robot.
_MAX_LAYOUTS = 1000
#: Limits of a chunk before compression, and of a message [bytes].
MOST_UNPACKED, _MOST_MESSAGE = 64 * 2**20, 2**20
#: More than this in all [bytes] only where the file is large itself: a log shrinks to a thirtieth at the most.
_MOST_OF_SMALL, _OF_LARGE = 2**30, 30
_TYPES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")


@dataclass(frozen=True, eq=False)
class Messages:
    """K messages of one topic and layout: place in the file (K,), header stamps (K,) [ns], position, velocity and
    effort (K, n) or None."""

    layout: JointStateLayout
    order: np.ndarray
    stamp: np.ndarray
    position: np.ndarray | None
    velocity: np.ndarray | None
    effort: np.ndarray | None


@dataclass(eq=False)
class Scan:
    """What was found. topics: decoded messages by topic; types: message type and encoding of every topic.

    closed: the writer finished the file; dropped: bytes that could not be read at its end; damaged: chunks left out,
    each with the number of the chunk; unreadable: messages by topic that are no joint states; sha256: of the whole
    file; scratch: where the numbers of a long log are.
    """

    scratch: Scratch = field(default_factory=Scratch)
    topics: dict[str, list[Messages]] = field(default_factory=lambda: defaultdict(list))
    types: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    closed: bool = False
    dropped: int = 0
    damaged: list[int] = field(default_factory=list)
    unreadable: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    sha256: str = ""


def scan(path: Path) -> Scan:
    """Read all joint states of a file, or of a bag of ROS: its folder, its `.db3` file, or a ROS 1 bag.

    Raises:
        InputError: no such file, neither an MCAP file nor a bag, or a compression that nobody here knows.
    """
    try:
        scanner, digest = _Scanner(path), hashlib.sha256()
        for part in bag_files(path) if path.is_dir() else [path]:
            with unpacked(part) as (content, name):
                magic = content.read(len(SQLITE))
                content.seek(0)
                if magic == SQLITE:
                    found = scanner.run_records(database_records(part, name, _TYPES))
                elif magic.startswith(ROS1):
                    found = scanner.run_records(ros1_records(part, name))
                else:
                    found = scanner.run(content, os.fstat(content.fileno()).st_size)
            with open(part, "rb") as file:
                while block := file.read(_BATCH):
                    digest.update(block)
        found.sha256 = digest.hexdigest()
        return found
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


class _Scanner:
    def __init__(self, path: Path):
        self._path = path
        self._found = Scan()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, str | None] = {}
        self._ros1: dict[int, bool] = {}
        self._layouts: dict[tuple[int, int], list[JointStateLayout]] = defaultdict(list)
        self._layout_count = 0
        self._parts: list[bytes] = []
        self._located: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._size = 0
        self._before = 0
        self._file_size = self._unpacked = 0

    def run(self, file: IO[bytes], size: int) -> Scan:
        magic = file.read(len(_MAGIC))
        if magic != _MAGIC:
            what = "not an MCAP file" if size else "the file is empty"
            if (magic + file.read(_LFS_SIZE)).startswith(_LFS):
                raise InputError(f"{self._path}: a pointer of Git LFS, not the file itself: git lfs pull")
            raise InputError(
                f"{self._path}: {what}; a log is an MCAP file or a bag of ROS, with sensor_msgs/msg/JointState messages"
            )
        self._file_size += size
        chunks = 0
        for opcode, body, whole in self._records(file, size):
            if opcode == Opcode.CHUNK:
                chunks += 1
                self._take_chunk(body, whole, chunks)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE) and whole:
                self._take(_RECORD.pack(opcode, len(body)) + body)
            elif opcode == Opcode.METADATA and whole:
                self._take_metadata(body)
        return self._end()

    def run_records(self, records: Iterator[bytes]) -> Scan:
        """The same from records at hand."""
        self._found.closed = True
        try:
            for record in records:
                self._take(record)
        except CutOffError as error:
            self._found.closed, self._found.dropped = False, error.missing
        return self._end()

    def _end(self) -> Scan:
        """Of a file; the next one of a bag numbers its channels anew."""
        self._decode()
        self._schemas.clear()
        self._channels.clear()
        return self._found

    def _records(self, file: IO[bytes], size: int) -> Iterator[tuple[int, bytes, bool]]:
        """Records of the data section: opcode, content, and whether the content is whole."""
        while True:
            at = file.tell()
            head = file.read(_RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                self._found.closed = True
                return
            if opcode == 0 or length > size - file.tell():
                self._found.dropped = size - at
                if opcode == Opcode.CHUNK:
                    yield opcode, file.read(), False
                return
            yield opcode, file.read(length), True

    def _take_chunk(self, body: bytes, whole: bool, number: int) -> None:
        try:
            _, _, size, crc, name_length = _CHUNK.unpack_from(body)
            start = _CHUNK.size + name_length
            compression = body[_CHUNK.size : start].decode()
            if compression:
                self._check_size(size)
            data = _unpack(compression, body[start + 8 :], size)
        except (struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
            self._found.damaged.append(number)
            return
        if data is None:
            raise InputError(
                f"{self._path}: compressed with {compression!r}; zstd, lz4 and none can be read: convert the file"
            )
        if compression and len(data) > size:
            self._found.damaged.append(number)  # it holds more than it declares
            return
        if whole and crc and zlib.crc32(data) != crc:
            self._found.damaged.append(number)
            return
        if not self._take(data) and whole:
            self._found.damaged.append(number)

    def _check_size(self, size: int) -> None:
        """Refuse what would fill memory or disk: a chunk may declare anything."""
        self._unpacked += size
        if size > MOST_UNPACKED:
            raise InputError(
                f"{self._path}: a chunk of {size / 2**20:.0f} MiB before compression; at most {MOST_UNPACKED >> 20} "
                "MiB can be read: write the file anew with smaller chunks"
            )
        most = min(max(MOST_UNPACKED, MOST_TIMES * self._file_size), max(_MOST_OF_SMALL, _OF_LARGE * self._file_size))
        if self._unpacked > most:
            raise InputError(too_much(self._path, most))

    def _take_metadata(self, body: bytes) -> None:
        try:
            record = Metadata.read(_stream(body))
        except (struct.error, UnicodeDecodeError, EndOfFile):
            return
        texts = {_printable(key): _printable(value) for key, value in record.metadata.items()}
        self._found.metadata[record.name] = texts

    def _take(self, records: bytes) -> bool:
        """Locate the messages among schemas and channels, as they stand in a chunk or in the file.

        Returns whether the last record is whole.
        """
        located, base = self._located, self._size
        unpack, at, end = _RECORD.unpack_from, 0, len(records)
        while at + 9 <= end:
            opcode, length = unpack(records, at)
            if at + 9 + length > end:
                break
            if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD:
                located[records[at + 9] | records[at + 10] << 8, length].append(base + at + 9)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, records[at + 9 : at + 9 + length])
            at += 9 + length
        self._parts.append(records)
        self._size += end
        if self._size >= _BATCH:
            self._decode()
        return at == end

    def _define(self, opcode: int, body: bytes) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self._schemas[schema.id] = schema
                return
            channel = Channel.read(_stream(body))
        except (struct.error, UnicodeDecodeError, EndOfFile):
            return
        schema = self._schemas.get(channel.schema_id)
        kind = schema.name if schema else "no type"
        self._found.types[channel.topic] = f"{kind} ({channel.message_encoding})"
        readable = kind in _TYPES and channel.message_encoding in ("cdr", "ros1")
        self._ros1[channel.id] = channel.message_encoding == "ros1"
        self._channels[channel.id] = channel.topic if readable else None

    def _decode(self) -> None:
        data = np.frombuffer(b"".join(self._parts), np.uint8)
        for (channel, length), places in self._located.items():
            topic = self._channels.get(channel)
            if topic is not None:
                starts = np.array(places)
                records = np.lib.stride_tricks.sliding_window_view(data, length)[starts]
                order = starts + self._before
                packed = np.all(records[:, _MESSAGE_HEAD:][:, : len(ZSTD)] == np.frombuffer(ZSTD, np.uint8), axis=1)
                packed |= self._ros1[channel]
                if packed.any():
                    self._decode_packed(topic, channel, records[packed], order[packed])
                self._decode_alike(topic, channel, records[~packed], order[~packed])
        self._before += self._size
        self._located.clear()
        self._parts, self._size = [], 0

    def _decode_packed(self, topic: str, channel: int, records: np.ndarray, order: np.ndarray) -> None:
        """Decode messages that are compressed one by one, or of ROS 1, by their length in CDR."""
        by_length: dict[int, list[tuple[int, bytes]]] = defaultdict(list)
        for place, record in zip(order.tolist(), records, strict=True):
            head, message = record[:_MESSAGE_HEAD].tobytes(), record[_MESSAGE_HEAD:].tobytes()
            try:
                if message.startswith(ZSTD):
                    message = _unpack("zstd", message, _MOST_MESSAGE) or b""
                if self._ros1[channel]:
                    message = from_ros1(message)
            except (zstandard.ZstdError, ValueError):
                message = b""
            if len(message) > _MOST_MESSAGE:
                message = b""
            by_length[len(message)].append((place, head + message))
        for alike in by_length.values():
            places, messages = zip(*alike, strict=True)
            whole = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
            self._decode_alike(topic, channel, whole, np.array(places))

    def _decode_alike(self, topic: str, channel: int, records: np.ndarray, order: np.ndarray) -> None:
        """Decode messages of one channel and length, layout by layout."""
        layouts = self._layouts[channel, records.shape[1]]
        known = 0
        while len(records):
            if known == len(layouts):
                layout = self._next_layout(records[0, _MESSAGE_HEAD:].tobytes())
                if layout is None:
                    self._found.unreadable[topic] += 1
                    records, order = records[1:], order[1:]
                    continue
                layouts.append(layout)
            layout = layouts[known]
            known += 1
            alike = layout.matches(records[:, _MESSAGE_HEAD:])
            if not alike.any():
                continue
            rows, places = (records, order) if alike.all() else (records[alike], order[alike])
            messages = rows[:, _MESSAGE_HEAD:]
            self._found.topics[topic].append(
                Messages(
                    layout=layout,
                    order=places,
                    stamp=layout.stamps(messages),
                    position=self._array(layout, messages, 0),
                    velocity=self._array(layout, messages, 1),
                    effort=self._array(layout, messages, 2),
                )
            )
            records, order = records[~alike], order[~alike]

    def _array(self, layout: JointStateLayout, messages: np.ndarray, index: int) -> np.ndarray | None:
        values = layout.array(messages, index)
        return None if values is None else self._found.scratch.keep(values)

    def _next_layout(self, message: bytes) -> JointStateLayout | None:
        if self._layout_count == _MAX_LAYOUTS:
            return None
        try:
            layout = parse_layout(message)
        except ValueError:
            return None
        self._layout_count += 1
        return layout


def _unpack(compression: str, data: bytes, size: int) -> bytes | None:
    """The records of a chunk, as far as its data goes and a byte beyond its declared size; None for an unknown
    compression."""
    if compression == "":
        return data
    if compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=MOST_UNPACKED).stream_reader(data) as stream:
            return stream.read(size + 1)
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    return None


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _printable(text: str) -> str:
    """Without what would act on a terminal."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)
