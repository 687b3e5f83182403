"""Hostile input at the server and at the driver: no crash, no unbounded memory, and the next peer is served."""

from __future__ import annotations

import contextlib
import resource
import socket
import struct
import threading
import zlib
from contextlib import closing

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.tcp import TcpDriver
from drivers.wire import tcp
from fake_controller.build import build_controller
from fake_controller.server_tcp import TcpServer

FRAMES = [pytest.param(2_000), pytest.param(100_000, marks=pytest.mark.verify)]
GROWTH = 100  # MiB
CHECKSUM = "0" * 64

REQUESTS = (
    tcp.Hello(1, 200, "x"),
    tcp.Identify(),
    tcp.AskStatus(),
    tcp.UploadBegin("p", 40, CHECKSUM),
    tcp.UploadBlock(0, b"PROGRAM p\n"),
    tcp.UploadEnd(),
    tcp.Start("p", CHECKSUM, b"m" * 16),
    tcp.Stop(),
    tcp.Fetch(0, 1000),
    tcp.Heartbeat(),
)
VALUES = np.zeros((3, 2))
REPLIES = (
    tcp.Done(),
    tcp.Samples(0, np.arange(3) * 2_000_000, *(VALUES for _ in range(5))),
    tcp.End(0, 3, "done"),
    tcp.Refused(1, 0, 0, "no"),
    tcp.StatusReply(True, "auto", False, (), 1.0, True, False, "p", CHECKSUM, (0.0, 0.0), True),
    tcp.IdentityReply("small_arm", "1", "c", "1", ("a", "b"), 0.002),
    tcp.Heartbeat(),
)


def sealed(kind: int, payload: bytes, request: int = 1) -> bytes:
    """A frame whose checksum is right, whatever is in it."""
    body = tcp.HEADER.pack(tcp.MAGIC, tcp.VERSION, kind, 0, len(payload), request) + payload
    return body + struct.pack("<I", zlib.crc32(body))


def fuzzed(rng: np.random.Generator, sane: tuple[object, ...], wild: float) -> bytes:
    """A frame: a sane message with bytes changed under a right checksum, or, at a share `wild`, something worse."""
    message = sane[rng.integers(len(sane))]
    payload = bytearray(message.pack())
    if rng.random() > wild:
        if payload and rng.random() < 0.5:
            payload[rng.integers(len(payload))] = int(rng.integers(256))
        return sealed(message.TYPE, bytes(payload), int(rng.integers(0, 2**32)))
    match int(rng.integers(5)):
        case 0:
            return rng.bytes(int(rng.integers(1, 300)))
        case 1:
            return sealed(int(rng.integers(256)), rng.bytes(int(rng.integers(0, 300))))
        case 2:
            frame = bytearray(sealed(message.TYPE, bytes(payload)))
            frame[rng.integers(len(frame))] ^= 1 << int(rng.integers(8))
            return bytes(frame)
        case 3:
            return sealed(message.TYPE, bytes(payload))[: int(rng.integers(1, 20))]
        case _:
            return tcp.HEADER.pack(tcp.MAGIC, tcp.VERSION, message.TYPE, 0, int(rng.integers(2**32)), 1)


def memory() -> float:
    """Most that this process ever had [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.parametrize("frames", FRAMES)
def test_fuzzed_frames_at_the_server(arm, measured, frames):
    rng = np.random.default_rng(1)
    sent = 0
    with closing(TcpServer(build_controller(arm, 3, "fast"))) as server:
        before = memory()
        while sent < frames:
            with socket.create_connection(("127.0.0.1", server.port), 20) as client:
                reader = threading.Thread(target=_swallow, args=(client,), daemon=True)
                reader.start()
                with contextlib.suppress(OSError):
                    client.sendall(tcp.encode(tcp.Hello(1, 5000, "fuzz"), 1))
                    for _ in range(50):
                        client.sendall(fuzzed(rng, REQUESTS, wild=0.02))
                        sent += 1
                    client.shutdown(socket.SHUT_WR)
                reader.join(20)
        growth = memory() - before
        with closing(TcpDriver(server.address)) as driver:
            _until_free(driver)
            assert driver.identify().robot == "small_arm"
    measured("fuzzed frames at the TCP server", sent, "frames", "no crash", True)
    measured("memory that grew by them", growth, "MiB", f"below {GROWTH}", growth < GROWTH)
    assert growth < GROWTH


@pytest.mark.parametrize("frames", FRAMES)
def test_fuzzed_frames_at_the_driver(measured, frames):
    rng = np.random.default_rng(2)
    before, taken = memory(), 0
    with closing(_Foe()) as foe:
        while taken < frames:
            batch = [fuzzed(rng, REPLIES, wild=0.01) for _ in range(25)]
            with closing(TcpDriver(foe.address, timeout=5.0, start_timeout=5.0)) as driver:
                foe.batch = batch
                try:
                    driver.connect()
                    driver.start("p", CHECKSUM)
                    for block in driver.samples():
                        assert block.position.shape[0] == len(block)
                except DriverError:
                    pass
            taken += len(batch)
    growth = memory() - before
    measured("fuzzed frames at the TCP driver", taken, "frames", "no crash", True)
    assert growth < GROWTH


class _Foe:
    """Greets, takes the start, and answers with a batch of frames; one client at a time."""

    def __init__(self) -> None:
        self.batch: list[bytes] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                self._answer(connection)

    def _answer(self, connection: socket.socket) -> None:
        decoder = tcp.Decoder(tcp.MAX_REQUEST_PAYLOAD)
        while data := connection.recv(65536):
            for frame in decoder.feed(data):
                message = tcp.decode(frame)
                if isinstance(message, tcp.Hello):
                    connection.sendall(tcp.encode(tcp.Welcome(tcp.VERSION, 5000), frame.request))
                elif isinstance(message, tcp.Start):
                    connection.sendall(tcp.encode(tcp.Started(message.motion_id), frame.request))
                    connection.sendall(b"".join(self.batch))
                    connection.shutdown(socket.SHUT_RDWR)
                    return


def _swallow(client: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while client.recv(1 << 16):
            pass


def _until_free(driver: TcpDriver) -> None:
    while True:
        try:
            driver.connect()
            return
        except DriverError:
            continue
