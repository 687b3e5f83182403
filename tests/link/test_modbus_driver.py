"""The Modbus driver and its server over real sockets: what the conformance suite does not reach."""

import contextlib
import hashlib
import itertools
import socket
import struct
import threading
import time
from concurrent.futures import Future
from contextlib import closing

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from drivers.errors import ConfigurationError, DriverError, MotionStopped, ProtocolError, RefusedError
from drivers.protocol import Gap
from drivers.transports.modbus import link
from drivers.transports.modbus.driver import ModbusDriver
from drivers.wire import modbus as wire
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.build import build_controller
from fake_controller.servers.modbus import registers
from fake_controller.servers.modbus.server import ModbusServer
from tests.conftest import patience
from tests.link.conftest import LONG, SHORT, program


@pytest.fixture
def server(arm):
    with closing(ModbusServer(build_controller(arm, 3, "fast"), waits=True)) as server:
        yield server


@pytest.fixture
def driver(server):
    with closing(ModbusDriver(server.address, watchdog=patience(2.0))) as driver:
        driver.connect()
        yield driver


def start(driver, text):
    driver.start("p", driver.upload("p", text))
    return driver.samples()


def sequence(blocks):
    return np.concatenate([block.sequence for block in blocks])


def test_what_tcp_and_modbus_tell_is_the_same(arm):
    """The same machine with the same seed on both wires, but for single precision."""
    from drivers.transports.tcp import TcpDriver
    from fake_controller.servers.tcp import TcpServer

    runs = []
    for server_class, driver_class in ((TcpServer, TcpDriver), (ModbusServer, ModbusDriver)):
        with (
            closing(server_class(build_controller(arm, 5, "fast"))) as server,
            closing(driver_class(server.address, watchdog=patience(2.0))) as driver,
        ):
            driver.connect()
            blocks = list(start(driver, SHORT))
            status = driver.status()
            runs.append((driver.identify(), blocks, status))
    (one, first, before), (other, second, after) = runs
    assert one == other
    for name in ("time", "position", "velocity", "torque", "reference_position", "reference_velocity"):
        left, right = (np.concatenate([getattr(block, name) for block in blocks]) for blocks in (first, second))
        np.testing.assert_allclose(left, right, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(before.position, after.position)
    assert before.checksum == after.checksum


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"emergency_stop": True}, "emergency stop"),
        ({"drives_on": False}, "drives off"),
        ({"mode": "teach"}, "teach mode"),
        ({"alarms": ("62513", "28")}, "alarm.*62513"),
        ({"cell_closed": False}, "cell open"),
    ],
)
def test_a_state_that_forbids_motion(driver, server, changes, message):
    checksum = driver.upload("p", SHORT)
    for name, value in changes.items():
        setattr(server.controller.state, name, value)
        assert getattr(driver.status(), name) == value
    with pytest.raises(RefusedError, match=message):
        driver.start("p", checksum)
    assert server.controller.motions_started == 0


def test_a_syntax_error_is_refused_with_its_place(driver):
    with pytest.raises(RefusedError, match=r"syntax, line 5 column \d+.*FLIP"):
        driver.upload("p", program("  FLIP TO {20, -30}"))


def test_a_name_that_would_be_cut(driver):
    with pytest.raises(RefusedError, match="32 bytes"):
        driver.upload("p" * 33, SHORT)


def test_a_safety_stop_is_told_as_one(driver, server):
    received = start(driver, LONG)
    next(received)
    server.controller.stop(EndReason.PROTECTIVE_STOP, "someone opened the gate")
    blocks = []
    with pytest.raises(MotionStopped, match=r"protective stop.*opened the gate"):
        blocks.extend(received)
    np.testing.assert_allclose(blocks[-1].reference_velocity[-1], 0, atol=1e-6)


def test_what_is_overwritten_before_it_was_read_is_a_gap(arm, tampered):
    """A controller that keeps little, and a wire that is held up at the first look at the ring."""
    with closing(ModbusServer(build_controller(arm, 3, "fast"), memory=300)) as server:
        held = []

        def hold(outward, data):
            if outward and not held and data[7] == 3 and struct.unpack(">H", data[8:10])[0] >= wire.RING:
                held.append(True)
                while server.controller.moving:
                    time.sleep(0.001)
            return data

        with closing(ModbusDriver(tampered(server.port, hold), watchdog=patience(5.0))) as driver:
            driver.connect()
            blocks = list(start(driver, SHORT))
            total = 1 + int(blocks[-1].sequence[-1])
            assert driver.gaps == (Gap(0, total - 300),)
            np.testing.assert_array_equal(sequence(blocks), np.arange(total - 300, total))


