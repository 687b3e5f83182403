"""The TCP driver: requests and answers, heartbeats, and samples in frames; docs/wire-tcp.md.

The thread that reads waits for nobody who takes the samples, so neither a slow disk nor a busy search silences the
heartbeat.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import queue
import socket
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.protocol import Identity, SampleBlock, Status
from drivers.transports.base.link import LinkDriver, LinkThread
from drivers.transports.base.ports import open_socket, parse_address
from drivers.transports.base.poses import poses_of_frames
from drivers.transports.base.samples import SampleStream
from drivers.wire import tcp as wire
from drivers.wire.reasons import refusal_error

Reply = TypeVar("Reply")
#: A command whose effect is visible counts as answered after this further time [s].
_ACTING = 0.25
#: Questions at once that measure the link: their answers take several times what it delays any.
_BURST = 256
_RECEIVE = 256 * 1024


class _Stamped(queue.SimpleQueue[Any]):
    """A queue of answers, each with the time at which the link's thread took it from the socket."""

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        super().put((time.monotonic(), item), block, timeout)


class TcpLink(LinkThread):
    """A connection and its reader thread. Heartbeats are sent all the time, four to a watchdog.

    Parameters
    ----------
    connection : to the driver's address.
    driver : in the reader thread, its `_on_message` gets messages that no call waits for, and its `_on_failure` comes
        last, when the link ends for any reason.
    """

    def __init__(self, connection: socket.socket, driver: TcpDriver) -> None:
        super().__init__(driver.address, driver._on_failure)
        self.watchdog = driver._watchdog
        self._connection, self._handles = connection, (connection,)
        self._driver = driver
        self._waiting: dict[int, queue.SimpleQueue[Any]] = {}
        self._ids = itertools.count(1)
        self._lock = threading.Lock()
        self._speaks = False  # the protocol, as a first frame has shown
        self._thread.start()

    def post(self, message: Any) -> int:
        """Send a request without waiting; its answer goes to `_on_message` with the id that is returned.

        Raises:
            DriverError: the link is down.
        """
        request = next(self._ids)
        self._send(message, request)
        return request

    def request(self, message: Any, reply: type[Reply], timeout: float, what: str) -> Reply:
        """Send a request, once, and wait for its answer.

        Raises:
            RefusedError: the controller refused; its reason is in the message.
            DriverError: no answer in time, or the link is down.
        """
        return self._checked(self._ask(message, timeout), reply, timeout, what)

    def command(
        self, message: Any, reply: type[Reply], timeout: float, what: str, acts: Callable[[], bool]
    ) -> Reply | None:
        """Send a command, once, and wait for its answer, but no longer than until it is seen that it `acts`.

        Returns None where that was seen and no answer came.

        Raises:
            RefusedError, DriverError: as in `request`.
        """
        answer = self._ask(message, timeout, acts)
        return None if answer is None and acts() else self._checked(answer, reply, timeout, what)

    def burst(self, message: Any, timeout: float, what: str) -> tuple[int, float]:
        """Ask `_BURST` times at once; bytes of the answers after the first, and the seconds that those took.

        Raises:
            DriverError: as of `request`.
        """
        answers = _Stamped()
        asked = [next(self._ids) for _ in range(_BURST)]
        self._waiting |= dict.fromkeys(asked, answers)
        size, first, last, until = 0, 0.0, 0.0, time.monotonic() + timeout
        try:
            for request in asked:
                self._send(message, request)
            for number in range(_BURST):
                try:
                    last, answer = answers.get(timeout=max(0.0, until - time.monotonic()))
                except queue.Empty:
                    if number == 0:
                        raise self._silent(what, timeout) from None
                    last = time.monotonic()  # the link has not carried more in all that time
                    break
                reply = self._checked(answer, object, timeout, what)
                first, size = (last, 0) if number == 0 else (first, size + len(wire.encode(reply)))
            return size, last - first
        finally:
            for request in asked:
                self._waiting.pop(request, None)

    def _checked(self, answer: Any, reply: type[Reply], timeout: float, what: str) -> Reply:
        if answer is None:
            raise self._silent(what, timeout)
        if isinstance(answer, DriverError):
            self.check()
        if isinstance(answer, wire.Refused):
            raise refusal_error(self.peer, what, answer.code, answer.line, answer.column, answer.message)
        if not isinstance(answer, reply):
            raise ProtocolError(f"the controller at {self.peer} answered {what} with {type(answer).__name__}")
        return answer

    def _ask(self, message: Any, timeout: float, acts: Callable[[], bool] = lambda: False) -> Any:
        """The answer, or None: none in time, or it `acts` already and none came for a while."""
        request = next(self._ids)
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._waiting[request] = answers
        try:
            self._send(message, request)
            until = time.monotonic() + timeout
            while (remaining := until - time.monotonic()) > 0:
                acted = acts()
                with contextlib.suppress(queue.Empty):
                    return answers.get(timeout=min(remaining, _ACTING))
                if acted:
                    break
            return None
        finally:
            self._waiting.pop(request, None)

    def _silent(self, what: str, timeout: float) -> DriverError:
        spoke = "it sends, but" if self._speaks else "it accepted the connection, but"
        return DriverError(
            f"the controller at {self.peer} is silent: {spoke} did not answer {what} within {timeout:g} s; "
            "is it the calibration server that listens there?"
        )

    def _send(self, message: Any, request: int = 0) -> None:
        with self._lock:
            self.transmit(self._connection, wire.encode(message, request), self.peer)

    # From here on in the reader thread.

    def _end(self, failure: DriverError) -> None:
        super()._end(failure)
        for answers in list(self._waiting.values()):
            answers.put(failure)

    def _work(self) -> None:
        decoder, beaten = wire.FrameDecoder(wire.MAX_REPLY_PAYLOAD), time.monotonic()
        for ready in self._each_turn([self._connection]):
            data = self._connection.recv(_RECEIVE) if ready else b""
            if ready and not data:
                raise DriverError(f"the controller at {self.peer} closed the connection")
            try:
                for frame in decoder.feed(data):
                    self._heard = self._speaks = True
                    self._deliver(wire.decode(frame), frame.request)
            except ProtocolError as error:
                raise ProtocolError(f"{self.peer}: {error}") from None
            if time.monotonic() - beaten >= self.watchdog / 4:
                beaten = time.monotonic()
                with contextlib.suppress(DriverError):  # what the peer still sent is to be read all the same
                    self._send(wire.Heartbeat())

    def _fell_silent(self) -> DriverError:
        return DriverError(
            f"the controller at {self.peer} fell silent: nothing for {self.watchdog * 1000:.0f} ms while the arm may "
            "move; go and look at it"
        )

    def _deliver(self, message: Any, request: int) -> None:
        if isinstance(message, wire.Heartbeat):
            return
        answers = self._waiting.get(request) if request else None
        if answers is not None:
            answers.put(message)
        else:
            self._driver._on_message(message, request)


