"""The fake controller over real sockets, driven by the real driver, with the real plant behind it."""

import hashlib
import socket
from contextlib import closing

import numpy as np
import pytest

from drivers.errors import DriverError, RefusedError
from drivers.transports.modbus.driver import ModbusDriver
from drivers.transports.tcp.driver import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.build import build_controller
from fake_controller.servers.modbus.server import ModbusServer
from fake_controller.servers.tcp import TcpServer
from tests.conftest import patience
from tests.link.conftest import LONG, program, start

GOAL = np.radians([20.0, -30.0])


SHORT = program("  MOVE JOINT TO {20, -30}")


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@pytest.fixture
def server(arm):
    with closing(TcpServer(build_controller(arm, seed=3, clock="fast"))) as server:
        yield server


@pytest.fixture
def driver(server):
    with closing(TcpDriver(server.address, watchdog=patience(2.0))) as driver:
        driver.connect()
        yield driver


def run(driver, text):
    return list(start(driver, text))


def test_reports_identity_and_status(driver, server):
    identity = driver.identify()
    assert (identity.robot, identity.joint_names, identity.period) == ("small_arm", ("shoulder", "elbow"), 0.002)
    assert identity.serial == "FAKE-0003"
    status = driver.status()
    assert (status.drives_on, status.emulator) == (True, True)
    np.testing.assert_allclose(status.position, [0, 0], atol=1e-3)


def test_a_program_runs_from_rest_to_rest(driver):
    blocks = run(driver, SHORT)
    sequence = np.concatenate([block.sequence for block in blocks])
    np.testing.assert_array_equal(sequence, np.arange(len(sequence)))
    time = np.concatenate([block.time for block in blocks])
    np.testing.assert_allclose(np.diff(time), 0.002, atol=1e-9)
    reference = np.concatenate([block.reference_position for block in blocks])
    measured = np.concatenate([block.position for block in blocks])
    np.testing.assert_allclose(reference[-1], GOAL, atol=1e-9)
    assert np.linalg.norm(measured[-1] - GOAL) < 2e-3
    assert np.abs(measured - reference).max() < 0.05
    velocity = np.concatenate([block.reference_velocity for block in blocks])
    np.testing.assert_allclose(np.gradient(reference, 0.002, axis=0), velocity, atol=0.02)
    assert np.abs(np.concatenate([block.torque for block in blocks])).max() > 1
    assert driver.gaps == ()
    status = driver.status()
    assert not status.moving
    np.testing.assert_array_equal(status.position, measured[-1])
    assert (status.program, status.checksum) == ("p", sha256(SHORT))


def test_an_arm_rests_for_a_delay_where_the_motion_before_left_it(driver):
    run(driver, SHORT)
    second = run(driver, program("  DELAY 100\n  MOVE JOINT TO {0, 0}"))
    reference = np.concatenate([block.reference_position for block in second])
    np.testing.assert_allclose(reference[:50], np.repeat(GOAL[None], 50, axis=0), rtol=1e-12)


def test_delivers_samples_in_real_time(arm):
    with closing(TcpServer(build_controller(arm, 3, "real"))) as server, closing(TcpDriver(server.address)) as driver:
        driver.connect()
        blocks = run(driver, program("  MOVE JOINT TO {2, -3}"))
    assert max(len(block) for block in blocks) == 10
    np.testing.assert_allclose(blocks[-1].reference_position[-1], np.radians([2, -3]), rtol=1e-9)
    assert driver.gaps == ()


def test_refuses_an_unreachable_target_before_motion(driver, server):
    checksum = driver.upload("p", program("  MOVE JOINT TO {500, 0}"))
    with pytest.raises(RefusedError, match=r"motion, line 5"):
        driver.start("p", checksum)
    assert server.controller.motions_started == 0
    assert len(run(driver, SHORT)) > 0


