"""Serial line in addition to the frames of drivers.wire.frames: compact samples, and recovery after damage.

The frames are those of docs/wire-tcp.md, kept short, because a line is slow and a frame holds up what comes after it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from drivers.errors import ProtocolError
from drivers.wire import frames
from drivers.wire.frames import Frame, FrameDecoder

UPLOAD_BLOCK = 512
LONGEST_FRAME = 1024  # bytes: of samples and upload blocks; the watchdog is reckoned with it
MAX_PAYLOAD = 16 * 1024  # of any other frame
BITS_PER_BYTE = 10  # start bit, eight, stop bit


def frame_time(baud: int, size: int = LONGEST_FRAME) -> float:
    """Seconds that a number of bytes takes on the line."""
    return size * BITS_PER_BYTE / baud


def samples_per_second(baud: int, joints: int) -> float:
    """Samples that a line carries with frames as full as they may be."""
    count = samples_per_frame(joints)
    return count / frame_time(baud, frames.frame_bytes(LeanSamples.size(count, joints)))


def samples_per_frame(joints: int) -> int:
    """Number of samples in the longest frame."""
    room = LONGEST_FRAME - frames.frame_bytes(LeanSamples.size(0, joints))
    return max(1, room // (LeanSamples.size(1, joints) - LeanSamples.size(0, joints)))


class LeanSamples(frames.Samples):
    """`frames.Samples` in half the bytes: values in single precision."""

    TYPE = 0x92
    VALUE = "<f4"


def decode(frame: Frame) -> Any:
    """The message in a frame.

    Raises:
        ProtocolError: unknown type, or a payload that does not fit it.
    """
    return LeanSamples.unpack(frame.payload) if frame.type == LeanSamples.TYPE else frames.decode(frame)


class HuntingDecoder(FrameDecoder):
    """Goes on after damage at the next frame that is whole: a line has no other way to begin again."""

    decode = staticmethod(decode)

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
        at = self._buffer.find(frames.MAGIC, 1)
        while at > 0:
            with contextlib.suppress(ProtocolError, StopIteration):
                next(FrameDecoder(self._max_payload).feed(bytes(self._buffer[at:])))
                self.rejected += at
                del self._buffer[:at]
                return True
            at = self._buffer.find(frames.MAGIC, at + 1)
        return False

    def _skip(self) -> None:
        """Skip to the next byte where a frame may begin."""
        at = self._buffer.find(frames.MAGIC[:1], 1)
        at = len(self._buffer) if at < 0 else at
        self.rejected += at
        del self._buffer[:at]
