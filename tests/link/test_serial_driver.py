"""The serial driver over a cable that is bad or slow: what the conformance suite does not reach."""

import contextlib
import struct
import time
from types import SimpleNamespace

import numpy as np
import pytest
import serial
from hypothesis import given, strategies as st
from pymodbus.framer import FramerRTU
from pymodbus.pdu import DecodePDU

from drivers.errors import ConfigurationError, DriverError, ProtocolError
from drivers.registry import create
from drivers.transports.frames.serial import RtuDriver, SerialDriver
from drivers.transports.modbus import driver as modbus_driver
from drivers.transports.modbus.rtu import without_strays
from drivers.wire import frames as tcp, modbus
from drivers.wire.serial import HuntingDecoder
from fake_controller.build import build_controller
from fake_controller.servers.cable import Cable
from fake_controller.servers.modbus.server import ModbusRtuServer
from fake_controller.servers.serial import SerialServer
from tests.conftest import patience
from tests.link.conftest import LONG, SHORT, program, start

FAST = 4_000_000


@pytest.fixture
def line(arm):
    """`line(protocol, baud)`: cable, controller and a driver that is connected."""
    with contextlib.ExitStack() as undo:

        def lay(protocol="frames", baud=FAST, **options):
            cable = Cable(baud)
            undo.callback(cable.close)
            controller = build_controller(arm, 3, "fast")
            kind = SerialServer if protocol == "frames" else ModbusRtuServer
            server = kind(controller, cable.near, baud, waits=True)
            undo.callback(server.close)
            driver = create("serial", f"{cable.far},{baud},{protocol}", **{"watchdog": 2.0, **options})
            undo.callback(driver.close)
            driver.connect()
            return cable, controller, driver

        yield lay


def check_complete(driver, blocks):
    sequence = np.concatenate([block.sequence for block in blocks])
    np.testing.assert_array_equal(sequence, np.arange(len(sequence)))
    assert driver.gaps == ()


def test_the_address_chooses_the_protocol():
    assert type(create("serial", "/dev/ttyUSB0")) is SerialDriver
    assert type(create("serial", "/dev/ttyUSB0,9600,rtu")) is RtuDriver
    with pytest.raises(ConfigurationError, match="port,baud,protocol"):
        create("serial", "/dev/ttyUSB0,fast")


@pytest.mark.parametrize("protocol", ["frames", "rtu"])
def test_the_watchdog_is_three_longest_frames_at_least(line, protocol):
    _, _, driver = line(protocol, 9600, watchdog=0.2)
    assert driver.watchdog == pytest.approx({"frames": 3.2, "rtu": 0.822}[protocol], abs=0.001)


def test_a_port_that_is_in_use(line):
    cable, _, _ = line()
    with pytest.raises(DriverError, match="busy: another program has the serial port"):
        create("serial", f"{cable.far},{FAST}").connect()


@pytest.mark.parametrize("protocol", ["frames", "rtu"])
def test_a_line_that_is_too_slow_is_read_after_the_motion(line, protocol):
    _, controller, driver = line(protocol, 500_000)
    received = start(driver, SHORT)
    blocks = [next(received)]
    after = 0
    for block in received:
        after += len(block) * (not controller.moving)
        blocks.append(block)
    assert after > 100
    check_complete(driver, blocks)
    assert controller.motions_started == 1


@pytest.mark.parametrize(("protocol", "most"), [("frames", 230), ("rtu", 200)])
def test_what_a_line_carries_is_measured(line, protocol, most):
    _, _, driver = line(protocol, 115_200)
    assert 0.3 * most < driver.throughput() <= most
    _, _, driver = line(protocol, FAST)
    assert driver.throughput() > 500


def test_a_clock_that_is_set_back_lengthens_no_wait(line, monkeypatch):
    """The library of RTU waits by the clock on the wall."""
    cable, _, driver = line("rtu", timeout=0.2)
    looks = []

    def set_back():
        looks.append(None)
        assert len(looks) < 1000, "it waits for a time that does not come"
        return 1e9 - len(looks)

    cable.tamper = lambda end, data: b""
    monkeypatch.setattr(time, "time", set_back)
    with pytest.raises(DriverError, match="silent"):
        driver.status()


