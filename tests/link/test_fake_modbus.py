"""The Modbus server over real sockets: clients that are not the driver, and those that mean harm."""

import contextlib
import hashlib
import itertools
import socket
import struct
from contextlib import closing

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from drivers.transports.modbus.driver import ModbusDriver
from drivers.wire import modbus as wire
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.build import build_controller
from fake_controller.faults import Fault
from fake_controller.servers.modbus import registers
from fake_controller.servers.modbus.server import ModbusServer
from tests.link.conftest import LONG, SHORT


@pytest.fixture
def server(arm):
    with closing(ModbusServer(build_controller(arm, 3, "fast"), waits=True)) as server:
        yield server


class ByHand:
    """Registers by hand, for what the driver would never do."""

    def __init__(self, server, session):
        host, _, port = server.address.rpartition(":")
        self.client = ModbusTcpClient(host, port=int(port), timeout=5, retries=0)
        assert self.client.connect()
        self.session = session

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.client.close()

    def write(self, block, **values):
        """0, or the exception."""
        reply = self.client.write_registers(block.address, block.pack(**values))
        return reply.exception_code if reply.isError() else 0

    def read(self, block):
        return block.unpack(self.client.read_holding_registers(block.address, count=block.registers).registers)

    def give(self, request, command, **more):
        blank = {"watchdog": 50, "name": "p", "size": 0, "checksum": b"", "motion": b""}
        values = {**blank, "session": self.session, "request": request, "command": command, **more}
        return self.write(wire.COMMAND, **values)

    def answer(self):
        while (answer := self.read(wire.ANSWER))["outcome"] == wire.OutcomeCode.WORKING:
            pass
        return answer

    def store(self, request, text):
        data = text.encode()
        checksum = hashlib.sha256(data).digest()
        assert self.give(request, wire.Command.UPLOAD_BEGIN, size=len(data), checksum=checksum) == 0
        for at in range(0, len(data), wire.UPLOAD_BYTES):
            part = data[at : at + wire.UPLOAD_BYTES]
            assert self.write(wire.UPLOAD, session=self.session, offset=at, count=len(part), data=part) == 0
        assert self.give(request + 1, wire.Command.UPLOAD_END) == 0
        assert self.answer()["checksum"] == checksum
        return checksum


def test_a_repeated_command_acts_once(server):
    with ByHand(server, 5) as hand:
        assert hand.give(1, wire.Command.OPEN) == 0
        checksum = hand.store(2, SHORT)
        for _ in range(3):
            assert hand.give(4, wire.Command.START, checksum=checksum, motion=b"m" * 16) == 0
        assert hand.answer()["outcome"] == wire.OutcomeCode.DONE
        while server.controller.moving:
            assert hand.write(wire.HEARTBEAT, session=5, count=1, taken=0) == 0
        # As a new command, with the old motion's id.
        assert hand.give(5, wire.Command.START, checksum=checksum, motion=b"m" * 16) == 0
        assert hand.answer()["refusal"] == Refusal.REPEATED_MOTION
    assert server.controller.motions_started == 1


def test_a_client_without_heartbeat_loses_control(server):
    with ByHand(server, 5) as hand:
        assert hand.give(1, wire.Command.OPEN) == 0
        checksum = hand.store(2, LONG)
        assert hand.give(4, wire.Command.START, checksum=checksum, motion=b"m" * 16) == 0
        while hand.read(wire.PROGRESS)["state"] != wire.MotionState.ENDED:
            pass
        assert hand.read(wire.PROGRESS)["reason"] == EndReason.WATCHDOG
        assert "50 ms" in hand.read(wire.END)["message"]
    with closing(ModbusDriver(server.address)) as driver:
        driver.connect()
        assert driver.identify().robot == "small_arm"


def test_a_disconnected_client_gets_no_old_session(arm, monkeypatch):
    """A link that comes back before the client gave up: its motion ran unwatched, so nothing goes on."""
    monkeypatch.setattr(registers, "IDLE_LIMIT", 0.1)
    controller = build_controller(arm, 3, "fast", faults=[Fault(name, "stop") for name in ("silent", "lost_client")])
    with closing(ModbusServer(controller, waits=True)) as server, ByHand(server, 5) as hand:
        assert hand.give(1, wire.Command.OPEN) == 0
        checksum = hand.store(2, SHORT)
        controller.reach("stop")
        hand.client.comm_params.timeout_connect = 0.1
        with pytest.raises(ModbusException):
            hand.give(4, wire.Command.START, checksum=checksum, motion=b"m" * 16)
        session = 5
        while session != 0:  # no answer comes until the link is in order again
            with contextlib.suppress(ModbusException):
                hand.client.connect()
                session = hand.read(wire.PROGRESS)["session"]
        assert hand.write(wire.HEARTBEAT, session=5, count=1, taken=0) == 7
    assert controller.motions_started == 0


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(1, 100), parts=st.lists(st.integers(1, 400), max_size=5))
def test_requests_during_another_request_are_answered(server, count, parts):
    """A client that took a slow answer for lost asks again: the second request must not be the one that is lost."""
    requests = b"".join(
        struct.pack(">HHHBBHH", k, 0, 6, wire.UNIT, 3, wire.IDENTITY.address, 2) for k in range(1, count + 1)
    )
    cuts = sorted({0, len(requests), *(cut for cut in parts if cut < len(requests))})
    with socket.create_connection(("127.0.0.1", server.port), 5) as client, client.makefile("rb") as answers:
        for begin, end in itertools.pairwise(cuts):
            client.sendall(requests[begin:end])
        for k in range(1, count + 1):
            assert struct.unpack(">HHHBBBI", answers.read(13)) == (k, 0, 7, wire.UNIT, 3, 4, wire.MAGIC)


def test_a_client_that_never_waits_for_answers_is_cut_off(server):
    request = struct.pack(">HHHBBHH", 1, 0, 6, wire.UNIT, 3, wire.IDENTITY.address, 2)
    with socket.create_connection(("127.0.0.1", server.port), 5) as client, contextlib.suppress(OSError):
        client.sendall(5000 * request)
        while client.recv(65536):
            pass
    with ByHand(server, 5) as hand:
        assert hand.read(wire.IDENTITY)["magic"] == wire.MAGIC


def test_refuses_invalid_writes(server):
    with ByHand(server, 5) as hand:
        assert hand.write(wire.HEARTBEAT, session=5, count=1, taken=0) == 7
        assert hand.give(1, wire.Command.OPEN, watchdog=5000) == 0
        assert hand.write(wire.HEARTBEAT, session=6, count=1, taken=0) == 6
        assert hand.write(wire.UPLOAD, session=5, offset=0, count=1, data=b"x") == 3
        registers = wire.HEARTBEAT.pack(session=5, count=1, taken=0)
        registers[2] ^= 1
        assert hand.client.write_registers(wire.HEARTBEAT.address, registers).exception_code == 3
        assert hand.client.write_registers(wire.STATUS.address, [0]).exception_code == 2
        assert hand.client.read_holding_registers(3000, count=1).exception_code == 2
        assert hand.give(2, 99) == 0
        assert hand.answer()["refusal"] == Refusal.UNKNOWN_MESSAGE


def test_too_many_connections_are_closed(server):
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(socket.create_connection(("127.0.0.1", server.port), 5)) for _ in range(20)]
        closed = 0
        while closed < 12:
            closed = 0
            for client in clients:
                client.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    closed += client.recv(1) == b""
    with ByHand(server, 5) as hand:
        assert hand.read(wire.IDENTITY)["joints"] == 2
