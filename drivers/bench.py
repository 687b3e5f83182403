"""Benches for the conformance suite of wires over TCP: a relay before the controller, and strangers at an address.

docs/how-to-driver.md says how to derive one; `drivers.conformance.Bench` is what the suite asks of it.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack

from drivers.protocol import Driver
from drivers.registry import create


class Relay:
    """Stands in the middle of TCP links to a target; `tamper(outward, data)` says what gets through."""

    def __init__(self, target: tuple[str, int], tamper: Callable[[bool, bytes], bytes]) -> None:
        self.tamper = tamper
        self.sockets: list[socket.socket] = []  # client and server of each link
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def opened(self) -> None:
        """Another link was opened."""

    def close(self) -> None:
        """Cut all links, and take no more."""
        for handle in (self._listener, *self.sockets):
            with contextlib.suppress(OSError):
                handle.shutdown(socket.SHUT_RDWR)
            handle.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.create_connection(self._target)
                for end in (client, server):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self.sockets.append(end)
                self.opened()
                threading.Thread(target=self._carry, args=(client, server, True), daemon=True).start()
                threading.Thread(target=self._carry, args=(server, client, False), daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket, outward: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                target.sendall(self.tamper(outward, data))
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


class WireRelay(Relay):
    """Can be made `silent`, and say once more what the driver said since it opened the link."""

    def __init__(self, target: tuple[str, int]) -> None:
        self.silent = self._swallows = False
        self._sent: list[bytes] = []
        self._answered = threading.Event()
        super().__init__(target, self._pass)

    def opened(self) -> None:
        """Only what is said on this link is said again."""
        self._sent.clear()

    def replay(self) -> None:
        """Say it again, piece by piece; no answer arrives."""
        self._swallows = True
        for data in list(self._sent):
            self._answered.clear()
            self.sockets[-1].sendall(data)
            self._answered.wait(0.05)
        self._swallows = False

    def _pass(self, outward: bool, data: bytes) -> bytes:
        if outward:
            self._sent.append(data)
            return data
        self._answered.set()
        return b"" if self.silent or self._swallows else data


class WireRelays:
    """One in front of each port of a controller; the first is that of the motion."""

    def __init__(self, targets: list[tuple[str, int]]) -> None:
        self.all = [WireRelay(target) for target in targets]
        self.ports = [relay.address.rpartition(":")[2] for relay in self.all]

    @property
    def silent(self) -> bool:
        """Whether nothing that the controller says arrives."""
        return self.all[0].silent

    @silent.setter
    def silent(self, value: bool) -> None:
        for relay in self.all:
            relay.silent = value

    def close(self) -> None:
        """Cut all links."""
        for relay in self.all:
            relay.close()

    def replay(self) -> None:
        """As a relay's."""
        self.all[0].replay()


class SocketBench:
    """What the benches of wires over TCP share.

    A subclass gives `name` of the driver, the attributes of `drivers.conformance.Bench`, `listening`,
    `motions_started` and `moving`. What `undo` holds is undone after each test.
    """

    name: str

    def __init__(self, undo: ExitStack) -> None:
        self.undo = undo
        self.wire = self.connect_wire()

    def listening(self) -> tuple[str, int]:
        """Host and port of the controller."""
        raise NotImplementedError

    def wait(self, seconds: float) -> float:
        """The limit [s] that a driver gets where an idle machine keeps this one."""
        return seconds

    def driver(self) -> Driver:
        """One for the controller, not connected."""
        return self.created(self.address, watchdog=self.wait(2.0), timeout=self.wait(2.0))

    def created(self, address: str, **options: object) -> Driver:
        """A driver for an address, closed after the test."""
        driver = create(self.name, address, **options)
        self.undo.callback(driver.close)
        return driver

    def cut(self) -> None:
        """Pull the cable out."""
        self.wire.close()

    def silence(self) -> None:
        """Nothing that the controller says arrives any more."""
        self.wire.silent = True

    def replay(self) -> None:
        """Send the controller once more what it was sent since the link was opened."""
        self.wire.replay()

    def connect_wire(self) -> WireRelay | WireRelays:
        """Put a relay in front of the controller, whose `address` a driver gets."""
        relay = WireRelay(self.listening())
        self.undo.callback(relay.close)
        self.address = relay.address
        return relay

    def nobody(self) -> Driver:
        """A driver for an address where there is nothing."""
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        return self.created(f"127.0.0.1:{port}")

    def mute(self) -> Driver:
        """A driver for somebody who never says anything."""
        return self.answering(b"")

    def stranger(self) -> Driver:
        """A driver for somebody who answers in another protocol."""
        return self.answering(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n")

    def answering(self, answer: bytes, greeting: bytes = b"") -> Driver:
        """A driver for somebody who says the same whatever is said."""
        listener = socket.create_server(("127.0.0.1", 0))
        self.undo.callback(listener.close)

        def serve() -> None:
            with contextlib.suppress(OSError):
                client, _ = listener.accept()
                with client:
                    client.sendall(greeting)
                    while client.recv(65536):
                        client.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        return self.created(f"127.0.0.1:{listener.getsockname()[1]}", timeout=self.wait(0.5))
