"""An MCAP file as `mcap.writer.Writer` writes it, but with many messages of one size at a time."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from functools import lru_cache
from typing import Protocol

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

#: Uncompressed size at which a chunk is closed [bytes]: 64 KiB, less the message that comes on top.
_CHUNK_SIZE = 60 * 1024


class Stream(Protocol):
    """Where records go, whole ones only."""

    def tell(self) -> int: ...
    def write(self, data: bytes) -> int: ...
    def flush(self) -> None: ...


class ChunkWriter:
    """Writes records to a stream. Schemas and channels also stand outside the chunks, so that a damaged chunk takes no
    definitions with it."""

    def __init__(self, stream: Stream, library: str):
        self._stream = stream
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: dict[str, MetadataIndex] = {}
        self._counts: dict[int, int] = {}
        self._open = bytearray()  # records of the chunk in progress
        self._index: dict[int, list[np.ndarray]] = {}  # by channel, (K, 2): log time and offset in the chunk
        stream.write(MCAP0_MAGIC + _bytes(Header("ros2", library)))

    def channel(self, topic: str, kind: str, text: str) -> int:
        """The channel of a topic of messages in CDR; `text` is the definition of their `kind`."""
        if topic not in self._channels:
            if kind not in self._schemas:
                self._schemas[kind] = Schema(len(self._schemas) + 1, text.encode(), "ros2msg", kind)
                self._define(self._schemas[kind])
            self._channels[topic] = Channel(len(self._channels) + 1, topic, "cdr", {}, self._schemas[kind].id)
            self._define(self._channels[topic])
        return self._channels[topic].id

    def _define(self, record: McapRecord) -> None:
        self._open += _bytes(record)
        self._stream.write(_bytes(record))

    def add_messages(self, channel: int, times: np.ndarray, sequences: np.ndarray, messages: np.ndarray) -> None:
        """Add messages (K, L) bytes with log times (K,) [ns] and sequence numbers (K,)."""
        records = np.empty(len(messages), _message_type(messages.shape[1]))
        records["opcode"], records["length"] = Opcode.MESSAGE, 22 + messages.shape[1]
        records["channel"], records["sequence"], records["data"] = channel, sequences, messages
        records["log_time"] = records["publish_time"] = times
        self._counts[channel] = self._counts.get(channel, 0) + len(records)
        size, first = records.dtype.itemsize, 0
        while first < len(records):
            part = records[first : first + (_CHUNK_SIZE - len(self._open)) // size + 1]
            offsets = len(self._open) + size * np.arange(len(part))
            entries = np.empty((len(part), 2), "<u8")
            entries[:, 0], entries[:, 1] = part["log_time"], offsets
            self._index.setdefault(channel, []).append(entries)
            self._open += part.tobytes()
            first += len(part)
            if len(self._open) > _CHUNK_SIZE:
                self._close_chunk()

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Add a named record of texts; the index lists the last one of a name."""
        record = _bytes(Metadata(name, data))
        self._metadata[name] = MetadataIndex(self._stream.tell(), len(record), name)
        self._stream.write(record)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file, listed in the index."""
        record = _bytes(Attachment(0, 0, name, media_type, data))
        place = self._stream.tell(), len(record)
        self._attachments.append(AttachmentIndex(*place, 0, 0, len(data), name, media_type))
        self._stream.write(record)

    def flush(self) -> None:
        """Close the chunk in progress, and hand everything on."""
        self._close_chunk()
        self._stream.flush()

    def _close_chunk(self) -> None:
        if not self._index:
            return
        tables = {channel: np.concatenate(parts) for channel, parts in self._index.items()}
        first = min(int(table[:, 0].min()) for table in tables.values())
        last = max(int(table[:, 0].max()) for table in tables.values())
        data = bytes(self._open)
        packed = zstandard.compress(data)
        chunk = _bytes(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data)))
        start = self._stream.tell()
        self._stream.write(chunk)
        offsets, begin = {}, self._stream.tell()
        for channel, table in tables.items():
            offsets[channel] = self._stream.tell()
            self._stream.write(_message_index(channel, table))
        length = self._stream.tell() - begin
        self._chunks.append(ChunkIndex(len(chunk), start, "zstd", len(packed), last, length, offsets, first, len(data)))
        self._open, self._index = bytearray(), {}

    def finish(self) -> None:
        """Write the index."""
        self._close_chunk()
        self._stream.write(_bytes(DataEnd(0)))
        start, summary, offsets = self._stream.tell(), b"", b""
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: dict[Opcode, Iterable[McapRecord]] = {
            Opcode.SCHEMA: self._schemas.values(),
            Opcode.CHANNEL: self._channels.values(),
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: self._chunks,
            Opcode.ATTACHMENT_INDEX: self._attachments,
            Opcode.METADATA_INDEX: self._metadata.values(),
        }
        for opcode, records in groups.items():
            group = b"".join(map(_bytes, records))
            offsets += _bytes(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        place = start, start + len(summary)
        without_sum = _bytes(Footer(*place, 0))[:-4]
        footer = Footer(*place, zlib.crc32(summary + offsets + without_sum))
        self._stream.write(summary + offsets + _bytes(footer) + MCAP0_MAGIC)


@lru_cache
def _message_type(length: int) -> np.dtype:
    """A record of a message of `length` bytes."""
    head = [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8")]
    return np.dtype([*head, ("publish_time", "<u8"), ("data", "u1", (length,))])


def _message_index(channel: int, table: np.ndarray) -> bytes:
    builder = RecordBuilder()
    builder.start_record(Opcode.MESSAGE_INDEX)
    builder.write2(channel)
    builder.write4(table.nbytes)
    builder.write(table.tobytes())
    builder.finish_record()
    return builder.end()


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
