"""The UR driver against a small controller of the tests and against the emulator, on real sockets."""

import contextlib
import time

import numpy as np
import pytest

from drivers.bench import WireRelays
from drivers.conformance import DriverConformance
from drivers.errors import ConfigurationError, DriverError, MotionStopped, ProtocolError, RefusedError
from drivers.registry import create
from drivers.transports.ur.driver import JOINTS
from drivers.wire import ur_rtde as rtde
from fake_controller.build import build_ur_cell
from fake_controller.ur.server import DASHBOARD, PRIMARY, RTDE, UrServer
from tests.conftest import free_loopback, patience
from tests.link.test_conformance import EmulatedBench
from tests.link.ur_peer import UrPeer

HEAD = """def p():
  write_output_integer_register(25, 4711)
  rtde_set_watchdog("input_int_register_24", 2, "stop")
  set_tcp(p[0, 0, 0, 0, 0, 0])
  set_target_payload(0, [0, 0, 0])
  while read_input_integer_register(25) != 4711:
    sync()
  end
  write_output_integer_register(25, 0)
"""
THERE, BACK = (
    "movej([0.4, -1.3, 1.4, -1.5, -1.5, 0.2], a=1, v=0.5)",
    "movej([0.1, -1.5, 1.5, -1.5, -1.5, 0], a=1, v=0.5)",
)
SHORT = f"{HEAD}  {THERE}\n  {BACK}\nend\n"
LONG = f"{HEAD}  i = 0\n  while i < 500:\n    {THERE}\n    {BACK}\n    i = i + 1\n  end\nend\n"


def address(ports):
    dashboard, primary, data = ports
    return f"127.0.0.1,dashboard={dashboard},primary={primary},rtde={data}"


def driver_for(place, **options):
    driver = create("ur", place, **options)
    driver.torque_per_ampere = 10.0 * np.eye(6)
    return driver


class UrBench(EmulatedBench):
    joint_names = JOINTS
    short, long, comment = SHORT, LONG, "#"

    def __init__(self, undo, peer):
        self.undo, self.controller = undo, peer
        undo.callback(peer.close)
        self.wire = WireRelays([(peer.host, port) for port in peer.ports])
        undo.callback(self.wire.close)

    def driver(self):
        return self.created(*self.wire.ports)

    def created(self, *ports, **options):
        ports = [port.rpartition(":")[2] for port in ports]
        driver = driver_for(address(ports * 3 if len(ports) == 1 else ports), **options)
        self.undo.callback(driver.close)
        return driver

    def stranger(self):
        return self.answering(b"", greeting=b"SSH-2.0-OpenSSH_9.6\r\n")

    def replay(self):
        """The registers first, so that they hold what they held last when the program arrives once more."""
        for relay in reversed(self.wire.all):
            relay.replay()


#: The driver's patience [s] with a simulator, which nothing but its tests waits out.
SIMULATED = "drivers.transports.ur.driver._SIMULATED"


class FakeUr(UrServer):
    """The emulated controller at an address of its own; counts programs that have moved the arm."""

    host = property(lambda self: self.address)
    ports = DASHBOARD, PRIMARY, RTDE

    def __init__(self, clock="fast", faults=None):
        cell = build_ur_cell("ur5e", seed=3, clock=clock, shortest_watchdog=patience(2.0))
        cell.faults = faults or cell.faults
        self.robot, self.ends, self.speeds = cell.robot, cell.ends, [np.zeros((1, 6))]
        super().__init__(cell, free_loopback())
        self._moved = set()
        self.on_moving = None
        cell.listeners.append(self)

    def on_cycles(self, cycles):
        self.speeds.append(cycles.target_qd)
        if self.cell.moving:
            self._moved.add(self.cell.motions_started)
        if self.on_moving is not None and self.cell._moved >= 0.3:
            happens, self.on_moving = self.on_moving, None
            happens()

    def on_message(self, message):
        pass

    @property
    def motions_started(self):
        return len(self._moved)

    @property
    def moving(self):
        return self.cell.moving

    def wait(self, timeout):
        """Whether the arm rests within the time."""
        until = time.monotonic() + timeout
        while (self.moving or self.cell.running or self.speeds[-1][-1].any()) and time.monotonic() < until:
            time.sleep(0.001)
        return not self.moving


class TestUr(DriverConformance):
    @pytest.fixture(params=[UrPeer, FakeUr])
    def bench(self, request, monkeypatch):
        monkeypatch.setattr(SIMULATED, min(patience(2.0), 5.0))
        with contextlib.ExitStack() as undo:
            yield UrBench(undo, request.param())


@pytest.fixture
def peer():
    with contextlib.closing(UrPeer()) as peer:
        yield peer


@pytest.fixture
def driver(peer):
    with contextlib.closing(driver_for(address(peer.ports))) as driver:
        yield driver


def stored(driver, text=SHORT):
    driver.connect()
    return driver.upload("p", text)


