"""The clients of ur-rtde, as they come, against the emulated UR."""

import csv
import itertools
import os
import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from functools import cache

import numpy as np
import pytest

from tests.conftest import ROOT, end_with_tests, free_loopback
from tests.ur_fake.clients import Rtde, clients
from tests.ur_fake.conftest import CB3

rtde_receive = pytest.importorskip("rtde_receive")
dashboard_client = pytest.importorskip("dashboard_client")
script_client = pytest.importorskip("script_client")
rtde_control = pytest.importorskip("rtde_control")

HOME = np.radians([0, -90, -90, -90, 90, 0])
SQUARE = np.radians([0, -100, -120, -50, 90, 0])


@contextmanager
def disconnecting(client):
    try:
        yield client
    finally:
        client.disconnect()


#: A robot in a process of its own, as these clients do not let others run while they wait: version, mode, address.
SERVER = """
import sys
from fake_controller.build import build_ur_cell
from fake_controller.ur.server import UrServer
*version, mode, address = sys.argv[1:]
server = UrServer(build_ur_cell("ur5e", 3, "fast", version=tuple(map(int, version))), address)
server.cell.state.mode = mode
print("up", flush=True)
sys.stdin.read()
server.close()
"""


@contextmanager
def process(*command, says):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = {"text": True, "stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "preexec_fn": end_with_tests}
    with subprocess.Popen([sys.executable, *command], env=environment, **pipes) as running:
        try:
            assert running.stdout.readline().startswith(says)
            yield running
            running.stdin.close()
            assert running.wait(30) == 0
        finally:
            running.kill()


@pytest.fixture(scope="module")
def robot():
    """The address of a robot of a version, in remote (auto) or local mode (teach)."""
    with ExitStack() as running:

        @cache
        def started(version=(5, 12, 6, 1102099), mode="auto"):
            address = free_loopback()
            running.enter_context(process("-c", SERVER, *map(str, version), mode, address, says="up"))
            return address

        yield started


def waited_for(holds):
    """Reads until something holds; the client's own thread brings new values."""
    return any(holds() for _ in itertools.repeat(None, 5_000_000))


@pytest.mark.parametrize("upper", [False, True])
@pytest.mark.parametrize("version", [(5, 12, 6, 1102099), CB3])
def test_receive_gets_all_of_its_default_fields(robot, version, upper):
    with disconnecting(rtde_receive.RTDEReceiveInterface(robot(version), -1.0, [], False, upper)) as client:
        first = client.getTimestamp()
        assert waited_for(lambda: client.getTimestamp() > first)
        np.testing.assert_allclose(client.getTargetQ(), HOME)
        np.testing.assert_allclose(client.getActualQ(), HOME, atol=1e-3)
        assert (client.getRobotMode(), client.getSafetyMode(), client.getRuntimeState()) == (7, 1, 1)
        assert client.getJointMode() == [253] * 6
        assert client.getSpeedScaling() * client.getTargetSpeedFraction() == 1
        assert abs(client.getActualCurrent()[1]) > 0.3
        assert len(client.getActualTCPPose()) == 6


def test_receive_records_a_file(robot, tmp_path):
    path = tmp_path / "log.csv"
    with disconnecting(rtde_receive.RTDEReceiveInterface(robot())) as client:
        first = client.getTimestamp()
        assert client.startFileRecording(str(path))
        assert waited_for(lambda: client.getTimestamp() > first + 0.5)
        assert client.stopFileRecording()
    rows = list(csv.DictReader(path.open()))
    assert {"timestamp", "actual_q_0", "actual_current_5", "runtime_state"} <= set(rows[0])
    assert float(rows[-1]["timestamp"]) > float(rows[0]["timestamp"])


def test_receive_says_that_a_field_is_missing(robot):
    with pytest.raises(RuntimeError, match="not found"):
        rtde_receive.RTDEReceiveInterface(robot(CB3), -1.0, ["timestamp", "ft_raw_wrench"])


def test_dashboard_reads_the_state_and_raises_what_is_refused(robot):
    with disconnecting(dashboard_client.DashboardClient(robot())) as client:
        client.connect()
        assert client.polyscopeVersion() == "5.12.6.1102099"
        assert client.getSerialNumber().isdigit()
        assert (client.getRobotModel(), client.robotmode()) == ("UR5", "Robotmode: RUNNING")
        assert (client.safetystatus(), client.isInRemoteControl()) == ("Safetystatus: NORMAL", True)
        assert client.running() is False
        for acts in (client.powerOff, client.powerOn, client.brakeRelease, client.closeSafetyPopup):
            acts()
        with pytest.raises(RuntimeError, match="Failed to execute: play"):
            client.play()
        with pytest.raises(RuntimeError, match="not found"):
            client.loadURP("job.urp")
    with disconnecting(dashboard_client.DashboardClient(robot(mode="teach"))) as client:
        client.connect()
        assert client.isInRemoteControl() is False
        with pytest.raises(RuntimeError, match="switch robot to Remote Control"):
            client.play()


def test_a_script_that_is_sent_runs(robot):
    job = "def job():\n  write_output_integer_register(24, 5)\n  sleep(0.1)\nend\n"
    with clients(Rtde(robot(), "output_int_register_24", "runtime_state")) as watcher:
        with disconnecting(script_client.ScriptClient(robot(), 5, 12)) as client:
            client.connect()
            assert client.sendScriptCommand(job)
            watcher.until(lambda sample: sample["output_int_register_24"] == 5)
        watcher.until(lambda sample: sample["runtime_state"] == 1)


def test_control_runs_its_own_script_on_the_published_ports():
    """Moves of joints and of the tool, a blended path, inverse kinematics and a payload, by ur-rtde's 42 kB program."""
    address = free_loopback()
    command = ("-m", "agent", "emulator", "--robot", "ur5e", "--address", address, "--clock", "real")
    with process(*command, says=f"fake controller: ur5e at {address}, clock real") as running:
        control = rtde_control.RTDEControlInterface(address)
        with disconnecting(rtde_receive.RTDEReceiveInterface(address)) as receive:
            assert control.isProgramRunning()
            assert control.moveJ(SQUARE.tolist(), 2.0, 4.0)
            assert waited_for(lambda: np.abs(np.subtract(receive.getActualQ(), SQUARE)).max() < 1e-3)
            here = receive.getActualTCPPose()
            there = [here[0] + 0.1, *here[1:]]
            assert control.moveL(there, 0.25, 1.2)
            assert waited_for(lambda: abs(receive.getActualTCPPose()[0] - there[0]) < 1e-3)
            assert control.moveL([[*here, 0.25, 1.2, 0.02], [*there, 0.25, 1.2, 0.0]])
            np.testing.assert_allclose(control.getInverseKinematics(here), SQUARE, atol=2e-3)
            assert control.setPayload(1.5, [0, 0, 0.05])
            assert waited_for(lambda: receive.getPayload() == 1.5)
            control.stopScript()
        control.disconnect()
        running.send_signal(signal.SIGTERM)


def test_control_asks_for_remote_mode(robot):
    with pytest.raises(RuntimeError, match="remote control"):
        rtde_control.RTDEControlInterface(robot(mode="teach"))
