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
from drivers.transports.modbus import driver as modbus_driver, link
from drivers.transports.modbus.driver import ModbusDriver
from drivers.wire import modbus as wire
from drivers.wire.reasons import EndReason
from fake_controller.build import build_controller
from fake_controller.servers.modbus.server import ModbusServer
from tests.conftest import patience
from tests.link.conftest import LONG, SHORT, start


@pytest.fixture
def server(arm):
    with closing(ModbusServer(build_controller(arm, 3, "fast"), waits=True)) as server:
        yield server


@pytest.fixture
def driver(server):
    with closing(ModbusDriver(server.address, watchdog=patience(2.0))) as driver:
        driver.connect()
        yield driver


def sequence(blocks):
    return np.concatenate([block.sequence for block in blocks])


def check_complete(blocks):
    np.testing.assert_array_equal(sequence(blocks), np.arange(1 + blocks[-1].sequence[-1]))


def writes(data, block):
    """Whether a request writes a block."""
    return data[7] == 16 and data[8:10] == struct.pack(">H", block.address)


def starts(data):
    """Whether a request is a start."""
    if not writes(data, wire.COMMAND):
        return False
    values = wire.COMMAND.unpack(struct.unpack(f">{wire.COMMAND.registers}H", data[13:]))
    return values["command"] == wire.Command.START


class LosesAnswer:
    """Loses the first answer to a request that is `wanted`; what goes out after that is kept."""

    def __init__(self, wanted):
        self.wanted, self.asked, self.lost, self.later = wanted, [], False, []

    def __call__(self, outward, data):
        if outward and self.lost:
            self.later.append(data)
        if outward and self.wanted(data):
            self.asked.append(data[:2])
        if not outward and not self.lost and data[:2] in self.asked:
            self.lost = True
            return b""
        return data


def test_tcp_and_modbus_report_the_same(arm):
    """The same machine with the same seed on both wires, apart from single precision."""
    from drivers.transports.tcp.driver import TcpDriver
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


def test_refuses_a_name_that_would_be_truncated(driver):
    with pytest.raises(RefusedError, match="32 bytes"):
        driver.upload("p" * 33, SHORT)


def test_reports_a_protective_stop(driver, server):
    received = start(driver, LONG)
    next(received)
    server.controller.stop(EndReason.PROTECTIVE_STOP, "someone opened the gate")
    blocks = []
    with pytest.raises(MotionStopped, match=r"protective stop.*opened the gate"):
        blocks.extend(received)
    np.testing.assert_allclose(blocks[-1].reference_velocity[-1], 0, atol=1e-6)


def test_samples_overwritten_before_reading_are_a_gap(arm, tampered):
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
        check_complete(blocks)
        assert np.abs(np.concatenate([block.position for block in blocks])).max() < 1


def test_a_start_whose_answer_is_lost_is_not_given_again(server, tampered):
    given = []

    def swallow(outward, data):
        if outward and starts(data):
            given.append(data)
        return b"" if given and not outward else data

    with closing(ModbusDriver(tampered(server.port, swallow), watchdog=patience(0.5), timeout=patience(1.0))) as driver:
        driver.connect()
        checksum = driver.upload("p", LONG)
        with pytest.raises(DriverError, match="silent"):
            driver.start("p", checksum)
        with pytest.raises(DriverError, match="not open"):
            driver.status()
    assert len(given) == 1
    assert server.controller.motions_started == 1
    while server.controller.moving:
        time.sleep(0.001)


def records_with_a_loss(server, tampered, loses):
    """A motion is recorded whole although one answer is lost."""
    with closing(ModbusDriver(tampered(server.port, loses), watchdog=patience(2.0))) as driver:
        driver.connect()
        blocks = list(start(driver, SHORT))
        assert driver.gaps == ()
    assert loses.lost
    assert server.controller.motions_started == 1
    check_complete(blocks)


def test_one_lost_answer_to_a_start_leaves_no_motion_unwatched(server, tampered):
    """The start is given once; what became of it is read, and all its samples come."""
    loses = LosesAnswer(starts)
    records_with_a_loss(server, tampered, loses)
    assert len(loses.asked) == 1


@pytest.mark.parametrize("command_lost", [True, False])
def test_resends_a_lost_stop(server, tampered, command_lost, monkeypatch):
    """The command itself is lost, or all that is answered until it is sent again."""
    monkeypatch.setattr(modbus_driver, "WATCHDOG", patience(2.0))  # a stall of this machine is no second lost answer
    sent = []

    def lose(outward, data):
        if command := outward and writes(data, wire.COMMAND) and server.controller.motions_started:
            sent.append(data)
        return b"" if len(sent) == 1 and (command if command_lost else not outward) else data

    with closing(ModbusDriver(tampered(server.port, lose), watchdog=patience(2.0))) as driver:
        driver.connect()
        received = start(driver, LONG)
        next(received)
        sent.clear()
        driver.stop()
        assert len(sent) == 2
        assert server.controller.wait(patience(10.0))
        assert server.controller.motions_started == 1


def test_one_lost_answer_to_a_read_is_made_good(server, tampered):
    reads = LosesAnswer(lambda data: data[7] == 3 and server.controller.motions_started > 0)
    records_with_a_loss(server, tampered, reads)


def test_one_lost_answer_to_a_heartbeat_without_motion_ends_no_link(server, tampered):
    loses = LosesAnswer(lambda data: writes(data, wire.HEARTBEAT))
    address = tampered(server.port, loses)
    with closing(ModbusDriver(address, watchdog=patience(0.2), timeout=patience(0.2))) as driver:
        driver.connect()
        until = time.monotonic() + patience(5.0)
        while not (loses.lost and len(loses.asked) >= 3) and time.monotonic() < until:  # it has gone on after that
            threading.Event().wait(0.001)
        assert len(loses.asked) >= 3
        assert driver.status().mode == "auto"


def test_heartbeats_continue_during_a_late_answer(server, tampered):
    """Half a watchdog is waited for it, and as long for its repetition: a heartbeat goes out in between."""
    loses = LosesAnswer(lambda data: data[7] == 3 and server.controller.motions_started > 0)
    with closing(ModbusDriver(tampered(server.port, loses), watchdog=0.5)) as driver:
        driver.connect()
        list(start(driver, SHORT))
    assert writes(loses.later[0], wire.HEARTBEAT)


def test_a_stalled_link_thread_times_out(driver, monkeypatch):
    """Whatever it waits for, no other call blocks for ever, and nothing hangs at the end."""
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


def test_waits_for_a_slow_link_thread(driver, monkeypatch):
    monkeypatch.setattr(link, "_STANDSTILL", patience(0.1) - driver._link.timeout)

    def slowly():
        for _ in range(15):
            driver._link.read(wire.PROGRESS)
            threading.Event().wait(patience(0.03))
        return True

    assert driver._link.call(slowly)


def test_a_slow_consumer_stops_the_motion(server):
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


def test_refuses_an_address_other_than_host_and_port():
    with pytest.raises(ConfigurationError, match="host:port"):
        ModbusDriver("COM3")