def test_an_unreachable_later_target_ends_the_motion_with_a_standstill(driver):
    driver.start("p", driver.upload("p", program("  MOVE JOINT TO {20, -30}\n  MOVE JOINT TO {500, 0}")))
    blocks = []
    with pytest.raises(RefusedError, match="cannot go on with the program: line 6"):
        blocks.extend(driver.samples())
    np.testing.assert_array_equal(blocks[-1].reference_velocity[-1], [0, 0])


@pytest.fixture(params=[(TcpServer, TcpDriver), (ModbusServer, ModbusDriver)], ids=["tcp", "modbus"])
def either(request, arm):
    """A controller and a driver that is connected to it, on each of the wires."""
    serve, drive = request.param
    with (
        closing(serve(build_controller(arm, seed=3, clock="fast"))) as server,
        closing(drive(server.address, watchdog=patience(2.0))) as driver,
    ):
        driver.connect()
        yield server.controller, driver


def test_a_syntax_error_is_refused_with_its_line(either):
    _, driver = either
    with pytest.raises(RefusedError, match=r"syntax, line 5 column \d+.*FLIP"):
        driver.upload("p", program("  FLIP TO {20, -30}"))
    assert driver.status().program == ""


def test_measures_what_the_link_carries(either):
    assert max(either[1].throughput() for _ in range(3)) > 500


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
def test_a_state_that_forbids_motion(either, changes, message):
    controller, driver = either
    checksum = driver.upload("p", SHORT)
    for name, value in changes.items():
        setattr(controller.state, name, value)
        assert getattr(driver.status(), name) == value
    with pytest.raises(RefusedError, match=message):
        driver.start("p", checksum)
    assert controller.motions_started == 0


def test_every_refusal_has_its_reason(driver, server):
    driver.upload("p", SHORT)
    with pytest.raises(RefusedError, match="checksum"):
        driver.start("p", sha256(LONG))
    with pytest.raises(RefusedError, match="unknown program"):
        driver.start("q", sha256(SHORT))
    with pytest.raises(RefusedError, match="busy: another client holds"):
        TcpDriver(server.address).connect()
    driver.start("p", driver.upload("p", LONG))
    with pytest.raises(RefusedError, match="moving"):
        driver.upload("q", SHORT)
    assert server.controller.motions_started == 1


@pytest.mark.parametrize("name", ["", "1p", "p q", "x" * 33, "../p"])
def test_refuses_invalid_program_names(driver, name):
    with pytest.raises(RefusedError, match="cannot name a program"):
        driver.upload(name, SHORT)


def test_refuses_a_too_large_program(driver):
    with pytest.raises(RefusedError, match="too large"):
        driver.upload("p", SHORT + "-- " + "x" * 1_100_000)


def test_stop_brings_the_arm_to_rest_on_its_path(driver, server):
    driver.start("p", driver.upload("p", LONG))
    received = driver.samples()
    blocks = [next(received), next(received)]
    driver.stop()
    blocks += received
    reference = np.concatenate([block.reference_position for block in blocks])
    velocity = np.concatenate([block.reference_velocity for block in blocks])
    sequence = np.concatenate([block.sequence for block in blocks])
    np.testing.assert_array_equal(sequence, np.arange(len(sequence)))
    np.testing.assert_allclose(velocity[-1], 0, atol=1e-9)
    # On the path: between the same two points, one joint says where the other must be.
    np.testing.assert_allclose(reference[:, 1], -1.5 * reference[:, 0], atol=1e-6)
    acceleration = np.abs(np.diff(velocity, axis=0)).max(axis=0) / 0.002
    assert np.all(acceleration <= 1.05 * server.controller.robot.max_acceleration)
    assert not driver.status().moving
    driver.stop()
    assert len(run(driver, SHORT)) > 0


