"""The fake controller as a process of its own, as a user starts it."""

import re
import signal
from contextlib import closing

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.transports.tcp.driver import TcpDriver
from tests.warm import PipedProcess


def process(*options):
    return PipedProcess("fake_controller", *options)


def test_prints_its_address_and_ends_on_sigterm(tmp_path):
    ready = tmp_path / "ready"
    ready.write_text("an address that a killed one has left\n")
    with process("--port", "0", "--seed", "7", "--clock", "fast", "--ready-file", str(ready)) as running:
        line = running.stdout.readline()
        start, address = "fake controller: comau_ns16 at 127.0.0.1:", ready.read_text().strip()
        assert line == f"{start}{address.rpartition(':')[2]}, clock fast\n"
        with closing(TcpDriver(address)) as driver:
            driver.connect()
            assert driver.identify().robot == "comau_ns16"
            np.testing.assert_allclose(driver.status().position, np.radians([0, 0, -90, 0, 0, 0]), atol=1e-3)
            text = "PROGRAM p HOLD, PROG_ARM=1\nBEGIN CYCLE\n  MOVE JOINT TO {20,0,-90,0,0,0}\n" + (
                "  MOVE JOINT TO {0,0,-90,0,0,0}\nEND p\n"
            )
            driver.start("p", driver.upload("p", text))
            received = driver.samples()
            next(received)
            running.send_signal(signal.SIGTERM)
            blocks = []
            with pytest.raises(DriverError, match="switched off"):
                blocks.extend(received)
        np.testing.assert_allclose(blocks[-1].reference_velocity[-1], 0, atol=1e-9)
        assert running.wait(20) == 0
        assert running.stderr.read() == ""
    assert not ready.exists(), "nobody takes it for the next one's"


def test_reports_a_port_in_use():
    with process("--port", "0", "--clock", "fast") as first:
        port = first.stdout.readline().split(":")[2].split(",")[0]
        with process("--port", port) as second:
            assert second.wait(60) == 2
            assert f"cannot listen at 127.0.0.1:{port}" in second.stderr.read()


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--robot", "no_such_robot", "no_such_robot"),
        ("--seed", "-1", "no seed; a whole number from 0 on is"),
        ("--ready-file", "nowhere/ready", "nowhere/ready: cannot be written"),
    ],
)
def test_refuses_an_invalid_option(option, value, said):
    with process("--port", "0", "--clock", "fast", option, value) as running:
        assert running.wait(60) == 2
        assert said in (errors := running.stderr.read())
        assert "Traceback" not in errors


def test_a_link_whose_samples_need_a_broker(broker):
    with process("--driver", "cnr_comau", "--port", "0", "--clock", "fast", "--broker", "127.0.0.1:1") as running:
        assert running.wait(60) == 2
        assert "no MQTT broker at 127.0.0.1:1: " in (said := running.stderr.read())
        assert "apt-get install mosquitto" in said
    host, port = broker.address
    with process("--driver", "cnr_comau", "--port", "0", "--broker", f"{host}:{port}") as running:
        line = running.stdout.readline()
        assert re.search(rf" at 127.0.0.1,trajectory=\d+,feedback=\d+,status=\d+,ftp=\d+,mqtt={host}:{port},", line)
        running.send_signal(signal.SIGTERM)
        assert running.wait(20) == 0
