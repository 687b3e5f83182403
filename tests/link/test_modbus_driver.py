"""The Modbus driver over real sockets: what the conformance suite does not reach."""

import struct
import threading
import time
from concurrent.futures import Future
from contextlib import closing

import numpy as np
import pytest

from drivers.errors import ConfigurationError, DriverError, MotionStopped, ProtocolError, RefusedError
from drivers.protocol import Gap
from drivers.transports.modbus import link
from drivers.transports.modbus.driver import ModbusDriver
from drivers.wire import modbus as wire
from drivers.wire.reasons import EndReason
from fake_controller.build import build_controller
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

    with closing(ModbusDriver(tampered(server.port, lose), watchdog=0.5)) as driver:
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
