"""What the serial line has beyond the frames of drivers.wire.tcp: lean samples, and going on after damage.

The frames are those of docs/wire-tcp.md, kept short, because a line is slow and a frame holds up what comes after it.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire import tcp
from drivers.wire.tcp import MAX_JOINTS, MAX_SEQUENCE, Frame, FrameDecoder

UPLOAD_BLOCK = 512
LONGEST_FRAME = 1024  # bytes: of samples and upload blocks; the watchdog is reckoned with it
MAX_PAYLOAD = 16 * 1024  # of any other frame
BITS_PER_BYTE = 10  # start bit, eight, stop bit


def frame_time(baud: int, size: int = LONGEST_FRAME) -> float:
    """Seconds that so many bytes take on the line."""
    return size * BITS_PER_BYTE / baud


def samples_per_second(baud: int, joints: int) -> float:
    """Samples that a line carries with frames as full as they may be."""
    count = samples_per_frame(joints)
    return count / frame_time(baud, len(tcp.HEADER.pack(b"", 0, 0, 0, 0, 0)) + 4 + LeanSamples.size(count, joints))


def samples_per_frame(joints: int) -> int:
    """How many samples fit into the longest frame."""
    room = LONGEST_FRAME - tcp.HEADER.size - tcp.TRAILER.size - LeanSamples.size(0, joints)
    return max(1, room // (LeanSamples.size(1, joints) - LeanSamples.size(0, joints)))


@dataclass(frozen=True, eq=False)
class LeanSamples:
    """`tcp.Samples` in half the bytes: values in single precision.

    Payload: ``first(8) count(2) joints(1) time_ns(8·K)``, then the five arrays, each K × n × f32.
    """

    TYPE = 0x92
    _HEAD = struct.Struct("<QHB")

    first: int
    time_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    reference_position: np.ndarray
    reference_velocity: np.ndarray

    @classmethod
    def size(cls, count: int, joints: int) -> int:
        """Bytes of the payload."""
        return cls._HEAD.size + count * (8 + 20 * joints)

    def pack(self) -> bytes:
        """The payload."""
        count, joints = self.position.shape
        columns = (self.position, self.velocity, self.torque, self.reference_position, self.reference_velocity)
        return b"".join(
            (
                self._HEAD.pack(self.first, count, joints),
                self.time_ns.astype("<i8").tobytes(),
                *(column.astype("<f4").tobytes() for column in columns),
            )
        )

    @classmethod
    def unpack(cls, payload: bytes) -> tcp.Samples:
        """The samples, in double precision again.

        Raises:
            ProtocolError: the payload does not fit its own head.
        """
        if len(payload) < cls._HEAD.size:
            raise ProtocolError("a sample message is shorter than its head")
        first, count, joints = cls._HEAD.unpack_from(payload)
        if (
            not 1 <= joints <= MAX_JOINTS
            or count < 1
            or first > MAX_SEQUENCE
            or len(payload) != cls.size(count, joints)
        ):
            raise ProtocolError(
                f"a sample message of {len(payload)} bytes announces {count} samples of {joints} joints"
            )
        time_ns = np.frombuffer(payload, "<i8", count, cls._HEAD.size)
        values = np.frombuffer(payload, "<f4", 5 * count * joints, cls._HEAD.size + 8 * count).astype(float)
        return tcp.Samples(first, time_ns, *values.reshape(5, count, joints))


def decode(frame: Frame) -> Any:
    """The message in a frame.

    Raises:
        ProtocolError: unknown type, or a payload that does not fit it.
    """
    return LeanSamples.unpack(frame.payload) if frame.type == LeanSamples.TYPE else tcp.decode(frame)


class HuntingDecoder(FrameDecoder):
    """Goes on after damage at the next frame that is whole: a line has no other way to begin again."""

    def __init__(self, max_payload: int = MAX_PAYLOAD) -> None:
        super().__init__(max_payload)
        self.rejected = 0

    def feed(self, data: bytes) -> Iterator[Frame]:
        """The frames that are complete now; never raises."""
        self._buffer += data
        while True:
            try:
                frame = self._next()
            except ProtocolError:
                self._skip()
                continue
            if frame is not None:
                yield frame
            elif not self._overtaken():
                return

    def _overtaken(self) -> bool:
        """Whether a whole frame stands behind the beginning of another: the length of that one is damaged, it would
        wait for bytes that never come. What is in front of the whole one is thrown away."""
        at = self._buffer.find(tcp.MAGIC, 1)
        while at > 0:
            with contextlib.suppress(ProtocolError, StopIteration):
                next(FrameDecoder(self._max_payload).feed(bytes(self._buffer[at:])))
                self.rejected += at
                del self._buffer[:at]
                return True
            at = self._buffer.find(tcp.MAGIC, at + 1)
        return False

    def _skip(self) -> None:
        """To the next place where a frame may begin."""
        at = self._buffer.find(tcp.MAGIC[:1], 1)
        at = len(self._buffer) if at < 0 else at
        self.rejected += at
        del self._buffer[:at]