@pytest.mark.parametrize(("version", "robot", "period"), [("5.12.6.1", "ur5e", 0.002), ("3.15.8.1", "ur5", 0.008)])
def test_the_series_follows_from_the_version(peer, driver, version, robot, period):
    peer.version = version
    driver.connect()
    assert (driver.identify().robot, driver.identify().period) == (robot, period)


@pytest.mark.parametrize("version", ["5." + "1" * 3000, "9" * 3000, "5.12.6.1." * 20, "five", "5"])
def test_what_is_no_version_is_named(peer, driver, version):
    peer.version = version
    with pytest.raises(ProtocolError, match="the version of PolyScope is not in"):
        driver.connect()


def test_torque_is_the_current_times_the_torque_per_ampere(driver):
    driver.start("p", stored(driver))
    blocks = list(driver.samples())
    for block in blocks:
        np.testing.assert_allclose(block.torque, 10.0 * block.current, rtol=1e-12)


@pytest.mark.parametrize(
    ("state", "seen"),
    [
        ({"safety_mode": 3}, lambda status: status.alarms == ("PROTECTIVE_STOP",)),
        ({"safety_mode": 2}, lambda status: status.alarms == ("REDUCED",)),
        ({"safety_mode": 5}, lambda status: not status.cell_closed),
        ({"safety_mode": 7}, lambda status: status.emergency_stop),
        ({"robot_mode": 5}, lambda status: not status.drives_on),
        ({"target_speed_fraction": 0.5}, lambda status: status.override == 0.5),
        ({"runtime_state": 2}, lambda status: status.moving),
    ],
)
def test_status_reports_the_state_of_the_controller(peer, driver, state, seen):
    peer.state |= state  # before the connection: a sample that is on its way when the state changes has the old one
    driver.connect()
    assert seen(driver.status())


def test_local_control_is_reported_and_refused(peer, driver):
    peer.remote = "false"
    checksum = stored(driver)
    assert driver.status().mode == "teach"
    with pytest.raises(RefusedError, match="local control, and remote control is needed"):
        driver.start("p", checksum)
    assert not peer.scripts


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"tcp_offset": np.array([0, 0, 0.12, 0, 0, 0])}, r"TCP at the pendant is \[0, 0, 0.12, .*for \[0, 0, 0, 0"),
        ({"payload": 1.5}, "payload at the pendant is 1.500 kg .* for 0.000 kg"),
        ({"runtime_state": 2}, "another program runs"),
    ],
)
def test_a_wrong_tool_payload_or_running_program_is_refused_with_its_values(peer, driver, state, message):
    peer.state |= state
    checksum = stored(driver)
    with pytest.raises(RefusedError, match=message):
        driver.start("p", checksum)
    assert not peer.scripts


@pytest.mark.parametrize("line", [1, 2, 5, 8])
def test_a_program_that_could_not_be_stopped_or_recognised_is_refused(driver, line):
    text = "".join(one for k, one in enumerate(SHORT.splitlines(keepends=True)) if k != line)
    driver.connect()
    with pytest.raises(RefusedError, match="rtde_set_watchdog"):
        driver.upload("p", text)


@pytest.mark.parametrize(("version", "inertia"), [("5.12.6.1", ", [0.01, 0.02, 0.03, 0, 0, 0.001]"), ("5.10.2.1", "")])
def test_tcp_and_payload_are_set_as_they_were_after_a_motion(peer, driver, version, inertia):
    peer.version = version
    peer.state |= {"tcp_offset": np.array([0, 0, 0.00004, 0, 0, 0]), "payload": 0.004}
    driver.start("p", stored(driver))
    list(driver.samples())
    until = time.monotonic() + patience(5.0)
    while not peer.secondary and time.monotonic() < until:
        time.sleep(0.001)
    assert peer.secondary == [
        f"sec restore():\n  set_tcp(p[0, 0, 4e-05, 0, 0, 0])\n  set_target_payload(0.004, [0, 0, 0]{inertia})\nend\n"
    ]


def test_a_program_that_sets_no_tool_leaves_nothing_to_restore(peer, driver):
    lines = [line for line in SHORT.splitlines() if not line.startswith("  set_t")]
    driver.start("p", stored(driver, "\n".join(lines) + "\n"))
    list(driver.samples())
    driver.stop()
    assert not peer.secondary


def test_a_script_error_is_reported_and_nothing_moves(peer, driver):
    peer.refusal = 9, 3, "compile_error_name_not_found:movej:"
    checksum = stored(driver)
    with pytest.raises(RefusedError, match="line 9 column 3: compile_error_name_not_found"):
        driver.start("p", checksum)
    assert (len(peer.scripts), peer.motions_started) == (1, 0)


