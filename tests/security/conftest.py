"""Hostile far ends on real sockets."""

import socket
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from pyftpdlib.authorizers import DummyAuthorizer
from pyftpdlib.handlers import FTPHandler
from pyftpdlib.ioloop import IOLoop
from pyftpdlib.servers import FTPServer

from drivers.transports.cnr.address import parse_address
from drivers.transports.cnr.files import ProgramFolder


@pytest.fixture
def ftp_folder(tmp_path: Path) -> Iterator[Callable[..., ProgramFolder]]:
    """A controller's folder of programs with the content that a test puts there: `ftp_folder(name=content)`."""

    @contextmanager
    def served() -> Iterator[int]:
        authorizer = DummyAuthorizer()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            authorizer.add_anonymous(str(tmp_path), perm="elradfmw")
        handler = type("Session", (FTPHandler,), {"authorizer": authorizer})
        loop = IOLoop()
        server = FTPServer(("127.0.0.1", 0), handler, ioloop=loop)
        ending = threading.Event()

        def serve() -> None:
            while not ending.is_set():
                loop.loop(timeout=0.05, blocking=False)
            server.close_all()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield server.socket.getsockname()[1]
        finally:
            ending.set()
            thread.join(5.0)

    with served() as port:

        def folder(**files: bytes) -> ProgramFolder:
            for name, content in files.items():
                (tmp_path / f"{name}.json").write_bytes(content)
            return ProgramFolder(parse_address(f"127.0.0.1,ftp={port}"), 10.0)

        yield folder


@pytest.fixture
def line_server() -> Iterator[Callable[[bytes, int], int]]:
    """Sends the same bytes a number of times to every client: `line_server(data, times)`."""
    open_ones: list[socket.socket] = []

    def start(data: bytes, times: int) -> int:
        listening = socket.create_server(("127.0.0.1", 0))
        open_ones.append(listening)

        def serve() -> None:
            try:
                connection, _ = listening.accept()
                with closing(connection):
                    for _ in range(times):
                        connection.sendall(data)
            except OSError:
                pass

        threading.Thread(target=serve, daemon=True).start()
        return listening.getsockname()[1]

    yield start
    for listening in open_ones:
        listening.close()
