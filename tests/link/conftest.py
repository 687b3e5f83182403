"""A peer on a real socket that does exactly what a test's script says, good or bad."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from drivers.bench import Relay
from drivers.wire import tcp
from tests.conftest import drawn
from tests.link.cnr_peer import Bench, program

#: Where the small arm goes [degrees].
FAR = drawn("{20, -30}", lambda rng: f"{{{rng.integers(15, 25)}, {-rng.integers(25, 35)}}}")
#: A second of motion there and back, and minutes of it.
SHORT = program(f"  MOVE JOINT TO {FAR}\n  MOVE JOINT TO {{0, 0}}")
LONG = program(f"  FOR k := 1 TO 500 DO\n    MOVE JOINT TO {FAR}\n    MOVE JOINT TO {{-20, 30}}\n  ENDFOR")


def start(driver, text):
    """The samples of program `p` of this text, which is stored and started."""
    driver.start("p", driver.upload("p", text))
    return driver.samples()


class Peer:
    """The controller's end of one connection, frame by frame."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self._decoder = tcp.FrameDecoder(tcp.MAX_REQUEST_PAYLOAD)
        self._frames: list[tcp.Frame] = []

    def receive(self) -> tuple[object, int]:
        """Next message that is not a heartbeat, and its request id; raises EOFError when the driver has left."""
        while True:
            message, request = self._next()
            if not isinstance(message, tcp.Heartbeat):
                return message, request

    def heartbeat(self) -> None:
        """Wait for a heartbeat."""
        while not isinstance(self._next()[0], tcp.Heartbeat):
            pass

    def _next(self) -> tuple[object, int]:
        while not self._frames:
            data = self.socket.recv(65536)
            if not data:
                raise EOFError
            self._frames += self._decoder.feed(data)
        frame = self._frames.pop(0)
        return tcp.decode(frame), frame.request

    def expect(self, kind: type) -> tuple[object, int]:
        message, request = self.receive()
        assert isinstance(message, kind), message
        return message, request

    def send(self, message: object, request: int = 0) -> None:
        self.socket.sendall(tcp.encode(message, request))

    def welcome(self, watchdog_ms: int = 2000) -> None:
        _, request = self.expect(tcp.Hello)
        self.send(tcp.Welcome(tcp.VERSION, watchdog_ms), request)

    def begin_motion(self, watchdog_ms: int = 2000) -> None:
        self.welcome(watchdog_ms)
        start, request = self.expect(tcp.Start)
        self.send(tcp.Started(start.motion_id), request)

    def until_left(self) -> None:
        """Take whatever comes until the driver leaves."""
        try:
            while True:
                self.receive()
        except (EOFError, OSError):
            pass


@pytest.fixture
def peer() -> Iterator[Callable[[Callable[[Peer], None]], str]]:
    """`peer(script)` listens, runs the script with the first client in a thread, and returns the address."""
    listeners, threads, failures = [], [], []

    def run(script: Callable[[Peer], None]) -> str:
        listener = socket.create_server(("127.0.0.1", 0))
        listeners.append(listener)

        def serve() -> None:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                connection.settimeout(20)
                try:
                    script(Peer(connection))
                except EOFError:
                    pass
                except BaseException as error:
                    failures.append(error)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        threads.append(thread)
        return f"127.0.0.1:{listener.getsockname()[1]}"

    yield run
    for listener in listeners:
        listener.close()
    for thread in threads:
        thread.join(20)
    assert not failures, failures


@pytest.fixture
def tampered() -> Iterator[Callable[[int, Callable[[bool, bytes], bytes]], str]]:
    """`tampered(port, tamper)` is the address of a relay in front of a port."""
    with contextlib.ExitStack() as undo:
        yield lambda port, tamper: undo.enter_context(contextlib.closing(Relay(("127.0.0.1", port), tamper))).address


@pytest.fixture
def serve(arm, broker) -> Iterator[Callable[..., Bench]]:
    """`serve(robot, **options)`: the fake for CNR's programs, and whoever talks to it."""
    with contextlib.ExitStack() as undo:
        yield lambda robot=arm, **options: Bench(robot, broker, undo, **options)


@pytest.fixture
def bench(serve) -> Bench:
    """One of these, as fast as it goes."""
    return serve()
