"""The three sockets of CNR's programs: one thread reads them all, and answers feedback and status at once.

The controller sends a feedback, waits for it to come back, and stops the arm where it does not: nothing that this
thread calls may wait for anybody.
"""

from __future__ import annotations

import contextlib
import queue
import selectors
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.transports.base import LinkThread, dropped
from drivers.transports.cnr.address import CnrAddress
from drivers.transports.tcp import open_socket
from drivers.wire.cnr import (
    LITTLE,
    CommType as Comm,
    Feedback,
    Message,
    MessageDecoder,
    MessageType,
    Point,
    ReplyCode,
    StatusMessage,
    encode,
)

_RECEIVE = 64 * 1024
_ACTING = 0.25  # s: an answer that comes so late, where it is seen already that a command acts, is taken for lost
_TURN = 0.02  # s between two looks at what has to be done, where nothing comes


class CommandReply(NamedTuple):
    """To a command: carried out or not, and what the queue says of itself."""

    success: bool
    queue: int
    sequence: int


class _Socket:
    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.peer = f"{host}:{port}"
        self.connection = open_socket(self.peer if ":" not in host else f"[{host}]:{port}", timeout)
        self.connection.settimeout(timeout)
        self.decoder = MessageDecoder()
        self.heard = False


class Sockets(LinkThread):
    """An open link; `close` ends it.

    Args:
        address: where.
        timeout: for a connection and for an answer [s].
        on_turn: called in the reader thread some 50 times a second, with the feedbacks that came since.
        on_failure: called once, as the last, in the reader thread, when the link ends for whatever reason.
        stop: the command that is sent where the controller falls silent in motion.

    Raises:
        RefusedError: another client holds the programs.
        ProtocolError: other programs answer there.
        DriverError: nobody there, or silent.
    """

    def __init__(
        self,
        address: CnrAddress,
        timeout: float,
        on_turn: Callable[[list[Feedback]], None],
        on_failure: Callable[[DriverError], None],
        stop: MessageType,
    ) -> None:
        super().__init__(f"{address.host}:{address.feedback}", on_failure)
        self.watchdog = timeout
        self.guarded = False
        self._timeout = timeout
        self._on_turn = on_turn
        self._stop = stop
        self._answers: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._asking = threading.Lock()
        self._changed = threading.Condition()
        self._counts = {Feedback: 0, StatusMessage: 0}
        self._latest: dict[type, Feedback | StatusMessage] = {}
        with contextlib.ExitStack() as opened:

            def connect(port: int) -> _Socket:
                made = _Socket(address.host, port, timeout)
                opened.callback(made.connection.close)
                return made

            self._trajectory = connect(address.trajectory)
            self._feedback = connect(address.feedback)
            self._status = connect(address.status)
            self._sockets = (self._trajectory, self._feedback, self._status)
            self._thread.start()
            opened.callback(self.close)
            self._greet()
            opened.pop_all()

    def feedback(self) -> Feedback:
        """The last one."""
        return self._latest[Feedback]  # type: ignore[return-value]

    def last_status(self) -> StatusMessage:
        """The last one that came."""
        return self._latest[StatusMessage]  # type: ignore[return-value]

    def fresh_status(self) -> StatusMessage:
        """A status that the controller made after this call.

        Raises:
            DriverError: none comes, or the link is down.
        """
        with self._changed:
            wanted = self._counts[StatusMessage] + 2  # the next one may have been under way already
            came = self._changed.wait_for(
                lambda: self._counts[StatusMessage] >= wanted or self.failure is not None, self._timeout
            )
            self.check()
            if not came:
                raise DriverError(f"{self._status.peer} sends no status within {self._timeout:g} s; is its program on?")
            return self.last_status()

    def wait_feedback(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait until something is true that changes with feedbacks; False if it does not become true in time."""
        with self._changed:
            self._changed.wait_for(lambda: condition() or self.failure is not None, timeout)
        self.check()
        return condition()

    def command(
        self,
        kind: MessageType,
        point: Point | None = None,
        timeout: float | None = None,
        acts: Callable[[], bool] = lambda: False,
    ) -> CommandReply | None:
        """Send a command, once, and wait for its answer; None where none comes in time [s], or once it `acts`.

        Raises:
            DriverError: the link is down.
        """
        limit = time.monotonic() + (self._timeout if timeout is None else timeout)
        point = point or Point()
        with self._asking:
            while not self._answers.empty():
                self._answers.get()  # the answer to a command that was given up
            self._send(self._trajectory, Message(kind, Comm.REQUEST, ReplyCode.NONE, point))
            while (left := limit - time.monotonic()) > 0:
                seen = acts()
                answer = self._answer(kind, point, time.monotonic() + min(left, _ACTING))
                if answer is not None or seen:
                    return answer
            return None

    def post(self, kind: MessageType) -> None:
        """Send a command without waiting for its answer.

        Raises:
            DriverError: the link is down.
        """
        self._send(self._trajectory, Message(kind, Comm.REQUEST, ReplyCode.NONE, Point()))

    def ask_again(self, kind: MessageType, point: Point) -> CommandReply | None:
        """The late answer to a command, which comes before that to a ping; None where the ping's comes alone.

        Raises:
            DriverError: the link is down, or the ping is not answered either.
        """
        limit = time.monotonic() + self._timeout
        with self._asking:
            self._send(self._trajectory, Message(MessageType.PING, Comm.REQUEST, ReplyCode.NONE, Point()))
            while (message := self._next_answer(limit)) is not None:
                record = message.record
                if message.type == MessageType.PING:
                    return None
                if message.type == kind and isinstance(record, Point):
                    return CommandReply(message.reply == ReplyCode.SUCCESS, record.queue_status, record.sequence_number)
        raise DriverError(f"{self._trajectory.peer} does not even answer a ping any more; look at the controller")

    def close(self) -> None:
        """End the link and its thread; never raises."""
        self._closing.set()
        self._hang_up()
        self._join(5.0)
        for each in self._sockets:
            each.connection.close()

    def _heard(self, kind: type[Feedback | StatusMessage]) -> bool:
        return self._counts[kind] > 0 or self.failure is not None

    def _greet(self) -> None:
        for kind, each in ((Feedback, self._feedback), (StatusMessage, self._status)):
            with self._changed:
                came = self._changed.wait_for(partial(self._heard, kind), self._timeout)
            self.check()
            if not came:
                self.command(MessageType.PING)  # whoever answers it in another protocol fails the link
                raise DriverError(
                    f"{each.peer} accepts the connection, but says nothing within {self._timeout:g} s; is its program "
                    "active, or does another client hold it?"
                )
        if self.command(MessageType.PING) is None:
            raise DriverError(f"{self._trajectory.peer} does not answer a ping; is its program active?")

    def _answer(self, kind: MessageType, point: Point, limit: float) -> CommandReply | None:
        while (message := self._next_answer(limit)) is not None:
            record = message.record
            if message.type == kind and isinstance(record, Point):
                return CommandReply(message.reply == ReplyCode.SUCCESS, record.queue_status, record.sequence_number)
        return None

    def _next_answer(self, limit: float) -> Message | None:
        """None where none comes in time."""
        try:
            message = self._answers.get(timeout=max(0.0, limit - time.monotonic()))
        except queue.Empty:
            return None
        if message is None:
            self._answers.put(None)  # for whoever asks next
            self.check()
        return message

    def _send(self, target: _Socket, message: Message) -> None:
        self.check()
        order = target.decoder.order or self._feedback.decoder.order or LITTLE
        try:
            target.connection.sendall(encode(message, order))
        except TimeoutError:
            raise DriverError(f"{target.peer} takes no data any more; the link is dead") from None
        except OSError as error:
            self.check()
            raise dropped(target.peer, error) from None

    def _hang_up(self) -> None:
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.connection.shutdown(socket.SHUT_RDWR)

    # From here on in the reader thread.

    def _end(self, failure: DriverError) -> None:
        with self._changed:
            self.failure = failure
            self._changed.notify_all()
        self._hang_up()
        self._answers.put(None)

    def _work(self) -> None:
        silence = 0.0
        with selectors.DefaultSelector() as selector:
            for each in self._sockets:
                selector.register(each.connection, selectors.EVENT_READ, each)
            while not self._closing.is_set():
                began = time.monotonic()
                feedbacks: list[Feedback] = []
                for key, _ in selector.select(_TURN):
                    feedbacks += self._take(key.data)
                # A stall of this process is not the controller's silence: no turn counts for more than it should last.
                silence = 0.0 if feedbacks else silence + min(time.monotonic() - began, _TURN)
                self._on_turn(feedbacks)
                if self.guarded and silence >= self.watchdog:
                    with contextlib.suppress(DriverError):
                        self.post(self._stop)
                    raise DriverError(
                        f"{self._feedback.peer} fell silent: no feedback for {self.watchdog * 1000:.0f} ms while the "
                        "arm may move; it was told to stop. Go and look at it"
                    )

    def _take(self, source: _Socket) -> list[Feedback]:
        data = source.connection.recv(_RECEIVE)
        if not data:
            if not all(each.heard for each in self._sockets):  # one that is turned away loses all, in any order
                raise RefusedError(
                    f"{source.peer} closes the connection at once: another client holds the programs, or they have to "
                    "be activated again at the controller"
                )
            raise DriverError(f"the controller closed {source.peer}; was it restarted, or its program deactivated?")
        feedbacks: list[Feedback] = []
        try:
            for message in source.decoder.feed(data):
                source.heard = True
                if isinstance(message.record, Point):
                    self._answers.put(message)
                    continue
                self._note(message.record)  # before the answer: what is counted now was made before what comes next
                self._send(source, Message(message.type, Comm.REPLY, ReplyCode.SUCCESS, message.record))
                if isinstance(message.record, Feedback):
                    feedbacks.append(message.record)
        except ProtocolError as error:
            raise ProtocolError(f"{source.peer}: {error}") from None
        return feedbacks

    def _note(self, record: Feedback | StatusMessage) -> None:
        with self._changed:
            self._latest[type(record)] = record
            self._counts[type(record)] += 1
            self._changed.notify_all()
