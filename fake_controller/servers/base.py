"""What every server offers, and what those over sockets share."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Protocol

#: Host and port of the MQTT broker that `cnr_comau` publishes to.
BROKER = ("127.0.0.1", 1883)


class NoBrokerError(OSError):
    """No MQTT broker answers where one is expected."""


class Server(Protocol):
    """`address` is what the driver of its wire takes."""

    address: str

    def close(self) -> None:
        """Bring the arm to rest and stop serving."""


def deaf_socket(address: str, port: int) -> socket.socket:
    """It holds its port, and whoever connects is refused.

    Raises:
        OSError: the port is taken, or is not this machine's.
    """
    bound = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET)
    bound.bind((address, port))
    return bound


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
        yield connection