def test_a_sample_that_arrives_damaged_is_read_again(server, tampered):
    damaged = []

    def damage(outward, data):
        if not outward and len(data) > 240 and len(damaged) < 5 and server.controller.motions_started:
            damaged.append(True)
            return data[:100] + bytes([data[100] ^ 4]) + data[101:]
        return data

    with closing(ModbusDriver(tampered(server.port, damage), watchdog=patience(2.0))) as driver:
        driver.connect()
        blocks = list(start(driver, SHORT))
        assert len(damaged) == 5
        assert driver.gaps == ()
        np.testing.assert_array_equal(sequence(blocks), np.arange(1 + blocks[-1].sequence[-1]))
        assert np.abs(np.concatenate([block.position for block in blocks])).max() < 1


def test_a_start_whose_answer_is_lost_is_not_given_again(server, tampered):
    starts = []

    def swallow(outward, data):
        if outward and data[7] == 16 and data[8:10] == struct.pack(">H", wire.COMMAND.address):
            values = wire.COMMAND.unpack(struct.unpack(f">{wire.COMMAND.registers}H", data[13:]))
            if values["command"] == wire.Command.START:
                starts.append(values)
        return b"" if starts and not outward else data

    with closing(ModbusDriver(tampered(server.port, swallow), watchdog=patience(0.5), timeout=patience(1.0))) as driver:
        driver.connect()
        checksum = driver.upload("p", LONG)
        with pytest.raises(DriverError, match="silent"):
            driver.start("p", checksum)
        with pytest.raises(DriverError, match="not open"):
            driver.status()
    assert len(starts) == 1
    assert server.controller.motions_started == 1
    while server.controller.moving:
        time.sleep(0.001)


def test_one_lost_answer_to_a_start_leaves_no_motion_unwatched(server, tampered):
    """The start is given once; what became of it is read, and all its samples come."""
    starts, lost = [], []

    def swallow(outward, data):
        if outward and data[7] == 16 and data[8:10] == struct.pack(">H", wire.COMMAND.address):
            values = wire.COMMAND.unpack(struct.unpack(f">{wire.COMMAND.registers}H", data[13:]))
            if values["command"] == wire.Command.START:
                starts.append(data[:2])
        if not outward and starts and not lost and data[:2] == starts[0]:
            lost.append(True)
            return b""
        return data

    with closing(ModbusDriver(tampered(server.port, swallow), watchdog=patience(2.0))) as driver:
        driver.connect()
        driver.start("p", driver.upload("p", SHORT))
        blocks = list(driver.samples())
    assert lost
    assert len(starts) == 1
    assert server.controller.motions_started == 1
    np.testing.assert_array_equal(sequence(blocks), np.arange(1 + blocks[-1].sequence[-1]))


def test_one_lost_answer_to_a_heartbeat_at_rest_ends_no_link(server, tampered):
    beats, lost, later = [], [], threading.Event()

    def swallow(outward, data):
        if outward and data[7] == 16 and data[8:10] == struct.pack(">H", wire.HEARTBEAT.address):
            beats.append(data[:2])
            if len(lost) == 1 and len(beats) >= 3:
                later.set()  # it has gone on after that
        if not outward and beats and not lost and data[:2] == beats[0]:
            lost.append(True)
            return b""
        return data

    address = tampered(server.port, swallow)
    with closing(ModbusDriver(address, watchdog=patience(0.2), timeout=patience(0.2))) as driver:
        driver.connect()
        assert later.wait(patience(5.0))
        assert driver.status().mode == "auto"


def test_one_lost_answer_to_a_read_is_made_good(server, tampered):
    lost = []

    def lose(outward, data):
        if not outward and server.controller.motions_started and not lost:
            lost.append(True)
            return b""
        return data

    with closing(ModbusDriver(tampered(server.port, lose), watchdog=patience(2.0))) as driver:
        driver.connect()
        checksum = driver.upload("p", SHORT)
        driver.start("p", checksum)
        blocks = list(driver.samples())
        assert lost
        assert driver.gaps == ()
        np.testing.assert_array_equal(sequence(blocks), np.arange(1 + blocks[-1].sequence[-1]))


