"""An MCAP file, written record by record so that whatever is on the disk can be read.

The library's writer takes one message at a time, some 8 µs each; here a topic's messages enter a chunk as one byte
array (K, L). Its record classes write everything else. Format: MCAP 1.0, https://mcap.dev/spec.

Schemas and channels stand outside the chunks, so a chunk that is lost takes no definitions with it. A record is written
whole or, where the disk refuses, taken back.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from agent.core import AgentError, InputError

#: Largest uncompressed chunk [bytes].
CHUNK_SIZE = 64 * 1024
#: Bytes of a message record before its data.
MESSAGE_HEAD = 31
_MESSAGE = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_INDEX_ENTRY = np.dtype([("log", "<u8"), ("offset", "<u8")])


class RecordingError(AgentError):
    """A log cannot be written: disk full, read-only, too slow or no rights; `reason` is the system's. What was written
    before stays readable."""

    def __init__(
        self,
        path: Path,
        reason: str | None,
        kept: int = 0,
        advice: str = "free space, or choose a folder with write permission",
    ):
        what = f"; {kept} bytes recorded before are in the file and readable" if kept else ""
        super().__init__(f"{path}: the log cannot be written: {reason}; {advice}{what}")
        self.reason = reason


@dataclass
class _Open:
    """The chunk in progress."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    count: int = 0
    start: int = 0
    end: int = 0
    indexes: dict[int, list[np.ndarray]] = field(default_factory=dict)


