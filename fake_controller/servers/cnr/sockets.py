"""Ports of the socket programs: each takes one client at a time."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

from drivers.errors import ProtocolError
from drivers.wire.cnr import LITTLE, CommType, Message, MessageDecoder, MessageType, Record, ReplyCode, encode
from fake_controller.faults import Faults
from fake_controller.servers.base import accepted, listening_socket, received


class Client:
    """One connection. Its thread reads; any thread may send."""

    def __init__(self, connection: socket.socket, faults: Faults, cut: Callable[[], None]) -> None:
        self._socket, self._faults, self._cut = connection, faults, cut
        self._lock = threading.Lock()

    def send(self, message: Message, spare: bool = False) -> None:
        """Put a message on the wire; `spare` as in `Faults.send`. A client that is gone ends its connection."""
        try:
            with self._lock:
                self._faults.send(encode(message, LITTLE), self._socket.sendall, self._cut, spare)
        except OSError:
            self.close()

    def read(self, heard: Callable[[Message], None]) -> None:
        """Hand on what comes until the connection ends or makes no sense."""
        decoder = MessageDecoder(LITTLE)
        with contextlib.suppress(OSError, ProtocolError):
            for data in received(self._socket, self._faults):
                for message in decoder.feed(data):
                    heard(message)

    def close(self) -> None:
        """End the connection; the reading thread does the rest."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)


class Port:
    """A listening port; whoever comes while it has a client is turned away at once.

    Args:
        address, port: where; port 0 takes a free one.
        faults: of the wire.
        cut: what a pulled cable ends.

    Raises:
        OSError: the port is taken, or the address is not this machine's.
    """

    def __init__(self, address: str, port: int, faults: Faults, cut: Callable[[], None]) -> None:
        self._faults, self._cut = faults, cut
        self._listener = listening_socket(address, port, faults.refusing)
        self.port = self._listener.getsockname()[1]
        self.client: Client | None = None
        self._lock, self._closing = threading.Lock(), threading.Event()
        if not faults.refusing:
            threading.Thread(target=self._accept, name=f"port {self.port}", daemon=True).start()

    def close(self) -> None:
        """Disconnect the client and stop listening."""
        self._closing.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop()

    def hang_up(self) -> None:
        """End the connection, as a pulled cable does."""
        client = self.client
        if client is not None:
            client.close()

    def drop(self) -> None:
        """Disconnect the client; the next may come at once."""
        with self._lock:
            client, self.client = self.client, None
        if client is not None:
            client.close()

    def opened(self) -> None:
        """Called when a client has come."""

    def heard(self, client: Client, message: Message) -> None:
        """Called with what it sends."""
        raise NotImplementedError

    def left(self) -> None:
        """Called when it has gone."""

    def _accept(self) -> None:
        for connection in accepted(self._listener, self._closing):
            with self._lock:
                if self.client is not None or self._closing.is_set():
                    connection.close()
                    continue
                client = self.client = Client(connection, self._faults, self._cut)
            self.opened()
            threading.Thread(target=self._serve, args=(client, connection), name="client", daemon=True).start()

    def _serve(self, client: Client, connection: socket.socket) -> None:
        try:
            client.read(lambda message: self.heard(client, message))
        finally:
            if self.client is client:  # otherwise it was dropped, and another may be here
                self.left()
            with self._lock:
                if self.client is client:
                    self.client = None
            connection.close()


class LockStep(Port):
    """A port where the controller speaks: it sends a record of a `kind`, waits for the answer, and sends the next."""

    def __init__(self, kind: MessageType, address: str, port: int, faults: Faults, cut: Callable[[], None]) -> None:
        self.answers = 0
        self._kind, self._awaited, self._changed = kind, False, threading.Condition()
        super().__init__(address, port, faults, cut)

    @property
    def unanswered(self) -> bool:
        """Whether an answer is to come, or nobody is there who could give one."""
        return self._awaited or self.client is None

    def offer(self, record: Record, spare: bool) -> None:
        """Send a record, unless nobody listens or the answer to the last is still to come."""
        client = self.client
        with self._changed:
            if client is None or self._awaited:
                return
            self._awaited = True
        client.send(Message(self._kind, CommType.REQUEST, ReplyCode.NONE, record), spare)

    def wait(self, timeout: float) -> None:
        """Wait [s] for the answer to the last record, if one is to come."""
        with self._changed:
            self._changed.wait_for(lambda: not self._awaited, timeout)

    def opened(self) -> None:
        with self._changed:
            self._awaited = False
            self._changed.notify_all()

    def left(self) -> None:
        self.opened()

    def drop(self) -> None:
        super().drop()
        self.opened()

    def heard(self, client: Client, message: Message) -> None:
        if (message.type, message.comm, message.reply) == (self._kind, CommType.REPLY, ReplyCode.SUCCESS):
            self.answers += 1
            self.opened()
