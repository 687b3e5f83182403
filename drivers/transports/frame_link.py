"""One connection that carries frames: requests and answers, heartbeats, and the thread that reads.

Nothing here waits for the consumer of the samples, so neither a slow disk nor a busy search silences the heartbeat.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from drivers.errors import DriverError, ProtocolError
from drivers.transports.base import LinkThread, dropped
from drivers.wire.reasons import refusal_error
from drivers.wire.tcp import Frame, FrameDecoder, Heartbeat, Refused, encode

Reply = TypeVar("Reply")
#: A command whose effect is visible counts as answered after this further time [s].
ACTING = 0.25
_RECEIVE = 256 * 1024


class Channel(Protocol):
    """Bytes both ways, like a connected socket. Errors are `OSError`, a write that takes too long `TimeoutError`."""

    def fileno(self) -> int:
        """For a selector to wait on."""

    def recv(self, size: int, /) -> bytes:
        """Received bytes; empty if the far end has closed."""

    def sendall(self, data: bytes, /) -> None:
        """Send, in the time the channel allows."""

    def shutdown(self, how: int, /) -> None:
        """Let nothing through any more; a reader that waits returns."""

    def close(self) -> None:
        """Give the handle back."""


class _Stamped(queue.SimpleQueue[Any]):
    """A queue of answers, each with the time at which the link's thread took it from the line."""

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        super().put((time.monotonic(), item), block, timeout)


