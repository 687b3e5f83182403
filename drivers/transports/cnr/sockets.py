"""The three sockets of CNR's programs: one thread reads them all, and answers feedback and status at once.

The controller sends a feedback, waits for it to come back, and stops the arm where it does not: nothing that this
thread calls may wait for anybody.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.transports.base.link import LinkThread
from drivers.transports.base.ports import open_socket
from drivers.transports.cnr.address import CnrAddress
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
_NOTHING = Point()  # of a command that needs none


class CommandReply(NamedTuple):
    """To a command: carried out or not, and what the queue says of itself."""

    success: bool
    queue: int


class _Socket:
    """One of the three connections."""

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.peer = f"{host}:{port}"
        self.connection = open_socket(self.peer if ":" not in host else f"[{host}]:{port}", timeout)
        self.decoder = MessageDecoder()
        self.heard = False


class Sockets(LinkThread):
    """An open link; `close` ends it.

    Parameters
    ----------
    address : of the controller.
    timeout : for a connection and for an answer [s].
    on_turn : called in the reader thread some 50 times a second, with the feedbacks that came since.
    on_failure : called once, as the last, in the reader thread, when the link ends for whatever reason.
    stop : the command that is sent where the controller falls silent in motion.

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
        self._timeout = timeout
        self._on_turn = on_turn
        self._stop = stop
        self._answers: queue.SimpleQueue[tuple[int, CommandReply] | None] = queue.SimpleQueue()
        self._asking = threading.Lock()
        self._counts = {Feedback: 0, StatusMessage: 0}
        self._latest: dict[type, Feedback | StatusMessage] = {}
        self._sockets: dict[socket.socket, _Socket] = {}
        self._handles = self._sockets
        try:
            for port in (address.trajectory, address.feedback, address.status):
                opened = _Socket(address.host, port, timeout)
                self._sockets[opened.connection] = opened
            self._trajectory, self._feedback, self._status = self._sockets.values()
            self._thread.start()
            self._greet()
        except BaseException:
            self.close()
            raise

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
        if not self._comes(StatusMessage, self._counts[StatusMessage] + 2):  # the next one may be under way already
            raise DriverError(f"{self._status.peer} sends no status within {self._timeout:g} s; is its program on?")
        return self.last_status()

    def wait(self, reached: Callable[[], bool], timeout: float) -> bool:
        """As of `LinkThread`.

        Raises:
            DriverError: the link is down.
        """
        done = super().wait(reached, timeout)
        self.check()
        return done

    def command(
        self,
        kind: MessageType,
        point: Point = _NOTHING,
        timeout: float | None = None,
        acts: Callable[[], bool] = lambda: False,
    ) -> CommandReply | None:
        """Send a command, once, and wait for its answer; None where none comes in time [s], or once it `acts`.

        Raises:
            DriverError: the link is down.
        """
        limit = time.monotonic() + (self._timeout if timeout is None else timeout)
        with self._asking:
            while not self._answers.empty():
                self._answers.get()  # the answer to a command that was given up
            self.post(kind, point)
            while (remaining := limit - time.monotonic()) > 0:
                acted = acts()
                answer = self._answer((kind,), time.monotonic() + min(remaining, _ACTING))
                if answer is not None or acted:
                    return None if answer is None else answer[1]
            return None

    def post(self, kind: MessageType, point: Point = _NOTHING) -> None:
        """Send a command without waiting for its answer.

        Raises:
            DriverError: the link is down.
        """
        self._send(self._trajectory, Message(kind, Comm.REQUEST, ReplyCode.NONE, point))

    def ask_again(self, kind: MessageType) -> CommandReply | None:
        """The late answer to a command, which comes before that to a ping; None where the ping's comes alone.

        Raises:
            DriverError: the link is down, or the ping is not answered either.
        """
        with self._asking:
            self.post(MessageType.PING)
            answer = self._answer((kind, MessageType.PING), time.monotonic() + self._timeout)
        if answer is None:
            raise DriverError(f"{self._trajectory.peer} does not even answer a ping any more; look at the controller")
        return answer[1] if answer[0] == kind else None

    def _comes(self, kind: type[Feedback | StatusMessage], count: int) -> bool:
        return self.wait(lambda: self._counts[kind] >= count, self._timeout)

    def _greet(self) -> None:
        for kind, each in ((Feedback, self._feedback), (StatusMessage, self._status)):
            if not self._comes(kind, 1):
                self.command(MessageType.PING)  # whoever answers it in another protocol fails the link
                raise DriverError(
                    f"{each.peer} accepts the connection, but says nothing within {self._timeout:g} s; is its program "
                    "active, or does another client hold it?"
                )
        if self.command(MessageType.PING) is None:
            raise DriverError(f"{self._trajectory.peer} does not answer a ping; is its program active?")

    def _answer(self, kinds: tuple[MessageType, ...], limit: float) -> tuple[int, CommandReply] | None:
        """Type and content of the next answer of these kinds; None where none comes by then. Others are too late."""
        while True:
            try:
                answer = self._answers.get(timeout=max(0.0, limit - time.monotonic()))
            except queue.Empty:
                return None
            if answer is None:
                self._answers.put(None)  # for whoever asks next
                self.check()
            elif answer[0] in kinds:
                return answer

    def _send(self, target: _Socket, message: Message) -> None:
        order = target.decoder.order or self._feedback.decoder.order or LITTLE
        self.transmit(target.connection, encode(message, order), target.peer)

    # From here on in the reader thread.

    def _end(self, failure: DriverError) -> None:
        super()._end(failure)
        self._answers.put(None)

    def _work(self) -> None:
        for ready in self._each_turn(list(self._sockets), _TURN):
            feedbacks = [feedback for connection in ready for feedback in self._take(self._sockets[connection])]
            self._heard = bool(feedbacks)
            self._on_turn(feedbacks)

    def _fell_silent(self) -> DriverError:
        with contextlib.suppress(DriverError):
            self.post(self._stop)
        return DriverError(
            f"{self.peer} fell silent: no feedback for {self.watchdog * 1000:.0f} ms while the arm may move; it was "
            "told to stop. Go and look at it"
        )

    def _take(self, source: _Socket) -> list[Feedback]:
        data = source.connection.recv(_RECEIVE)
        if not data:
            if not all(
                each.heard for each in self._sockets.values()
            ):  # one that is turned away loses all, in any order
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
                    done = message.reply == ReplyCode.SUCCESS
                    self._answers.put((message.type, CommandReply(done, message.record.queue_status)))
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