class Client:
    """Frames by hand, for what the driver would never do."""

    def __init__(self, server, watchdog_ms=5000):
        host, _, port = server.address.rpartition(":")
        self.socket = socket.create_connection((host, int(port)), 20)
        self._decoder = tcp.FrameDecoder(tcp.MAX_REPLY_PAYLOAD)
        self._frames = []
        self.watchdog_ms = watchdog_ms

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def ask(self, message, request=1):
        """The answer to a request."""
        self.socket.sendall(tcp.encode(message, request))
        return self.await_message(lambda frame, _: frame.request == request)

    def await_message(self, wanted):
        while True:
            while not self._frames:
                data = self.socket.recv(65536)
                if not data:
                    raise EOFError
                self._frames += self._decoder.feed(data)
            frame = self._frames.pop(0)
            message = tcp.decode(frame)
            if wanted(frame, message):
                return message

    def greet(self):
        assert isinstance(self.ask(tcp.Hello(1, self.watchdog_ms, "by hand")), tcp.Welcome)
        return self

    def store(self, text):
        self.ask(tcp.UploadBegin("p", len(text), sha256(text)))
        self.ask(tcp.UploadBlock(0, text.encode()))
        return self.ask(tcp.UploadEnd()).checksum


def test_a_motion_command_acts_once(server):
    with Client(server).greet() as client:
        start = tcp.Start("p", client.store(SHORT), b"m" * 16)
        assert isinstance(client.ask(start, 2), tcp.Started)
        client.await_message(lambda _, message: isinstance(message, tcp.End))
        refused = client.ask(start, 3)
        assert refused.code == Refusal.REPEATED_MOTION
    assert server.controller.motions_started == 1


def test_missed_samples_can_be_fetched(server):
    with Client(server).greet() as client:
        start = tcp.Start("p", client.store(SHORT), b"m" * 16)
        client.ask(start, 2)
        streamed = client.await_message(lambda _, message: isinstance(message, tcp.Samples))
        end = client.await_message(lambda _, message: isinstance(message, tcp.End))
        again = client.ask(tcp.Fetch(30, 20), 3)
        assert again.first == 30
        np.testing.assert_array_equal(again.torque, streamed.torque[30:50])
        np.testing.assert_array_equal(again.time_ns, streamed.time_ns[30:50])
        assert client.ask(tcp.Fetch(end.samples, 20), 4).code == Refusal.NOT_AVAILABLE


def test_a_silent_client_loses_control_of_the_arm(server):
    with Client(server, watchdog_ms=50).greet() as client:
        client.ask(tcp.Start("p", client.store(LONG), b"m" * 16), 2)
        end = client.await_message(lambda _, message: isinstance(message, tcp.End))
        assert end.reason == EndReason.WATCHDOG
        assert "50 ms" in end.message


def test_switching_off_brings_the_arm_to_rest_first(arm):
    server = TcpServer(build_controller(arm, 3, "fast"))
    with closing(TcpDriver(server.address)) as driver:
        driver.connect()
        driver.start("p", driver.upload("p", LONG))
        received = driver.samples()
        next(received)
        server.close()
        blocks = []
        with pytest.raises(DriverError, match="switched off"):
            blocks.extend(received)
        np.testing.assert_allclose(blocks[-1].reference_velocity[-1], 0, atol=1e-9)
    with pytest.raises(DriverError, match="no controller answers"):
        TcpDriver(server.address).connect()


def test_refuses_requests_before_the_greeting(server):
    with Client(server) as client:
        assert client.ask(tcp.Identify()).code == Refusal.BAD_REQUEST


def test_upload_blocks_are_checked(server):
    with Client(server).greet() as client:
        assert client.ask(tcp.UploadBlock(0, b"x")).code == Refusal.BAD_REQUEST
        client.ask(tcp.UploadBegin("p", 4, sha256("abcd")))
        assert client.ask(tcp.UploadBlock(1, b"x")).code == Refusal.BAD_REQUEST
        assert client.ask(tcp.UploadBlock(0, b"abcde")).code == Refusal.TOO_LARGE
        assert isinstance(client.ask(tcp.UploadBlock(0, b"abcx")), tcp.Done)
        assert client.ask(tcp.UploadEnd()).code == Refusal.CHECKSUM
