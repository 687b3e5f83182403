"""Interface of every server, and shared code of those over sockets."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

from drivers.wire.reasons import EndReason
from fake_controller.faults import Faults

if TYPE_CHECKING:
    from fake_controller.controller import Controller

#: Host and port of the MQTT broker that `cnr_comau` publishes to.
BROKER = ("127.0.0.1", 1883)
#: Time [s] after which a client that takes nothing is dropped, and bytes taken at once.
SEND_LIMIT, RECEIVE = 5.0, 64 * 1024
#: Silence [s] after which nobody is taken to be at the other end.
IDLE_LIMIT = 5.0


class NoBrokerError(OSError):
    """No MQTT broker answers where one is expected."""


class Server(Protocol):
    """`address` is what the driver of its wire takes."""

    address: str

    def close(self) -> None:
        """Bring the arm to rest and stop serving."""


def listening_socket(address: str, port: int, deaf: bool = False, backlog: int | None = None) -> socket.socket:
    """A listening socket; a deaf one holds its port, and whoever connects is refused.

    Raises:
        OSError: the port is taken, or the address is not this machine's.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    if not deaf:
        return socket.create_server((address, port), family=family, backlog=backlog)
    bound = socket.socket(family)
    bound.bind((address, port))
    return bound


def name_of(where: tuple[Any, ...]) -> str:
    """`host:port` of a socket's own address, as a driver takes it."""
    host, port = where[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def stop_unheard(controller: Controller, watchdog: float) -> None:
    """Bring the arm to rest, as its client has been silent for its watchdog [s]."""
    controller.stop(EndReason.WATCHDOG, f"nothing was heard from the client for {watchdog * 1000:.0f} ms")


def accepted(listener: socket.socket, closing: threading.Event) -> Iterator[socket.socket]:
    """Connections as they come, until `closing` is set and the listener closed."""
    while not closing.is_set():
        try:
            connection, _ = listener.accept()
        except OSError:
            if closing.is_set():
                return
            time.sleep(0.1)  # out of file handles; some come back
            continue
        connection.settimeout(SEND_LIMIT)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection


def received(connection: socket.socket, faults: Faults) -> Iterator[bytes]:
    """What comes, as the faults let it through, until the client leaves."""
    while True:
        with contextlib.suppress(TimeoutError):
            data = connection.recv(RECEIVE)
            if not data:
                return
            yield faults.heard(data)