class TcpMotion(SampleStream):
    """Samples of one motion; the controller is asked again for those that are missing, one request at a time.

    `fetching` is the id of that request and the first sequence number that it asks for.
    """

    fetching: tuple[int, int] | None = None

    def wanted(self) -> tuple[int, int] | None:
        """(first, count) to fetch now."""
        return None if self.fetching is not None or self.over else self.missing()

    def answered(self, request: int, block: SampleBlock | None) -> None:
        """An answer to `request`, 0 where nobody asked: samples, or None where the controller does not have them."""
        asked = self.fetching if self.fetching is not None and request == self.fetching[0] else None
        if asked is not None and block is not None:
            self.lost(int(block.sequence[0]))  # the first that there is
        if block is not None:
            self.take(block)
        if asked is not None:
            self.fetching = None
            if self.sequencer.expected == asked[1]:  # another request would not help
                self.give_up()


class TcpDriver(LinkDriver[TcpLink, TcpMotion]):
    """`drivers.protocol.Driver` over the binary TCP link; the address is `host:port`.

    Raises:
        ConfigurationError: not an address.
    """

    _measures_temperatures = True  # until the controller says that it does not

    def __init__(self, address: str, **options: Any) -> None:
        parse_address(address)
        super().__init__(address, **options)

    def identify(self) -> Identity:
        """Ask the controller who it is."""
        reply = self._read(wire.Identify(), wire.IdentityReply, "identify")
        return Identity(**vars(reply))

    def status(self) -> Status:
        """Ask for the state."""
        reply = self._read(wire.AskStatus(), wire.StatusReply, "status")
        return Status(**{**vars(reply), "position": np.array(reply.position)})

    def throughput(self) -> float:
        """`MeasuresThroughput`: samples as large as the answers to many questions that were asked at once."""
        size, seconds = self._connected().burst(wire.Identify(), self._timeout, "the measurement of the link")
        joints = len(self.identify().joint_names)
        return size / max(seconds, 1e-6) / (wire.Samples.size(1, joints) - wire.Samples.size(0, joints))

    def temperatures(self) -> np.ndarray | None:
        """(n,) of the motors [°C], or None where this controller measures none; it is asked again only if it does."""
        if not self._measures_temperatures:
            return None
        try:
            reply = self._read(wire.AskTemperatures(), wire.TemperaturesReply, "temperatures")
        except RefusedError:
            self._measures_temperatures = False
            return None
        self._measures_temperatures = bool(reply.celsius)
        return np.array(reply.celsius) if reply.celsius else None

    def frames(self) -> dict[str, np.ndarray]:
        """`ReportsFrames`; empty where this controller does not know the question."""
        try:
            reply = self._read(wire.AskFrames(), wire.FramesReply, "frames")
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
        begin = wire.UploadBegin(name, len(data), hashlib.sha256(data).hexdigest())
        link.request(begin, wire.Done, self._timeout, what)
        for offset in range(0, len(data), wire.UPLOAD_BLOCK):
            block = wire.UploadBlock(offset, data[offset : offset + wire.UPLOAD_BLOCK])
            link.request(block, wire.Done, self._timeout, what)
        return link.request(wire.UploadEnd(), wire.Stored, self._start_timeout, what).checksum

    def start(self, name: str, checksum: str) -> None:
        """Run the stored program once. Where the answer is lost the link is closed, so that the arm cannot go on."""
        link = self._connected()
        self._check_over()
        motion_id = uuid.uuid4().bytes
        with self._start_of(TcpMotion(self._buffer_limit)) as motion:
            link.guarded = True
            # Samples say as well that the arm moves: then it is time to watch it, whatever became of the answer.
            what, acts = f"start of {name}", motion.has_begun
            started = link.command(wire.Start(name, checksum, motion_id), wire.Started, self._start_timeout, what, acts)
            if started is not None and started.motion_id != motion_id:
                raise ProtocolError(f"the controller at {self.address} started another motion than it was asked to")

    def _open(self) -> None:
        self._link = link = TcpLink(open_socket(self.address, self._timeout), self)
        hello = wire.Hello(wire.VERSION, round(self._watchdog * 1000), "calibration-agent")
        welcome = link.request(hello, wire.Welcome, self._timeout, "the greeting")
        if welcome.version != wire.VERSION:
            raise ProtocolError(
                f"the controller at {self.address} speaks version {welcome.version} of the link, this driver "
                f"{wire.VERSION}; update the older one"
            )
        if not 10 <= welcome.watchdog_ms <= 60_000:
            raise ProtocolError(f"the controller at {self.address} wants a watchdog of {welcome.watchdog_ms} ms")
        link.watchdog = welcome.watchdog_ms / 1000

    def _bring_to_rest(self, link: TcpLink, motion: TcpMotion | None) -> None:
        if motion is not None:
            motion.stopping = True
        link.command(wire.Stop(), wire.Done, self._timeout, "stop", lambda: motion is not None and motion.over)
        if motion is not None and not motion.wait(self._start_timeout):
            raise self._still_moves()

    def _read(self, question: Any, reply: type[Reply], what: str) -> Reply:
        return self._connected().request(question, reply, self._timeout, what)

    # From here on in the reader thread.

    def _on_message(self, message: Any, request: int) -> None:
        motion, link = self._motion, self._link
        if motion is None or link is None or motion.over:
            return
        if isinstance(message, wire.Samples):
            motion.answered(request, to_block(message))
        elif isinstance(message, wire.End):
            motion.ended(message.reason, message.samples, message.message)
        elif isinstance(message, wire.Refused):
            motion.answered(request, None)
        if (full := motion.too_full()) is not None:
            link.post(wire.Stop())
            motion.finish(full)
        missing = motion.wanted()
        if missing is not None:
            first, count = missing
            motion.fetching = link.post(wire.Fetch(first, min(count, wire.MAX_BATCH))), first
        link.guarded = not motion.over


def to_block(samples: wire.Samples) -> SampleBlock:
    """A message's samples, received now."""
    count = len(samples.time_ns)
    sequence = np.arange(samples.first, samples.first + count)
    return SampleBlock(sequence, samples.time_ns * 1e-9, *samples.columns, received=time.time())