def test_a_program_that_is_not_seen_to_start_is_not_sent_again(peer):
    peer._run = peer.scripts.append
    with contextlib.closing(driver_for(address(peer.ports), timeout=patience(0.5))) as driver:
        checksum = stored(driver)
        with pytest.raises(DriverError, match="did not start program p"):
            driver.start("p", checksum)
        with pytest.raises(DriverError):
            driver.start("p", checksum)
    assert len(peer.scripts) == 1


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"safety_mode": 3}, "protective stop"),
        ({"safety_mode": 6}, "emergency stop"),
        ({"robot_mode": 3}, "drive fault"),
    ],
)
def test_an_interruption_is_reported_after_its_samples(peer, driver, state, message):
    driver.start("p", stored(driver, LONG))
    samples = driver.samples()
    next(samples)
    peer.state |= state
    peer.end(state=4)
    with pytest.raises(MotionStopped, match=message):
        list(samples)


@pytest.mark.parametrize(
    ("stamp", "message"),
    [
        (lambda stood: lambda now: np.nan, "clock .* jumped, from .* to nan s"),
        (lambda stood: lambda now: np.inf, "clock .* jumped, from .* to inf s"),
        (lambda stood: lambda now: now + 100.0, "clock .* jumped"),
        (lambda stood: lambda now: now - 10.0, "clock .* jumped"),
        (lambda stood: lambda now: stood, "fell silent: no new sample for 0.5 s"),
    ],
)
def test_an_implausible_clock_stops_the_arm(peer, driver, stamp, message):
    peer.real = True
    driver.start("p", stored(driver, LONG))
    samples = driver.samples()
    next(samples)
    with peer._lock:
        peer.stamp = stamp(peer.state["timestamp"])
    with pytest.raises(DriverError, match=message):
        list(samples)
    assert not peer.moving


def test_a_port_that_closes_in_motion_stops_the_arm(peer, driver):
    driver.start("p", stored(driver, LONG))
    samples = driver.samples()
    next(samples)
    peer.hang_up()
    with pytest.raises(DriverError, match="closed the primary interface"):
        list(samples)
    assert not peer.moving


def test_lost_samples_show_as_gaps(peer, driver):
    driver.start("p", stored(driver))
    samples = driver.samples()
    blocks = [next(samples)]
    peer.drop = 7
    blocks += samples
    sequence = np.concatenate([block.sequence for block in blocks])
    (gap,) = driver.gaps
    assert gap.count == 7
    assert set(range(sequence[-1] + 1)) - set(sequence) == set(range(gap.first, gap.first + 7))


def test_a_controller_that_skips_most_samples_is_stopped(peer, driver):
    driver.start("p", stored(driver, LONG))
    samples = driver.samples()
    next(samples)
    peer.every = 2
    with pytest.raises(DriverError, match="samples; the motion was stopped"):
        list(samples)


def test_a_start_that_the_motion_ends_says_why(peer, driver):
    """Not that the program does not answer, which is a consequence."""
    checksum = stored(driver, LONG)
    driver.listening = lambda: setattr(peer, "every", 2)
    peer.permits = False
    with pytest.raises(DriverError, match="samples; the motion was stopped"):
        driver.start("p", checksum)


def test_a_hanging_dashboard_does_not_prevent_a_stop(peer, driver):
    driver.start("p", stored(driver, LONG))
    next(driver.samples())
    peer.answers.clear()
    driver.stop()
    assert not peer.moving
    peer.answers.set()
    assert driver.status().mode == "auto"  # the answer to the stop, which came late, is passed over


def test_an_arm_that_does_not_obey_feels_no_heartbeat(peer, driver):
    driver.start("p", stored(driver, LONG))
    next(driver.samples())
    peer.obeys = False
    driver.stop()
    assert not peer.moving


def test_throughput_falls_with_the_rate_of_samples(peer, driver):
    driver.connect()
    assert driver.throughput() == pytest.approx(500.0)
    peer.every = 4
    assert driver.throughput() < 200.0


def test_fields_that_a_controller_lacks_are_named(peer, driver):
    peer.missing = ("payload_cog",)
    with pytest.raises(RefusedError, match="does not know payload_cog"):
        driver.connect()


def test_torque_without_gravity_is_refused():
    with pytest.raises(RefusedError, match="without gravity"):
        rtde.output_request(("timestamp", "actual_current_as_torque"), 500.0)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("127.0.0.1,script=1", "after the host, dashboard, primary, rtde may follow"),
        ("127.0.0.1,rtde=x", None),
        ("", None),
        ("127.0.0.1:30004", "ports follow as host,rtde=30004"),
    ],
)
def test_an_invalid_address_is_refused(wrong, said):
    with pytest.raises(ConfigurationError, match=said):
        create("ur", wrong)


def test_the_layout_of_packages_is_the_published_one():
    """By hand, after the RTDE guide: V asks for version 2; two int32 inputs of recipe 3."""
    assert rtde.package(rtde.VERSION, b"\0\2") == bytes.fromhex("0005 56 0002")
    assert rtde.input_package(3, 1, -1) == bytes.fromhex("000c 55 03 00000001 ffffffff")
    assert rtde.output_request(("actual_q",), 500.0) == bytes.fromhex("0013 4f 407f400000000000") + b"actual_q"
