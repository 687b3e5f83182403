"""The serial driver: frames over a line (docs/wire-serial.md), or Modbus RTU where the address says so.

A line may be slower than the arm. The controller keeps what it cannot send yet, and the driver goes on reading after
the motion; whoever wants to watch the arm asks for the `throughput` first.
"""

from __future__ import annotations

import time
from typing import Any

from drivers.errors import DriverError
from drivers.transports.base.ports import SerialChannel, open_port, parse_port, serial_endpoints
from drivers.transports.base.samples import SampleStream
from drivers.transports.frames.driver import FrameDriver, FrameLink
from drivers.transports.modbus.rtu import RtuDriver
from drivers.wire.frames import MAX_BATCH, End, Fetch, Samples, frame_bytes
from drivers.wire.serial import UPLOAD_BLOCK, HuntingDecoder, LeanSamples, frame_time, samples_per_frame

_FRAMES_IN_WATCHDOG = 3
_BUFFERED = 8192  # bytes that may be in transit, in buffers without access
_PATIENCE = 0.25  # s, beyond the time of bytes in transit
_REST_POLL = 0.05  # s
_FEWEST, _MOST, _BAUD_PER_QUESTION = 8, 48, 8000  # questions that measure a line; a controller keeps some 64 answers


def create(address: str, **options: Any) -> SerialDriver | RtuDriver:
    """The serial driver for an address `port[,baud[,frames|rtu]]`.

    Raises:
        ConfigurationError: not an address.
    """
    return (RtuDriver if parse_port(address).protocol == "rtu" else SerialDriver)(address, **options)


class SerialDriver(FrameDriver):
    """`drivers.protocol.Driver` with frames over a serial line; the address is `port[,baud]`.

    What changes nothing is asked again where its answer was damaged. Where the line cannot carry the samples as fast
    as they come, `samples` goes on after the arm has come to rest.

    Raises:
        ConfigurationError: not an address.
    """

    READ_ATTEMPTS = 3
    UPLOAD_BLOCK = UPLOAD_BLOCK

    def __init__(self, address: str, **options: Any) -> None:
        self._line = parse_port(address)
        super().__init__(address, **options)
        self.BURST = min(max(_FEWEST, self._line.baud // _BAUD_PER_QUESTION), _MOST)
        self._watchdog = max(self._watchdog, _FRAMES_IN_WATCHDOG * frame_time(self._line.baud))
        self._progress = self._fetched = 0.0
        self._fetching: tuple[int, int] | None = None
        self._starting = False
        self._moved: float | None = None  # when the first message of a motion came whose start is not answered yet

    def endpoints(self) -> tuple[str, ...]:
        """`NamesEndpoints`."""
        return serial_endpoints(self._line.port)

    def start(self, name: str, checksum: str) -> None:
        """Run the stored program once."""
        self._progress = time.monotonic()
        self._moved, self._starting = None, True
        try:
            super().start(name, checksum)
        finally:
            self._starting = False

    def _open_link(self) -> FrameLink:
        channel = SerialChannel(open_port(self._line, self._timeout))
        return FrameLink(channel, self._line.port, HuntingDecoder(), self)

    def _sample_bytes(self, joints: int) -> float:
        count = samples_per_frame(joints)
        return frame_bytes(LeanSamples.size(count, joints)) / count

    def _rests(self, motion: SampleStream) -> bool:
        """Wait until all samples have come, which may take much longer."""
        until = time.monotonic() + self._start_timeout
        while not motion.wait(_REST_POLL):
            if not self.status().moving:
                return True
            if time.monotonic() > until:
                return False
        return True

    def _on_message(self, message: Any, request: int) -> None:
        self._progress = time.monotonic()
        if self._moved is None and isinstance(message, (Samples, End)):
            self._moved = self._progress
        super()._on_message(message, request)

    def _on_turn(self) -> None:
        """A damaged frame may have been the answer to a fetch, or the end: ask for what comes next."""
        now = time.monotonic()
        patience = _PATIENCE + frame_time(self._line.baud, _BUFFERED)
        if self._starting and self._moved is not None and now - self._moved > patience:
            raise DriverError(
                f"the arm at {self.address} moves, but the answer to its start was lost; the link was closed, which "
                "stops the arm"
            )
        motion, link = self._motion, self._link
        if motion is None or link is None or motion.over or not link.guarded:
            return
        if motion.fetching != self._fetching:
            self._fetching, self._fetched = motion.fetching, now
        late = now - self._progress > patience
        if late or (motion.fetching is not None and now - self._fetched > patience):
            self._progress = now
            first, count = motion.next_wanted()
            motion.fetching = self._fetching = link.post(Fetch(first, min(count, MAX_BATCH))), first
            self._fetched = now
