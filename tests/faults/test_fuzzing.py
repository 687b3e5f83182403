"""Hostile input at every server and every driver: no crash, no unbounded memory, and the next peer is served."""

import contextlib
import resource
import socket
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.registry import create
from drivers.wire import modbus, tcp
from fake_controller.build import build_controller
from fake_controller.servers import open_server

FRAMES = [pytest.param(300, id="some"), pytest.param(100_000, id="all", marks=pytest.mark.verify)]
GROWTH = 100  # MiB
PATIENCE = 0.005  # s for an answer: the far end is on this machine, and half of what it says is worth none
CHECKSUM = "0" * 64
SESSION = 5

REQUESTS = (
    tcp.Hello(1, 5000, "x"),
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
IDENTITY = tcp.IdentityReply("small_arm", "1", "c", "1", ("a", "b"), 0.002)
REPLIES = (
    tcp.Done(),
    tcp.Samples(0, np.arange(3) * 2_000_000, *(VALUES for _ in range(5))),
    tcp.End(0, 3, "done"),
    tcp.Refused(1, 0, 0, "no"),
    tcp.StatusReply(True, "auto", False, (), 1.0, True, False, "p", CHECKSUM, (0.0, 0.0), True),
    IDENTITY,
    tcp.Heartbeat(),
)


class Frames:
    """How `tcp` packs its messages."""

    def requests(self) -> list[bytes]:
        """One sane frame of each kind that a client sends."""
        return [tcp.encode(message, 1) for message in REQUESTS]

    def changed(self, rng: np.random.Generator, frame: bytes) -> bytes:
        """The frame with one byte of its content changed, and its checksums right again."""
        body = bytearray(frame[:-4])
        if len(body) > tcp.HEADER.size:
            body[rng.integers(tcp.HEADER.size, len(body))] = int(rng.integers(256))
        return bytes(body) + struct.pack("<I", zlib.crc32(body))


class Registers:
    """How `modbus` does: a message is unit, function, and what belongs to it, in an envelope."""

    def envelope(self, message: bytes, transaction: int = 1) -> bytes:
        return struct.pack(">HHH", transaction, 0, len(message)) + message

    def message(self, frame: bytes) -> bytes:
        return frame[6:]

    def transaction(self, frame: bytes) -> int:
        return struct.unpack_from(">H", frame)[0]

    def requests(self) -> list[bytes]:
        reads = [(block.address, block.registers) for block in modbus.BLOCKS] + [(modbus.RING, 100), (3000, 125)]
        frames = [struct.pack(">BBHH", modbus.UNIT, 3, *read) for read in reads]
        blank = {"session": SESSION, "watchdog": 200, "name": "p", "size": 40, "checksum": b"", "motion": b"m" * 16}
        for number, command in enumerate(modbus.Command):
            frames.append(self._write(modbus.COMMAND, **blank, request=number + 1, command=command))
        frames.append(self._write(modbus.UPLOAD, session=SESSION, offset=0, count=5, data=b"abcde"))
        frames.append(self._write(modbus.HEARTBEAT, session=SESSION, count=1, taken=0))
        return [self.envelope(frame) for frame in frames]

    def changed(self, rng: np.random.Generator, frame: bytes) -> bytes:
        message = bytearray(self.message(frame))
        message[rng.integers(1, len(message))] = int(rng.integers(256))
        content = 7 if message[1] == 16 else 3
        if len(message) > content + 4:
            message[-4:] = struct.pack(">I", zlib.crc32(message[content:-4]))
        return self.envelope(bytes(message), self.transaction(frame))

    def take(self, waiting: bytes) -> tuple[list[bytes], bytes]:
        """The whole requests in what came, and what is left of it; what is no request is passed over."""
        taken, at = [], 0
        while len(waiting) - at >= 12:
            function = waiting[at + 7]
            if function == 16 and len(waiting) - at < 13:
                break
            size = 13 + waiting[at + 12] if function == 16 else 12
            frame = waiting[at : at + size]
            if function in (3, 16) and len(frame) < size:
                break
            whole = function in (3, 16) and frame == self.envelope(self.message(frame), self.transaction(frame))
            taken += [frame] if whole else []
            at += size if whole else 1
        return taken, waiting[at:]

    def _write(self, block: modbus.Block, **values: Any) -> bytes:
        registers = block.pack(**values)
        head = struct.pack(">BBHHB", modbus.UNIT, 16, block.address, len(registers), 2 * len(registers))
        return head + struct.pack(f">{len(registers)}H", *registers)


Framing = Frames | Registers
FRAMINGS: dict[str, Framing] = {"tcp": Frames(), "modbus": Registers()}


def fuzzed(rng: np.random.Generator, framing: Framing, frame: bytes, wild: float) -> bytes:
    """A sane frame with its content changed under right checksums, or, at a share `wild`, something worse."""
    if rng.random() > wild:
        return framing.changed(rng, frame)
    damaged = bytearray(frame)
    match int(rng.integers(4)):
        case 0:
            return rng.bytes(int(rng.integers(1, 300)))
        case 1:
            return frame[: int(rng.integers(1, len(frame) + 1))]
        case 2:
            damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
        case _:  # lengths stand near the front
            damaged[rng.integers(min(16, len(damaged)))] = int(rng.integers(256))
    return bytes(damaged)


def memory() -> float:
    """Most that this process ever had [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("wire", FRAMINGS)
def test_fuzzed_frames_at_the_server(arm, measured, wire, frames):
    rng, framing = np.random.default_rng(1), FRAMINGS[wire]
    sane, sent = framing.requests(), 0
    with closing(open_server(wire, build_controller(arm, 3, "fast"))) as server:
        before = memory()
        while sent < frames:
            with socket.create_connection(("127.0.0.1", server.port), 20) as client, contextlib.suppress(OSError):
                client.settimeout(0.002)
                client.sendall(sane[0])
                for _ in range(50):
                    client.sendall(fuzzed(rng, framing, sane[rng.integers(len(sane))], wild=0.05))
                    sent += 1
                    if sent % 5 == 0:
                        with contextlib.suppress(TimeoutError):
                            client.recv(1 << 16)
        growth = memory() - before
        with closing(create(wire, server.address)) as driver:
            _connect_when_free(driver)
            assert driver.identify().robot == "small_arm"
    measured(f"{wire}: fuzzed frames at the server, crashes", f"{sent}, 0", "", "none")
    measured(f"{wire}: memory that grew by them", growth, "MiB", f"below {GROWTH}", growth < GROWTH)
    assert growth < GROWTH


@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("wire", FRAMINGS)
def test_fuzzed_frames_at_the_driver(measured, wire, frames):
    before = memory()
    with closing(FOES[wire](wire)) as foe:
        while foe.fuzzed < frames:
            assert foe.lives
            driver = create(wire, foe.address, timeout=PATIENCE, start_timeout=4 * PATIENCE)
            with closing(driver), contextlib.suppress(DriverError):
                driver.connect()
                driver.identify()
                driver.start("p", CHECKSUM)
                for block in driver.samples():
                    assert block.position.shape[0] == len(block)
        growth = memory() - before
    measured(f"{wire}: fuzzed frames at the driver, crashes", f"{foe.fuzzed}, 0", "", "none")
    measured(f"{wire}: memory that grew by them at the driver", growth, "MiB", f"below {GROWTH}", growth < GROWTH)
    assert growth < GROWTH


class Foe:
    """Somebody at the far end of the wire; `answers` says with what, one client at a time."""

    def __init__(self, wire: str) -> None:
        self.fuzzed = 0
        self.framing = FRAMINGS[wire]
        self._rng = np.random.default_rng(2)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def lives(self) -> bool:
        """Whether it still answers; what ended it is a warning of pytest's."""
        return self._thread.is_alive()

    def close(self) -> None:
        self._listener.close()

    def answers(self) -> Callable[[bytes], Iterator[bytes]]:
        """A function from what came to what is sent, for a new client; no more to send ends the connection."""
        raise NotImplementedError

    def spoiled(self, frame: bytes) -> bytes:
        """The frame, fuzzed and counted."""
        self.fuzzed += 1
        return fuzzed(self._rng, self.framing, frame, wild=0.05)

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                answer = self.answers()
                with connection, contextlib.suppress(OSError):
                    while data := connection.recv(65536):
                        for frame in answer(data):
                            connection.sendall(frame)


class FramesFoe(Foe):
    """Greets, says who it is, takes the start, and goes on with whatever; then it hangs up, or falls silent."""

    BATCH = 100

    def answers(self) -> Callable[[bytes], Iterator[bytes]]:
        decoder = tcp.FrameDecoder(tcp.MAX_REQUEST_PAYLOAD)

        def answer(data: bytes) -> Iterator[bytes]:
            for frame in decoder.feed(data):
                match tcp.decode(frame):
                    case tcp.Hello():
                        yield tcp.encode(tcp.Welcome(tcp.VERSION, 100), frame.request)
                    case tcp.Identify():
                        yield tcp.encode(IDENTITY, frame.request)
                    case tcp.Start(motion_id=motion):
                        yield tcp.encode(tcp.Started(motion), frame.request)
                        for _ in range(self.BATCH):
                            message = REPLIES[self._rng.integers(len(REPLIES))]
                            yield self.spoiled(tcp.encode(message, int(self._rng.integers(4))))

        return answer


class RegistersFoe(Foe):
    """Has all the registers, and says another thing than they hold half of the time."""

    def answers(self) -> Callable[[bytes], Iterator[bytes]]:
        content = self._content()
        state = {"session": 0, "request": 0, "motion": b"", "beat": 0}
        waiting = b""

        def answer(data: bytes) -> Iterator[bytes]:
            nonlocal waiting
            # On a busy machine a request comes in pieces, or together with the next one.
            requests, waiting = self.framing.take(waiting + data)
            for request in requests:
                frame = self.framing.envelope(reply(self.framing.message(request)), self.framing.transaction(request))
                yield self.spoiled(frame) if self._rng.random() < 0.5 else frame

        def reply(message: bytes) -> bytes:
            function, address, count = struct.unpack_from(">BHH", message, 1)
            if function == 16:
                if address == modbus.COMMAND.address:
                    state.update(modbus.COMMAND.unpack(struct.unpack(f">{count}H", message[7:])))
                return message[:6]
            state["beat"] += 1
            content.update(self._changing(state))
            registers = [content.get(address + k, 0) for k in range(count)]
            return struct.pack(f">BBB{count}H", modbus.UNIT, 3, 2 * count, *registers)

        return answer

    def _content(self) -> dict[int, int]:
        identity = {"robot": "small_arm", "serial": "1", "controller": "c", "software": "1"}
        slots = modbus.slot_count(2)
        blocks = {modbus.IDENTITY: modbus.IDENTITY.pack(
            magic=modbus.MAGIC, version=modbus.VERSION, joints=2, period=2_000_000, slots=slots, **identity
        )}  # fmt: skip
        blocks |= {block: block.pack(names=("a", "b")) for block in modbus.NAMES}
        blocks[modbus.END] = modbus.END.pack(message="done")
        content = {block.address + k: value for block, registers in blocks.items() for k, value in enumerate(registers)}
        rows = modbus.pack_slots(0, np.arange(slots) * 2_000_000, [np.zeros((slots, 2))] * 5)
        return content | {modbus.RING + k: int(value) for k, value in enumerate(rows.ravel())}

    def _changing(self, state: dict[str, Any]) -> dict[int, int]:
        answer = modbus.ANSWER.pack(
            session=state["session"],
            request=state["request"],
            outcome=modbus.OutcomeCode.DONE,
            refusal=0,
            line=0,
            column=0,
            message="",
            checksum=b"",
            watchdog=100,
        )
        progress = modbus.PROGRESS.pack(
            heartbeat=state["beat"] % 65536,
            session=state["session"],
            state=modbus.MotionState.RUNNING,
            motion=state["motion"],
            samples=state["beat"],
            oldest=0,
            reason=0,
        )
        pairs = ((modbus.ANSWER, answer), (modbus.PROGRESS, progress))
        return {block.address + k: value for block, registers in pairs for k, value in enumerate(registers)}


FOES: dict[str, type[Foe]] = {"tcp": FramesFoe, "modbus": RegistersFoe}


def _connect_when_free(driver: Any) -> None:
    while True:
        try:
            driver.connect()
            return
        except DriverError:
            continue