class McapOutput:
    """One MCAP file in the making. Times are integers [ns].

    Raises:
        InputError: the file exists.
        RecordingError: from every method, where the file cannot be written.
    """

    def __init__(self, path: Path, profile: str, library: str):
        self._path = path
        try:
            # At the end of the file, wherever that is: else a file that was truncated grows to its size again.
            self._file = open(path, "xb", buffering=0, opener=_appending)  # noqa: SIM115  closed by `close`
        except FileExistsError:
            raise InputError(f"{path}: exists already; a recording is never overwritten, name another file") from None
        except OSError as error:
            raise RecordingError(path, error.strerror) from None
        self._end = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: dict[int, int] = {}
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata_count = 0
        self._chunk = _Open()
        self._emit(MCAP0_MAGIC + _bytes(Header(profile, library)))

    @property
    def room(self) -> int:
        """Bytes that still fit into the chunk in progress."""
        return CHUNK_SIZE - self._chunk.size

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Define a message type; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=text.encode())
        self._emit(_bytes(schema))
        self._schemas.append(schema)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Define a topic; returns its number."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata={})
        self._emit(_bytes(channel))
        self._channels.append(channel)
        self._counts[channel.id] = 0
        return channel.id

    def add_messages(self, channel: int, log_times: np.ndarray, sequences: np.ndarray, size: int, fill: _Fill) -> None:
        """Put K messages of `size` bytes each into the chunk; `fill` writes their data into an array (K, size).

        They have to fit into `room`, or there must be one of them. log_times (K,) [ns], sequences (K,).
        """
        count, record = len(log_times), MESSAGE_HEAD + size
        if count * record > self.room:
            self.flush()
        rows = np.empty((count, record), np.uint8)
        head = np.empty(count, _MESSAGE)
        head["opcode"], head["length"], head["channel"] = Opcode.MESSAGE, record - 9, channel
        head["sequence"] = np.asarray(sequences, np.int64) & 0xFFFFFFFF
        head["log"] = head["publish"] = np.maximum(log_times, 0)
        rows[:, :MESSAGE_HEAD] = head.view(np.uint8).reshape(count, MESSAGE_HEAD)
        fill(rows[:, MESSAGE_HEAD:])
        index = np.empty(count, _INDEX_ENTRY)
        index["log"], index["offset"] = head["log"], self._chunk.size + record * np.arange(count)
        chunk = self._chunk
        chunk.parts.append(rows.tobytes())
        chunk.size += count * record
        first, last = int(head["log"].min()), int(head["log"].max())
        chunk.start, chunk.end = (first, last) if chunk.count == 0 else (min(chunk.start, first), max(chunk.end, last))
        chunk.count += count
        chunk.indexes.setdefault(channel, []).append(index)
        self._counts[channel] += count

    def add_metadata(self, name: str, values: dict[str, str], indexed: bool = True) -> None:
        """Write a metadata record. Only an indexed one is seen by readers that start at the file's end."""
        self.flush()
        data = _bytes(Metadata(name=name, metadata=values))
        offset = self._end
        self._emit(data)
        self._metadata_count += 1
        if indexed:
            self._metadata.append(MetadataIndex(offset=offset, length=len(data), name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Put a small file into this one."""
        self.flush()
        attachment = _bytes(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        index = AttachmentIndex(
            offset=self._end,
            length=len(attachment),
            log_time=0,
            create_time=0,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._emit(attachment)
        self._attachments.append(index)

    def flush(self) -> None:
        """Hand the chunk in progress to the operating system: the end of this process cannot lose it any more."""
        chunk = self._chunk
        if chunk.count == 0:
            return
        data = b"".join(chunk.parts)
        packed = zstandard.compress(data)
        body = _bytes(
            Chunk(
                compression="zstd",
                data=packed,
                message_start_time=chunk.start,
                message_end_time=chunk.end,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )
        offsets, indexes = {}, b""
        for channel, parts in chunk.indexes.items():
            offsets[channel] = self._end + len(body) + len(indexes)
            entries = np.concatenate(parts).tobytes()
            indexes += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries
        index = ChunkIndex(
            message_start_time=chunk.start,
            message_end_time=chunk.end,
            chunk_start_offset=self._end,
            chunk_length=len(body),
            message_index_offsets=offsets,
            message_index_length=len(indexes),
            compression="zstd",
            compressed_size=len(packed),
            uncompressed_size=len(data),
        )
        self._chunk = _Open()
        self._emit(body + indexes)
        self._chunks.append(index)

    def sync(self) -> None:
        """Wait until the disk has what was flushed: a power cut cannot lose it any more."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise RecordingError(self._path, error.strerror, self._end) from None

    def check_kept(self) -> None:
        """
        Raises:
            RecordingError: the file is not at its path any more, or shorter than what was written: somebody deleted,
                replaced or truncated it, or its file system is gone. The system says nothing of that when it writes.
        """
        try:
            here, there = os.fstat(self._file.fileno()), os.stat(self._path)
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from None
        if (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino):
            raise self._lost("another file is in its place")
        if here.st_size != self._end:
            raise self._lost(f"it has {here.st_size} bytes, and {self._end} were written")

    def _lost(self, how: str) -> RecordingError:
        advice = "what was recorded of this motion is lost or damaged; record it again, where nobody touches the file"
        return RecordingError(
            self._path, f"it was deleted, replaced or changed while it was recorded ({how})", 0, advice
        )

    def finish(self) -> None:
        """Write the index at the end of the file."""
        self.flush()
        self._emit(_bytes(DataEnd(0)))
        start = self._end
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, [*self._schemas]),
            (Opcode.CHANNEL, [*self._channels]),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.ATTACHMENT_INDEX, [*self._attachments]),
            (Opcode.METADATA_INDEX, [*self._metadata]),
        ]
        summary, offsets = b"", b""
        for opcode, records in groups:
            data = b"".join(_bytes(record) for record in records)
            if data:
                offsets += _bytes(SummaryOffset(opcode, start + len(summary), len(data)))
                summary += data
        offset_start = start + len(summary)
        summary += offsets
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary))
        self._emit(summary + _bytes(Footer(start, offset_start, crc)) + MCAP0_MAGIC)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def _statistics(self) -> Statistics:
        return Statistics(
            message_count=sum(self._counts.values()),
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=len(self._attachments),
            metadata_count=self._metadata_count,
            chunk_count=len(self._chunks),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            channel_message_counts=dict(self._counts),
        )

    def _emit(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            with suppress(OSError):  # else the reader meets half a record, which it can deal with
                self._file.truncate(self._end)
            raise RecordingError(self._path, error.strerror, self._end) from None
        self._end += len(data)


_Fill = Callable[[np.ndarray], None]


def _appending(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_APPEND, 0o666)


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
