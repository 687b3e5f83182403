"""A byte stream, cut anywhere, that becomes frames or messages."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Generic, TypeVar

from drivers.errors import ProtocolError

Whole = TypeVar("Whole")


class StreamDecoder(Generic[Whole]):
    """Never holds more than one frame and what was fed last; a subclass knows where one ends.

    A damaged stream cannot be trusted any further: after its first `ProtocolError` a decoder only repeats it.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._broken = ""

    @property
    def pending(self) -> int:
        """Bytes of a frame that is not complete yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Iterator[Whole]:
        """Yield complete items; consume all of them before feeding again.

        Raises:
            ProtocolError: another protocol, or damage; after the whole frames that came before.
        """
        if self._broken:
            raise ProtocolError(self._broken)
        self._buffer += data
        try:
            while (whole := self._next()) is not None:
                yield whole
        except ProtocolError as error:
            self._broken = str(error)
            self._buffer.clear()
            raise

    def _next(self) -> Whole | None:
        """The first whole one, taken out of the buffer."""
        raise NotImplementedError


class PackageDecoder(StreamDecoder[tuple[int, bytes]]):
    """(type, content) of packages that begin with their size in bytes and their type.

    `head` is the layout of both, `longest` the largest size, `name` the protocol's for messages.
    """

    def __init__(self, head: struct.Struct, longest: int, name: str) -> None:
        super().__init__()
        self._head, self._longest, self._name = head, longest, name

    def _next(self) -> tuple[int, bytes] | None:
        if len(self._buffer) < self._head.size:
            return None
        size, kind = self._head.unpack_from(self._buffer)
        if not self._head.size <= size <= self._longest:
            raise ProtocolError(f"what comes is not {self._name}: a package of {size} bytes")
        if len(self._buffer) < size:
            return None
        content = bytes(self._buffer[self._head.size : size])
        del self._buffer[:size]
        return kind, content
