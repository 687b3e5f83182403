"""Finds the joint states of a recording from any program, complete or cut off.

The records of an MCAP file are walked one after the other, without the index, so a file without one or cut off at any
byte gives what it has. The library's stream reader would lose the chunk that is cut off. Messages are collected on the
way; those of one topic and length are decoded together.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema

from agent.core import InputError, open_regular
from agent.recording.mcap.bag import (
    MOST_TIMES,
    ROS1,
    SQLITE,
    ZSTD,
    bag_files,
    read_database,
    read_ros1,
    too_much,
    unpacked,
)
from agent.recording.mcap.joint_state import JointStateLayout, parse_layout
from agent.recording.mcap.json_messages import holds_commands, joint_values
from agent.recording.mcap.message_forms import (
    NAMELESS,
    FormLayout,
    MessageForm,
    MessageSchema,
    definition_of,
    form_of,
    parse_form,
)
from agent.recording.scratch import Scratch
from agent.recording.tables.table_files import TABLES

_MAGIC = b"\x89MCAP0\r\n"
_LFS, _LFS_SIZE = b"version https://git-lfs", 32
_RECORD = struct.Struct("<BQ")
_MESSAGE, _MESSAGE_HEAD = int(Opcode.MESSAGE), 22
_BLOCK = 2**20  # bytes
#: Collected messages are decoded together once they take this much [bytes].
_BATCH = 2**20
#: Limit of layouts of messages in one file; beyond, messages are not joint states of one robot.
_MAX_LAYOUTS = 1000
#: Limits of a chunk before compression, and of a message [bytes].
MOST_UNPACKED, _MOST_MESSAGE = 64 * 2**20, 2**20
#: More than this in all [bytes] only where the file is large itself: a log shrinks to a thirtieth at the most.
_MOST_OF_SMALL, _OF_LARGE = 2**30, 30
TYPES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
_DAMAGED = (struct.error, UnicodeDecodeError, EndOfFile, zstandard.ZstdError, RuntimeError, EOFError, MemoryError)


@dataclass(frozen=True)
class NamedJoints:
    """The joints of messages without a layout in bytes."""

    names: tuple[str, ...]
    whole: bool = True


@dataclass(frozen=True, eq=False)
class Messages:
    """K messages of one topic and layout: offset in the file (K,), header stamps (K,) [ns], position, velocity and
    effort (K, n) or None; receive times (K,) [ns], and the stamps (K,) [ns] at which set-points were sent."""

    layout: JointStateLayout | FormLayout | NamedJoints
    order: np.ndarray
    stamp: np.ndarray
    position: np.ndarray | None
    velocity: np.ndarray | None
    effort: np.ndarray | None
    received: np.ndarray
    sent: np.ndarray


@dataclass(eq=False)
class Scan:
    """What was found. topics: decoded states by topic; types: message type and encoding of every topic.

    set_points: those in messages of states, by topic; commands: topics of nothing else; others: topics of states that
    are no joint states of ROS; effort_is: meaning of the effort on a topic, where its driver is known.

    closed: the writer finished every file; dropped: bytes that could not be read at its end; damaged: numbers of the
    chunks left out; unreadable: messages by topic that are no joint states; sha256: of the whole file; scratch: where
    the numbers of a long log are; file_size, unpacked_size: of MCAP files and of their chunks [bytes].
    """

    scratch: Scratch = field(default_factory=Scratch)
    topics: dict[str, list[Messages]] = field(default_factory=lambda: defaultdict(list))
    set_points: dict[str, list[Messages]] = field(default_factory=lambda: defaultdict(list))
    commands: dict[str, list[Messages]] = field(default_factory=lambda: defaultdict(list))
    others: set[str] = field(default_factory=set)
    effort_is: dict[str, str] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    closed: bool = True
    dropped: int = 0
    damaged: list[int] = field(default_factory=list)
    unreadable: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    sha256: str = ""
    file_size: int = 0
    unpacked_size: int = 0

    def receive_delay(self, topics: Sequence[str]) -> int:
        """Median time [ns] from the stamps of the states on these topics to their receipt."""
        late = [group.received - group.stamp for topic in topics for group in self.topics[topic]]
        return int(np.median(np.concatenate(late)))


def scan(path: Path) -> Scan:
    """Read all joint states of a file, or of a bag of ROS: its folder, its `.db3` file, or a ROS 1 bag.

    Raises:
        InputError: no such file, neither an MCAP file nor a bag, or a compression that nobody here knows.
    """
    scanned, digest = Scan(), hashlib.sha256()
    messages = _Collector(scanned)
    try:
        for part in bag_files(path) if path.is_dir() else [path]:
            with unpacked(part) as (content, name):
                magic = content.read(len(SQLITE))
                content.seek(0)
                if magic.startswith((SQLITE, ROS1)):
                    read = read_database if magic == SQLITE else read_ros1
                    missing = read(part, name, messages)
                    scanned.closed, scanned.dropped = scanned.closed and not missing, scanned.dropped + missing
                else:
                    _read_mcap(path, content, messages)
            messages.end_file()
            with open_regular(part) as file:
                while block := file.read(_BLOCK):
                    digest.update(block)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    scanned.sha256 = digest.hexdigest()
    return scanned


def _read_mcap(path: Path, file: IO[bytes], messages: _Collector) -> None:
    scanned, size, chunks = messages.scanned, os.fstat(file.fileno()).st_size, 0
    magic = file.read(len(_MAGIC))
    if magic != _MAGIC:
        what = "not an MCAP file" if size else "the file is empty"
        if (magic + file.read(_LFS_SIZE)).startswith(_LFS):
            raise InputError(f"{path}: a pointer of Git LFS, not the file itself: git lfs pull")
        if path.suffix.lower() in TABLES:
            raise InputError(f"{path}: a table. Describe its columns: agent import --map MAP.yaml {path.name} log.mcap")
        raise InputError(
            f"{path}: {what}; a log is an MCAP file or a bag of ROS, with sensor_msgs/msg/JointState messages"
        )
    scanned.file_size += size
    for opcode, body, whole in _records(file, size, scanned):
        chunks += opcode == Opcode.CHUNK
        try:
            if opcode == Opcode.CHUNK:
                data = _chunk_data(path, body, whole, scanned)
                if not _take_records(data, messages) and whole:
                    scanned.damaged.append(chunks)
            elif opcode == Opcode.METADATA:
                record = Metadata.read(_stream(body))
                texts = {_printable(key): _printable(value) for key, value in record.metadata.items()}
                scanned.metadata[record.name] = texts
            elif whole:
                messages.take(opcode, body)
        except _DAMAGED:
            if opcode == Opcode.CHUNK:
                scanned.damaged.append(chunks)


def _records(file: IO[bytes], size: int, scanned: Scan) -> Iterator[tuple[int, bytes, bool]]:
    """Records of the data section: opcode, content, and whether the content is whole; of others only a chunk comes."""
    while True:
        at = file.tell()
        head = file.read(_RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if opcode == 0 or length > size - file.tell():
            scanned.closed, scanned.dropped = False, scanned.dropped + size - at
            if opcode == Opcode.CHUNK:
                yield opcode, file.read(), False
            return
        yield opcode, file.read(length), True


def _check_unpacked(path: Path, scanned: Scan, size: int) -> None:
    """Refuse what would fill memory or disk: a chunk may declare any `size` [bytes].

    Raises:
        InputError: the chunk, or all chunks together, declare more than any recording has.
    """
    scanned.unpacked_size += size
    if size > MOST_UNPACKED:
        raise InputError(
            f"{path}: a chunk of {size / 2**20:.0f} MiB before compression; at most {MOST_UNPACKED >> 20} "
            "MiB can be read: write the file anew with smaller chunks"
        )
    most = min(max(MOST_UNPACKED, MOST_TIMES * scanned.file_size), max(_MOST_OF_SMALL, _OF_LARGE * scanned.file_size))
    if scanned.unpacked_size > most:
        raise InputError(too_much(path, most))


def _chunk_data(path: Path, body: bytes, whole: bool, scanned: Scan) -> bytes:
    """The records of a chunk up to its end; an error of `_DAMAGED` if they differ from its declaration."""
    chunk = Chunk.read(_stream(body))  # of a chunk that is cut off, the data that are there
    if not chunk.compression:
        data = chunk.data
    elif (unpack := _UNPACK.get(chunk.compression)) is None:
        raise InputError(
            f"{path}: compressed with {chunk.compression!r}; zstd, lz4 and none can be read: convert the file"
        )
    else:
        _check_unpacked(path, scanned, chunk.uncompressed_size)
        data = unpack(chunk.data, chunk.uncompressed_size)
        if len(data) > chunk.uncompressed_size:
            raise EndOfFile("it holds more than it declares")
    if whole and chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise EndOfFile("its checksum is another")
    return data


def _take_records(records: bytes, messages: _Collector) -> bool:
    """Take schemas, channels and messages of a chunk. Returns whether the records go on to its end."""
    at, end, unpack = 0, len(records), _RECORD.unpack_from
    while at + _RECORD.size <= end:
        opcode, length = unpack(records, at)
        start, at = at + _RECORD.size, at + _RECORD.size + length
        if at > end or opcode == 0:  # no record has it; zeros would be walked nine bytes at a time
            return False
        if opcode == _MESSAGE and length >= _MESSAGE_HEAD:  # nearly all are, and a call for each counts
            time = int.from_bytes(records[start + 6 : start + 14], "little")
            messages.message(records[start] | records[start + 1] << 8, records[start + _MESSAGE_HEAD : at], time)
        else:
            messages.take(opcode, records[start:at])
    return at == end


@dataclass(frozen=True, eq=False)
class _Channel:
    """What the messages of a number are; those without a form are joint states, or JSON where they have no bytes."""

    topic: str
    ros1: bool | None = None
    form: MessageForm | None = None
    schema: MessageSchema | None = None
    commands: bool = False

    @property
    def in_json(self) -> bool:
        """Whether the messages are texts."""
        return self.ros1 is None


class _Collector:
    """Decodes messages of joints' states and commands."""

    def __init__(self, scanned: Scan):
        self.scanned = scanned
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, _Channel] = {}
        self._layouts: dict[tuple[int, int], list[list[JointStateLayout] | list[FormLayout]]] = defaultdict(list)
        self._layout_count = 0
        self._waiting: dict[tuple[int, int], tuple[list[int], list[int], list[bytes]]] = defaultdict(
            lambda: ([], [], [])
        )
        self._size = 0
        self._position = 0

    def take(self, opcode: int, body: bytes) -> None:
        """A record of an MCAP file; one that cannot be read is ignored."""
        if opcode == _MESSAGE:
            if len(body) >= _MESSAGE_HEAD:
                self.message(body[0] | body[1] << 8, body[_MESSAGE_HEAD:], int.from_bytes(body[6:14], "little"))
        elif opcode == Opcode.SCHEMA:
            with suppress(*_DAMAGED):
                schema = Schema.read(_stream(body))
                text = schema.data.decode() if schema.encoding in ("ros2msg", "ros1msg") else ""
                self._schemas[schema.id] = schema.name, text
        elif opcode == Opcode.CHANNEL:
            with suppress(*_DAMAGED):
                channel = Channel.read(_stream(body))
                kind, text = self._schemas.get(channel.schema_id, ("no type", ""))
                self.channel(channel.id, channel.topic, kind, channel.message_encoding, text)

    def channel(self, number: int, topic: str, kind: str, encoding: str, definition: str = "") -> bool:
        """Messages of this number are of this topic. Returns whether they are read."""
        self.scanned.types[topic] = f"{kind} ({encoding})"
        self._channels.pop(number, None)
        form, text = form_of(kind), definition_of(kind, definition)
        if encoding == "json":
            self._channels[number] = _Channel(topic, commands=holds_commands(topic))
        elif encoding in ("cdr", "ros1") and kind in TYPES:
            self._channels[number] = _Channel(topic, encoding == "ros1")
        elif encoding in ("cdr", "ros1") and form is not None and text:
            with suppress(ValueError):
                schema = MessageSchema(text)
                self._channels[number] = _Channel(topic, encoding == "ros1", form, schema, form.commands)
        channel = self._channels.get(number)
        if channel is not None and (channel.form is not None or encoding == "json") and not channel.commands:
            self.scanned.others.add(topic)
            if channel.form is not None and channel.form.effort_is:
                self.scanned.effort_is[topic] = channel.form.effort_is
        return channel is not None

    def message(self, channel: int, data: bytes, received: int = 0) -> None:
        """A message, which may be compressed by itself, and when it was received [ns]."""
        if channel not in self._channels:
            return
        if data.startswith(ZSTD):
            data = _message_data(data)
        places, times, waiting = self._waiting[channel, len(data)]
        places.append(self._position)
        times.append(received)
        waiting.append(data)
        self._position += 1
        self._size += len(data)
        if self._size >= _BATCH:
            self.decode()

    def end_file(self) -> None:
        """Decode the remaining messages; the next file of a bag numbers its channels again."""
        self.decode()
        for numbered in (self._schemas, self._channels, self._layouts):
            numbered.clear()

    def decode(self) -> None:
        """Decode what was collected, messages of one channel and length together."""
        for (number, length), (places, times, waiting) in self._waiting.items():
            channel, order = self._channels[number], np.array(places)
            received = np.array(times, np.uint64).astype(np.int64)
            if channel.in_json:
                self._decode_json(channel, waiting, order, received)
                continue
            messages = np.frombuffer(b"".join(waiting), np.uint8).reshape(len(waiting), length)
            self._decode_alike(number, messages, order, received)
        self._waiting.clear()
        self._size = 0

    def _decode_alike(self, number: int, messages: np.ndarray, order: np.ndarray, received: np.ndarray) -> None:
        channel = self._channels[number]
        known, tried = self._layouts[number, messages.shape[1]], 0
        while len(messages):
            if tried == len(known):
                layouts = self._next_layouts(messages[0].tobytes(), channel)
                if layouts is None:
                    self.scanned.unreadable[channel.topic] += 1
                    messages, order, received = messages[1:], order[1:], received[1:]
                    continue
                known.append(layouts)
            layouts = known[tried]
            tried += 1
            alike = layouts[0].matches(messages) if layouts else np.all(messages == messages[0], axis=1)
            if alike.any():
                rows = messages if alike.all() else messages[alike]
                for layout in layouts:
                    self._take(channel, layout, rows, order[alike], received[alike])
                messages, order, received = messages[~alike], order[~alike], received[~alike]

    def _take(
        self,
        channel: _Channel,
        layout: JointStateLayout | FormLayout,
        rows: np.ndarray,
        order: np.ndarray,
        received: np.ndarray,
    ) -> None:
        """Messages (K, L) of one layout as numbers."""
        keep, scanned = self.scanned.scratch.keep, self.scanned
        arrays = map(partial(layout.array, rows), range(3))
        position, velocity, effort = (None if values is None else keep(values) for values in arrays)
        if isinstance(layout, JointStateLayout):
            stamp = sent = layout.stamps(rows)
        else:
            stamp, sent = layout.stamps(rows, received)
        topics = scanned.commands if channel.commands else scanned.topics
        topics[channel.topic].append(Messages(layout, order, stamp, position, velocity, effort, received, sent))
        if isinstance(layout, FormLayout) and (points := layout.array(rows, 3)) is not None:
            messages = Messages(layout, order, stamp, keep(points), None, None, received, sent)
            scanned.set_points[channel.topic].append(messages)

    def _decode_json(self, channel: _Channel, messages: list[bytes], order: np.ndarray, received: np.ndarray) -> None:
        alike: dict[tuple[tuple[str, ...], tuple[str, ...], int], list[tuple[int, dict[str, list[float]]]]] = {}
        for k, data in enumerate(messages):
            try:
                names, values = joint_values(data)
            except ValueError:
                self.scanned.unreadable[channel.topic] += 1
                continue
            alike.setdefault((names, tuple(values), len(values["position"])), []).append((k, values))
        topics = self.scanned.commands if channel.commands else self.scanned.topics
        for (names, _, count), decoded in alike.items():
            called = names or tuple(f"{NAMELESS}{k + 1}" for k in range(count))
            rows = [k for k, _ in decoded]
            position, velocity, effort = (
                np.array([values[name] for _, values in decoded]) if name in decoded[0][1] else None
                for name in ("position", "velocity", "effort")
            )
            layout, times = NamedJoints(called), received[rows]
            topics[channel.topic].append(Messages(layout, order[rows], times, position, velocity, effort, times, times))
            if "set_point" in decoded[0][1] and not channel.commands:
                asked = np.array([values["set_point"] for _, values in decoded])
                held = Messages(layout, order[rows], times, asked, None, None, times, times)
                self.scanned.commands[channel.topic].append(held)

    def _next_layouts(self, message: bytes, channel: _Channel) -> list[JointStateLayout] | list[FormLayout] | None:
        if self._layout_count == _MAX_LAYOUTS:
            return None
        try:
            if channel.form is None or channel.schema is None:
                layouts: list[JointStateLayout] | list[FormLayout] = [parse_layout(message, bool(channel.ros1))]
            else:
                layouts = parse_form(message, channel.form, channel.schema, bool(channel.ros1))
        except ValueError:
            return None
        self._layout_count += 1
        return layouts


def _message_data(packed: bytes) -> bytes:
    """A message that was compressed by itself; empty where it is damaged or takes too much memory."""
    with suppress(zstandard.ZstdError):
        data = _unzstd(packed, _MOST_MESSAGE)
        return data if len(data) <= _MOST_MESSAGE else b""
    return b""


def _unzstd(data: bytes, size: int) -> bytes:
    with zstandard.ZstdDecompressor(max_window_size=MOST_UNPACKED).stream_reader(data) as stream:
        return stream.read(size + 1)


def _unlz4(data: bytes, size: int) -> bytes:
    return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)


#: By the name of a compression: content, as far as the data go and a byte beyond the declared size.
_UNPACK = {"zstd": _unzstd, "lz4": _unlz4}


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _printable(text: str) -> str:
    """Without what would act on a terminal."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)
