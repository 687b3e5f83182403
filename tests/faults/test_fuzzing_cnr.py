"""Hostile input at the three sockets of a real controller's link: no crash, no unbounded memory, the next is served."""

import contextlib
import socket
import struct
from contextlib import closing

import numpy as np
import pytest

from fake_controller.build import build_controller
from fake_controller.servers.cnr.server import CnrServer
from tests.faults.test_fuzzing import GROWTH, memory

FRAMES = [pytest.param(2_000), pytest.param(100_000, marks=pytest.mark.verify)]
#: Length and types of what each port takes.
PORTS = ((76, (1, 3001, 3002, 3010, 3011, 3012, 3020)), (204, (3004,)), (40, (13,)))
PING = struct.pack("<4i", 76, 1, 2, 0) + bytes(64)


def fuzzed(rng: np.random.Generator, length: int, types: tuple[int, ...]) -> bytes:
    """A frame with any body; one in fifty has a damaged header, or is none."""
    kind, comm = int(rng.choice(types)), int(rng.integers(1, 4))
    frame = bytearray(struct.pack("<4i", length, kind, comm, int(rng.integers(3))) + rng.bytes(length - 12))
    if kind == 3001 and rng.random() < 0.8:  # points that a queue may take
        struct.pack_into("<3i 2f 10f", frame, 16, 1, 0, int(rng.integers(1, 4)), *rng.normal(0, 20, 12))
    if rng.random() > 0.02:
        return bytes(frame)
    match int(rng.integers(3)):
        case 0:
            return rng.bytes(int(rng.integers(1, 300)))
        case 1:
            return bytes(frame[: rng.integers(1, len(frame))])
        case _:
            frame[rng.integers(16)] ^= 1 << int(rng.integers(8))
            return bytes(frame)


@pytest.mark.parametrize("frames", FRAMES)
def test_fuzzed_frames_at_the_sockets(arm, broker, measured, frames):
    rng, sent = np.random.default_rng(1), 0
    with closing(CnrServer(build_controller(arm, 3, "fast"), broker=broker.address, waits=True)) as server:
        before = memory()
        while sent < frames:
            for port, (length, types) in zip(server.ports, PORTS, strict=False):
                with socket.create_connection(("127.0.0.1", port), 20) as client, contextlib.suppress(OSError):
                    for _ in range(50):
                        client.sendall(fuzzed(rng, length, types))
                        sent += 1
                    client.shutdown(socket.SHUT_WR)
                    while client.recv(1 << 16):
                        pass
        growth = memory() - before
        _until_served(server.ports[0])
    measured("fuzzed frames at the three sockets of cnr_comau", sent, "frames", "no crash", True)
    measured("memory that grew by them", growth, "MiB", f"below {GROWTH}", growth < GROWTH)
    assert growth < GROWTH


def _until_served(port: int) -> None:
    while True:
        with socket.create_connection(("127.0.0.1", port), 20) as client, contextlib.suppress(OSError):
            client.sendall(PING)
            if client.recv(80)[4:16] == struct.pack("<3i", 1, 3, 1):
                return