def test_an_answer_that_comes_again_is_not_taken_for_the_next_one(line):
    """RTU has no transaction numbers: any bytes before an answer could be the answer."""
    cable, controller, driver = line("rtu")
    before = [b""]

    def repeat(end, data):
        if end == "far":
            return data
        before.append(data)
        return before[-2] + data

    cable.tamper = repeat
    check_complete(driver, list(start(driver, program("  MOVE JOINT TO {2, -3}"))))
    assert controller.motions_started == 1
    assert len(before) > 20


def test_a_damaged_answer_is_not_waited_for_to_its_limit(line, monkeypatch):
    """Nobody sees the arm meanwhile."""
    cable, _, driver = line("rtu", timeout=10.0)
    slept, damaged, sleep = [], [], time.sleep

    def damage(end, data):
        if end == "far" or damaged:
            return data
        damaged.append(len(slept))
        return data[:-1] + bytes([data[-1] ^ 16])

    def count(seconds):
        slept.append(seconds)
        sleep(seconds)

    cable.tamper = damage
    monkeypatch.setattr("drivers.transports.modbus.rtu.time.sleep", count)
    assert not driver.status().moving
    assert sum(slept[damaged[0] :]) < 0.5


def frame(*data):
    return FramerRTU(DecodePDU(False)).encode(bytes(data[1:]), data[0], 0)


ANSWERS = st.one_of(
    st.integers(1, 125).map(lambda count: frame(1, 3, 2 * count, *range(2 * count))),
    st.tuples(st.integers(0, 255), st.integers(1, 120)).map(lambda at: frame(1, 16, 0, at[0], 0, at[1])),
)


@given(earlier=st.lists(ANSWERS, max_size=3), noise=st.binary(max_size=20), cut=st.integers(0, 300))
def test_answers_to_other_requests_are_left_out_and_nothing_else(earlier, noise, cut):
    request, answer = frame(1, 3, 10, 0, 0, 126), frame(1, 3, 252, *range(252))
    assert without_strays(request, b"".join([*earlier, answer[:cut]])) == answer[:cut]
    assert without_strays(request, answer + noise) == answer + noise
    damaged = bytes([*answer[:9], answer[9] ^ 1, *answer[10:]])
    assert without_strays(frame(1, 3, 10, 0, 0, 2), damaged) == damaged
    write = frame(1, 16, 10, 0, 0, 2, 4, 0, 0, 0, 0)
    assert without_strays(write, b"".join([*earlier, frame(1, 16, 10, 0, 0, 2)])) == frame(1, 16, 10, 0, 0, 2)
    assert without_strays(write, frame(1, 144, 3)) == frame(1, 144, 3)


def test_a_stop_on_a_slow_line_does_not_wait_for_the_samples(line):
    _, controller, driver = line(baud=230_400)
    received = start(driver, LONG)
    blocks = [next(received)]
    driver.stop()
    assert not controller.moving
    blocks += received
    check_complete(driver, blocks)
    np.testing.assert_allclose(blocks[-1].reference_velocity[-1], 0, atol=1e-6)


@pytest.mark.parametrize("lost", ["far", "near"])
@pytest.mark.parametrize("protocol", ["frames", "rtu"])
def test_resends_a_lost_stop(line, protocol, lost, monkeypatch):
    monkeypatch.setattr(modbus_driver, "WATCHDOG", 2.0)  # a stall of this machine is no second lost answer
    cable, controller, driver = line(protocol)
    received = start(driver, LONG)
    next(received)
    sign = {
        "frames": tcp.encode(tcp.Stop())[:6],
        "rtu": struct.pack(">BBH", modbus.UNIT, 16, modbus.COMMAND.address),
    }[protocol]
    sent = []

    def lose(end, data):
        """The command itself, or all that is answered until it is sent again."""
        if end == "far" and sign in data:
            sent.append(data)
        return b"" if end == lost and len(sent) == 1 else data

    cable.tamper = lose
    driver.stop()
    assert len(sent) == 2
    assert controller.wait(10.0)
    assert controller.motions_started == 1