def test_a_controller_that_is_late_with_an_answer_hears_of_its_client_meanwhile(server, tampered):
    """Half a watchdog is waited for it, and as long for its repetition: a heartbeat goes out in between."""
    lost, sent = [], []

    def lose(outward, data):
        if outward and lost:
            sent.append(data)
        if not outward and server.controller.motions_started and data[7] == 3 and not lost:
            lost.append(True)
            return b""
        return data

    with closing(ModbusDriver(tampered(server.port, lose), watchdog=patience(0.4))) as driver:
        driver.connect()
        driver.start("p", driver.upload("p", SHORT))
        list(driver.samples())
    assert sent[0][7:10] == struct.pack(">BH", 16, wire.HEARTBEAT.address)


def test_a_thread_that_stands_still_is_waited_for_no_longer_than_it_may(driver, monkeypatch):
    """Whatever it waits for: nobody else waits for ever, and nothing hangs at the end."""
    monkeypatch.setattr(link, "_STANDSTILL", 0.05)
    driver._link.timeout = 0.05
    held = threading.Event()
    driver._link._jobs.put((held.wait, Future()))
    with pytest.raises(DriverError, match="does not go on"):
        driver.status()
    with pytest.raises(DriverError, match="does not go on"):
        driver.identify()
    driver.close()
    held.set()


def test_a_thread_that_goes_on_slowly_is_waited_for(driver, monkeypatch):
    monkeypatch.setattr(link, "_STANDSTILL", patience(0.1) - driver._link.timeout)

    def slowly():
        for _ in range(15):
            driver._link.read(wire.PROGRESS)
            threading.Event().wait(patience(0.03))
        return True

    assert driver._link.call(slowly)


def test_a_consumer_that_falls_behind_stops_the_motion(server):
    with closing(ModbusDriver(server.address, watchdog=patience(2.0), buffer_limit=100_000)) as driver:
        driver.connect()
        received = start(driver, LONG)
        while server.controller.moving:
            time.sleep(0.001)
        with pytest.raises(DriverError, match="disk full"):
            list(received)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda data: data[:9] + bytes(len(data) - 9), "damaged"),
        (lambda data: data[:5] + b"\x03" + data[6:7] + b"\x83\x02", "no calibration controller"),
    ],
)
def test_another_modbus_device_is_recognised(server, tampered, answer, message):
    address = tampered(server.port, lambda outward, data: data if outward else answer(data))
    with pytest.raises(ProtocolError, match=message):
        ModbusDriver(address).connect()


def test_nothing_but_host_and_port():
    with pytest.raises(ConfigurationError, match="host:port"):
        ModbusDriver("COM3")


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


def test_a_command_said_twice_acts_once(server):
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


def test_a_client_without_heartbeat_loses_the_arm_and_the_controller(server):
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


def test_a_client_that_was_cut_off_does_not_find_its_session_again(server, monkeypatch):
    """A line that comes back before the client gave up: its motion ran unwatched, so nothing goes on."""
    monkeypatch.setattr(registers, "IDLE_LIMIT", 0.1)
    with ByHand(server, 5) as hand:
        assert hand.give(1, wire.Command.OPEN) == 0
        checksum = hand.store(2, SHORT)
        server.controller.faults.unplug()
        hand.client.comm_params.timeout_connect = 0.1
        with pytest.raises(ModbusException):
            hand.give(4, wire.Command.START, checksum=checksum, motion=b"m" * 16)
        session = 5
        while session != 0:  # no answer comes until the line is in order again
            with contextlib.suppress(ModbusException):
                hand.client.connect()
                session = hand.read(wire.PROGRESS)["session"]
        assert hand.write(wire.HEARTBEAT, session=5, count=1, taken=0) == 7
    assert server.controller.motions_started == 0


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(1, 100), parts=st.lists(st.integers(1, 400), max_size=5))
def test_requests_that_come_while_one_is_carried_out_are_answered_too(server, count, parts):
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


def test_writes_that_are_refused(server):
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


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=60)), max_size=10), st.binary(max_size=400))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_hostile_clients_do_not_harm_the_next(server, requests, noise):
    with socket.create_connection(("127.0.0.1", server.port), 5) as client:
        for function, data in requests:
            client.sendall(struct.pack(">HHHBB", 1, 0, len(data) + 2, 1, function) + data)
        client.sendall(noise)
    with ByHand(server, 5) as hand:
        assert hand.read(wire.IDENTITY)["magic"] == wire.MAGIC


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
