"""Shared base of drivers over frames, for any transport; docs/wire-tcp.md describes the frames."""

from __future__ import annotations

import hashlib
import math
import time
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.errors import ProtocolError, RefusedError
from drivers.protocol import Identity, SampleBlock, Status
from drivers.transports.base import WATCHDOG, LinkDriver, poses_of_frames
from drivers.transports.frame_link import ACTING, Channel, FrameLink, Reply
from drivers.transports.motion import MotionStream
from drivers.wire.tcp import (
    MAX_BATCH,
    UPLOAD_BLOCK,
    VERSION,
    AskFrames,
    AskStatus,
    AskTemperatures,
    Done,
    End,
    Fetch,
    Frame,
    FrameDecoder,
    FramesReply,
    Hello,
    Identify,
    IdentityReply,
    Refused,
    Samples,
    Start,
    Started,
    StatusReply,
    Stop,
    Stored,
    TemperaturesReply,
    UploadBegin,
    UploadBlock as Block,
    UploadEnd,
    Welcome,
)


class FrameDriver(LinkDriver[FrameLink, MotionStream]):
    """`drivers.protocol.Driver` over frames; a subclass opens the channel that carries them.

    Parameters
    ----------
    address : in the notation of the subclass.
    watchdog : silence [s] after which either end takes the other for gone; the controller may answer another one.
    options : of `LinkDriver`.
    """

    READ_ATTEMPTS = 1  # of requests that change nothing
    UPLOAD_BLOCK = UPLOAD_BLOCK
    BURST = 256  # questions at once that measure the link: their answers take several times what it delays any

    def __init__(self, address: str, *, watchdog: float = WATCHDOG, **options: Any) -> None:
        super().__init__(address, **options)
        self._watchdog = watchdog
        self._measures_temperatures = True

    def identify(self) -> Identity:
        """Ask the controller who it is."""
        reply = self._read(Identify(), IdentityReply, "identify")
        return Identity(**vars(reply))

    def status(self) -> Status:
        """Ask for the state."""
        reply = self._read(AskStatus(), StatusReply, "status")
        return Status(**{**vars(reply), "position": np.array(reply.position)})

    def throughput(self) -> float:
        """`MeasuresThroughput`: samples as large as the answers to many questions that were asked at once."""
        size, seconds = self._connected().burst(Identify(), self.BURST, self._timeout, "the measurement of the link")
        return size / max(seconds, 1e-6) / self._sample_bytes(len(self.identify().joint_names))

    def temperatures(self) -> np.ndarray | None:
        """(n,) of the motors [°C], or None where this controller measures none; it is asked again only if it does."""
        if not self._measures_temperatures:
            return None
        try:
            reply = self._read(AskTemperatures(), TemperaturesReply, "temperatures")
        except RefusedError:
            self._measures_temperatures = False
            return None
        self._measures_temperatures = bool(reply.celsius)
        return np.array(reply.celsius) if reply.celsius else None

    def frames(self) -> dict[str, np.ndarray]:
        """`ReportsFrames`; empty where this controller does not know the question."""
        try:
            reply = self._read(AskFrames(), FramesReply, "frames")
        except RefusedError:
            return {}
        if any(len(numbers) != 6 for numbers in vars(reply).values()):
            raise ProtocolError(f"the controller at {self.address} answered with frames that have not six numbers each")
        return poses_of_frames(reply.base, reply.tool, reply.uframe)

    def upload(self, name: str, text: str) -> str:
        """Store a program; returns the SHA-256 (hex) of the text as the controller stored it.

        Raises:
            RefusedError: not a program (with line and column), too large, no memory, or the arm is moving.
        """
        link = self._connected()
        data = text.encode("utf-8")
        what = f"the program {name}"
        begin = UploadBegin(name, len(data), hashlib.sha256(data).hexdigest())
        link.request(begin, Done, self._timeout, what)
        for offset in range(0, len(data), self.UPLOAD_BLOCK):
            link.request(Block(offset, data[offset : offset + self.UPLOAD_BLOCK]), Done, self._timeout, what)
        return link.request(UploadEnd(), Stored, self._start_timeout, what).checksum

    def start(self, name: str, checksum: str) -> None:
        """Run the stored program once. Where the answer is lost the link is closed, so that the arm cannot go on."""
        link = self._connected()
        self._check_over()
        motion_id = uuid.uuid4().bytes
        with self._start_of(MotionStream(self._buffer_limit)) as motion:
            link.guarded = True
            # Samples say as well that the arm moves: then it is time to watch it, whatever became of the answer.
            what, acts = f"start of {name}", motion.has_begun
            started = link.command(Start(name, checksum, motion_id), Started, self._start_timeout, what, acts)
            if started is not None and started.motion_id != motion_id:
                raise ProtocolError(f"the controller at {self.address} started another motion than it was asked to")

    def _open(self) -> None:
        self._link = link = self._channel_link()
        hello = Hello(VERSION, round(self._watchdog * 1000), "calibration-agent")
        welcome = link.request(hello, Welcome, self._timeout, "the greeting")
        if welcome.version != VERSION:
            raise ProtocolError(
                f"the controller at {self.address} speaks version {welcome.version} of the link, this driver "
                f"{VERSION}; update the older one"
            )
        if not 10 <= welcome.watchdog_ms <= 60_000:
            raise ProtocolError(f"the controller at {self.address} wants a watchdog of {welcome.watchdog_ms} ms")
        link.watchdog = welcome.watchdog_ms / 1000

    def _bring_to_rest(self, link: FrameLink, motion: MotionStream | None) -> None:
        if motion is not None:
            motion.stopping = True
        again = ACTING if self.READ_ATTEMPTS > 1 else math.inf
        link.command(Stop(), Done, self._timeout, "stop", lambda: motion is not None and motion.over, again)
        if motion is not None and not self._rests(motion):
            raise self._still_moves()

    def _channel_link(self) -> FrameLink:
        """A link by `_link_over`."""
        raise NotImplementedError

    def _link_over(
        self, channel: Channel, peer: str, decoder: FrameDecoder, decode: Callable[[Frame], Any]
    ) -> FrameLink:
        """A link whose messages, failure and turns come to the methods below."""
        return FrameLink(
            channel, peer, decoder, decode, self._on_message, self._on_failure, self._on_turn, self._watchdog
        )

    def _read(self, question: Any, reply: type[Reply], what: str) -> Reply:
        again = self._timeout / self.READ_ATTEMPTS if self.READ_ATTEMPTS > 1 else math.inf
        return self._connected().request(question, reply, self._timeout, what, again)

    def _sample_bytes(self, joints: int) -> float:
        """Bytes that one of many samples takes on the wire."""
        return Samples.size(1, joints) - Samples.size(0, joints)

    def _rests(self, motion: MotionStream) -> bool:
        """Wait until the arm rests; False if it takes too long."""
        return motion.wait(self._start_timeout)

    # From here on in the reader thread.

    def _on_turn(self) -> None:
        """Called a few times a watchdog."""

    def _on_message(self, message: Any, request: int) -> None:
        motion, link = self._motion, self._link
        if motion is None or link is None or motion.over:
            return
        if isinstance(message, Samples):
            motion.take(to_block(message), request)
        elif isinstance(message, End):
            motion.ended(message.reason, message.samples, message.message)
        elif isinstance(message, Refused):
            motion.refetch_refused(request)
        if (full := motion.too_full()) is not None:
            link.post(Stop())
            motion.finish(full)
        missing = motion.wanted()
        if missing is not None:
            first, count = missing
            motion.fetching = link.post(Fetch(first, min(count, MAX_BATCH))), first
        link.guarded = not motion.over


def to_block(samples: Samples) -> SampleBlock:
    """A message's samples, received now."""
    count = len(samples.time_ns)
    sequence = np.arange(samples.first, samples.first + count)
    return SampleBlock(sequence, samples.time_ns * 1e-9, *samples.columns, received=time.time())