@pytest.mark.parametrize("every", [pytest.param(3000, marks=pytest.mark.verify), 20_000])
def test_flipped_bits_lose_no_sample(line, every):
    """A fixed share of the bytes to the driver is damaged, all the time while samples come."""
    cable, controller, driver = line()
    passed, started = 0, []

    def damage(end, data):
        nonlocal passed
        if end == "far" or not started:
            return data
        before, passed = passed, passed + len(data)
        if passed // every == before // every:
            return data
        at = every - 1 - before % every
        return data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :]

    text = program("  FOR k := 1 TO 5 DO\n    MOVE JOINT TO {20, -30}\n    MOVE JOINT TO {0, 0}\n  ENDFOR")
    checksum = driver.upload("p", text)
    cable.tamper = damage
    driver.start("p", checksum)
    started.append(True)
    check_complete(driver, list(driver.samples()))
    assert passed > 5 * every
    assert controller.motions_started == 1


def test_requests_a_lost_end_message(line):
    cable, _, driver = line(watchdog=0.2)
    decoder, lost = HuntingDecoder(), []

    def lose(end, data):
        """Whole frames only, so that one can be taken out."""
        if end == "far":
            return data
        kept = b""
        for frame in decoder.feed(data):
            if frame.type == tcp.End.TYPE and not lost:
                lost.append(frame)
            else:
                kept += tcp.encode(SimpleNamespace(TYPE=frame.type, pack=lambda: frame.payload), frame.request)  # noqa: B023
        return kept

    checksum = driver.upload("p", SHORT)
    cable.tamper = lose
    driver.start("p", checksum)
    check_complete(driver, list(driver.samples()))
    assert len(lost) == 1


def test_a_damaged_start_is_not_resent(line):
    cable, controller, driver = line(timeout=patience(1.0), start_timeout=patience(1.0))
    checksum = driver.upload("p", SHORT)
    driver.identify()
    sent = []

    def damage(end, data):
        if end == "near" or checksum.encode() not in data:
            return data
        sent.append(data)
        return data.replace(checksum[:8].encode(), b"00000000")

    cable.tamper = damage
    with pytest.raises(DriverError, match="did not answer start of p"):
        driver.start("p", checksum)
    assert len(sent) == 1
    assert controller.motions_started == 0
    with pytest.raises(DriverError, match="not open"):
        driver.status()


def test_an_upload_that_is_damaged_stores_nothing(line):
    cable, _, driver = line(timeout=patience(1.0))
    cable.tamper = lambda end, data: data.replace(b"MOVE", b"MUVE") if end == "far" else data
    with pytest.raises(DriverError, match="did not answer the program p"):
        driver.upload("p", SHORT)
    cable.tamper = None
    assert driver.status().program == ""


def test_reports_a_wrong_baud_rate(line):
    """Another bit rate is modelled by its effect on a receiver: other bytes."""
    cable, _, driver = line()
    driver.close()
    cable.tamper = lambda end, data: bytes(byte ^ 0x55 for byte in data) if end == "near" else data
    with pytest.raises(ProtocolError, match="baud rate"):
        create("serial", f"{cable.far},{FAST}", timeout=patience(0.5)).connect()


def test_a_cable_is_as_slow_as_its_baud_rate():
    """By the bytes in transit: the other end has at most its share of the sent bytes."""
    with (
        contextlib.closing(Cable(38_400)) as cable,
        serial.Serial(cable.near, 38_400) as near,
        serial.Serial(cable.far, 38_400, timeout=10) as far,
    ):
        began = time.monotonic()
        near.write(bytes(range(256)) * 4)
        received = far.read(1024)
        elapsed = time.monotonic() - began
        assert received == bytes(range(256)) * 4
        assert elapsed > 0.9 * 1024 * 10 / 38_400  # a busy machine makes it slower, nothing makes it faster