class FrameLink(LinkThread):
    """A channel and its reader thread. Heartbeats are sent all the time, four to a watchdog.

    Parameters
    ----------
    channel, peer : what carries the frames, and the far end's address for messages.
    decoder, decode : turn bytes into frames, and frames into messages.
    on_message : `on_message(message, request)` gets, in the reader thread, messages that no call waits for.
    on_failure : called once, as the last call, when the link ends for any reason.
    on_turn : is called a few times a watchdog.
    watchdog : [s]; may change when both ends agree on another one.
    """

    def __init__(
        self,
        channel: Channel,
        peer: str,
        decoder: FrameDecoder,
        decode: Callable[[Frame], Any],
        on_message: Callable[[Any, int], None],
        on_failure: Callable[[DriverError], None],
        on_turn: Callable[[], None],
        watchdog: float,
    ) -> None:
        super().__init__(peer, on_failure)
        self.watchdog = watchdog
        self._channel, self._handles = channel, (channel,)
        self._decoder = decoder
        self._decode = decode
        self._on_message = on_message
        self._on_turn = on_turn
        self._waiting: dict[int, queue.SimpleQueue[Any]] = {}
        self._ids = itertools.count(1)
        self._lock = threading.Lock()
        self._speaks = False  # the protocol, as a first frame has shown
        self._thread.start()

    def post(self, message: Any) -> int:
        """Send a request without waiting; its answer goes to `on_message` with the id that is returned.

        Raises:
            DriverError: the link is down.
        """
        request = next(self._ids)
        self._send(message, request)
        return request

    def request(self, message: Any, reply: type[Reply], timeout: float, what: str, again: float = math.inf) -> Reply:
        """Send a request and wait for its answer; one without effects may be sent again after `again` [s].

        Raises:
            RefusedError: the controller refused; its reason is in the message.
            DriverError: no answer in time, or the link is down.
        """
        return self._checked(self._ask(message, timeout, again), reply, timeout, what)

    def command(
        self,
        message: Any,
        reply: type[Reply],
        timeout: float,
        what: str,
        acts: Callable[[], bool],
        again: float = math.inf,
    ) -> Reply | None:
        """Send a command and wait for its answer, but no longer than until it is seen that it `acts`.

        Returns None where that was seen and no answer came. Only what does no harm twice may be sent `again`.

        Raises:
            RefusedError, DriverError: as in `request`.
        """
        answer = self._ask(message, timeout, again, acts)
        return None if answer is None and acts() else self._checked(answer, reply, timeout, what)

    def burst(self, message: Any, count: int, timeout: float, what: str) -> tuple[int, float]:
        """Ask `count` times at once; bytes of the answers after the first, and the seconds that those took.

        Raises:
            DriverError: as of `request`.
        """
        answers = _Stamped()
        asked = [next(self._ids) for _ in range(count)]
        self._waiting |= dict.fromkeys(asked, answers)
        size, first, last, until = 0, 0.0, 0.0, time.monotonic() + timeout
        try:
            for request in asked:
                self._send(message, request)
            for number in range(count):
                try:
                    last, answer = answers.get(timeout=max(0.0, until - time.monotonic()))
                except queue.Empty:
                    if number == 0:
                        raise self._silent(what, timeout) from None
                    last = time.monotonic()  # the line has not carried more in all that time
                    break
                reply = self._checked(answer, object, timeout, what)
                first, size = (last, 0) if number == 0 else (first, size + len(encode(reply)))
            return size, last - first
        finally:
            for request in asked:
                self._waiting.pop(request, None)

    def _checked(self, answer: Any, reply: type[Reply], timeout: float, what: str) -> Reply:
        if answer is None:
            raise self._silent(what, timeout)
        if isinstance(answer, DriverError):
            self.check()
        if isinstance(answer, Refused):
            raise refusal_error(self.peer, what, answer.code, answer.line, answer.column, answer.message)
        if not isinstance(answer, reply):
            raise ProtocolError(f"the controller at {self.peer} answered {what} with {type(answer).__name__}")
        return answer

    def _ask(self, message: Any, timeout: float, again: float, acts: Callable[[], bool] = lambda: False) -> Any:
        """The answer, or None: none in time, or it `acts` already and none came for a while."""
        request = next(self._ids)
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._waiting[request] = answers
        try:
            self._send(message, request)
            sent = time.monotonic()
            until = sent + timeout
            while (left := until - time.monotonic()) > 0:
                seen = acts()
                with contextlib.suppress(queue.Empty):
                    return answers.get(timeout=min(left, ACTING))
                if seen:
                    break
                if time.monotonic() - sent >= again:
                    sent = time.monotonic()
                    self._send(message, request)
            return None
        finally:
            self._waiting.pop(request, None)

    def _silent(self, what: str, timeout: float) -> DriverError:
        if self._decoder.rejected and not self._speaks:
            return ProtocolError(
                f"what comes from {self.peer} is not the calibration link ({self._decoder.rejected} bytes without a "
                "frame): is it the right line, and the baud rate that of the controller?"
            )
        spoke = "it sends, but" if self._speaks else "it accepted the connection, but"
        return DriverError(
            f"the controller at {self.peer} is silent: {spoke} did not answer {what} within {timeout:g} s; "
            "is it the calibration server that listens there?"
        )

    def _send(self, message: Any, request: int = 0) -> None:
        self.check()
        try:
            with self._lock:
                self._channel.sendall(encode(message, request))
        except TimeoutError:
            raise DriverError(f"the controller at {self.peer} takes no data any more; the link is dead") from None
        except OSError as error:
            self.check()
            raise dropped(self.peer, error) from None

    # From here on in the reader thread.

    def _end(self, failure: DriverError) -> None:
        super()._end(failure)
        for answers in list(self._waiting.values()):
            answers.put(failure)

    def _work(self) -> None:
        beaten = time.monotonic()
        for ready in self._each_turn([self._channel]):
            data = self._channel.recv(_RECEIVE) if ready else b""
            if ready and not data:
                raise DriverError(f"the controller at {self.peer} closed the connection")
            try:
                for frame in self._decoder.feed(data):
                    self._heard = self._speaks = True
                    self._deliver(self._decode(frame), frame.request)
            except ProtocolError as error:
                raise ProtocolError(f"{self.peer}: {error}") from None
            self._on_turn()
            if time.monotonic() - beaten >= self.watchdog / 4:
                beaten = time.monotonic()
                with contextlib.suppress(DriverError):  # what the peer still sent is to be read all the same
                    self._send(Heartbeat())

    def _fell_silent(self) -> DriverError:
        return DriverError(
            f"the controller at {self.peer} fell silent: nothing for {self.watchdog * 1000:.0f} ms while the arm may "
            "move; go and look at it"
        )

    def _deliver(self, message: Any, request: int) -> None:
        if isinstance(message, Heartbeat):
            return
        answers = self._waiting.get(request) if request else None
        if answers is not None:
            answers.put(message)
        else:
            self._on_message(message, request)
