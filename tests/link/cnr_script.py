"""What a controller with CNR's programs says, written by hand, and one that says what a script tells it to."""

import contextlib
import socket
import threading
from collections.abc import Callable

import numpy as np

from drivers.transports.cnr.address import CnrAddress
from drivers.transports.cnr.motion import CnrArm, CnrMotion
from drivers.wire import cnr
from drivers.wire.cnr import Message, MessageType, Point, QueueStatus

ARM = CnrArm(2, 0.002, np.array([[2.0, 0.0], [0.5, -1.0]]))
READY = cnr.StatusMessage(1, 0, 0, 0, 0, 2, 1)
TEN = (0.0,) * 10
TICK = 0.002  # s between two records: one that is sent again at once keeps a processor busy


def motion(is_over=lambda feedback: feedback.last_point_processed == 7, broker=True):
    made = CnrMotion(ARM, 10**9, is_over, 1.0, (lambda: "nothing on x") if broker else None)
    made.started = True
    return made


def feedback(time, joints=(0.0, 0.0), moves=1, last=0, currents=(0.0, 0.0)):
    six = (0.0,) * 6
    return cnr.Feedback(1, six, six, six, (*joints, *TEN[2:]), (*currents, *TEN[2:]), six, last, time, moves)


class Script:
    """A controller: feedback and status in lock step, and an answer to every command by `reply(message)`."""

    def __init__(self, reply: Callable[[Message], Message | None], order: str = cnr.LITTLE) -> None:
        self.heard: list[Message] = []
        self.reply = reply
        self.order = order
        self.state = READY
        self.feedback = feedback(1000, moves=0)
        self.answered, self._closing = threading.Semaphore(0), threading.Event()
        self.listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
        ports = [listener.getsockname()[1] for listener in self.listeners]
        self.address = CnrAddress("127.0.0.1", *ports)
        for listener, serve in zip(self.listeners, (self._commands, self._feedbacks, self._states), strict=True):
            threading.Thread(target=self._accept, args=(listener, serve), daemon=True).start()

    def _accept(self, listener: socket.socket, serve: Callable[[socket.socket], None]) -> None:
        with contextlib.suppress(OSError):
            connection, _ = listener.accept()
            with connection:
                serve(connection)

    def _commands(self, connection: socket.socket) -> None:
        decoder = cnr.MessageDecoder(self.order)
        while data := connection.recv(65536):
            for message in decoder.feed(data):
                self.heard.append(message)
                answer = self.reply(message)
                if answer is not None:
                    connection.sendall(cnr.encode(answer, self.order))

    def _feedbacks(self, connection: socket.socket) -> None:
        self._lock_step(connection, MessageType.FEEDBACK, lambda: self.feedback)

    def _states(self, connection: socket.socket) -> None:
        self._lock_step(connection, MessageType.STATUS, lambda: self.state)

    def _lock_step(self, connection: socket.socket, kind: MessageType, record: Callable[[], object]) -> None:
        decoder = cnr.MessageDecoder(self.order)
        while not self._closing.wait(TICK):
            sent = Message(kind, 2, 0, record())
            connection.sendall(cnr.encode(sent, self.order))
            answers: list[Message] = []
            while not answers:
                data = connection.recv(65536)
                if not data:
                    return
                answers += decoder.feed(data)
            assert answers == [Message(kind, 3, 1, sent.record)]
            self.answered.release()
            connection.settimeout(5)

    def close(self) -> None:
        self._closing.set()
        for listener in self.listeners:
            listener.close()


def success(message: Message, queue=QueueStatus.READY, done=True) -> Message:
    number = message.record.sequence_number
    return Message(message.type, 3, 1 if done else 2, Point(queue_status=queue, sequence_number=number))
