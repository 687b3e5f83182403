"""Driver and fake of a real controller's link together, with a broker between them that may end."""

import json
import time
from contextlib import closing, contextmanager

import numpy as np
import pytest

from agent.core.console import Console
from agent.pipeline.setup.check import check_recipe
from agent.robot import load_robot, torque_per_ampere
from drivers.conformance import _connect_when_free as connect_when_free
from drivers.errors import DriverError
from drivers.protocol import ViaPoint
from drivers.registry import create
from drivers.wire.cnr import IDENTITY_FILE, MessageType
from drivers.wire.reasons import EndReason
from fake_controller.build import build_controller
from fake_controller.servers.cnr.files import FtpFolder
from fake_controller.servers.cnr.server import CnrServer
from tests.conftest import patience
from tests.faults.conftest import RECIPE
from tests.link.conftest import start
from tests.link.test_long_runs import emulator

TEN_MINUTES = 600.0  # s
CPU = 0.60  # of a core
PROGRAM = """PROGRAM p HOLD, PROG_ARM=1
VAR
  k : INTEGER
BEGIN
  FOR k := 1 TO 2000 DO
    MOVE JOINT TO {FIRST}
    MOVE JOINT TO {SECOND}
  ENDFOR
END p
"""
ARM = PROGRAM.replace("FIRST", "20, -30").replace("SECOND", "-20, 30")
NS16 = PROGRAM.replace("FIRST", "20, 10, -80, 20, 20, 20").replace("SECOND", "0, 0, -90, 0, 0, 0")


@contextmanager
def connected(address, robot, **options):
    with closing(create("cnr_comau", address, **options)) as driver:
        driver.torque_per_ampere = torque_per_ampere(load_robot(robot))
        connect_when_free(driver)
        yield driver


def test_a_broker_that_ends_in_motion_stops_the_arm(arm, own_broker):
    controller = build_controller(arm, seed=3, clock="fast")
    with closing(CnrServer(controller, watchdog=patience(2.0), broker=own_broker.address, waits=True)) as server:
        with connected(server.address, arm) as driver:
            received = start(driver, ARM)
            assert len(next(received)) > 0
            own_broker.kill()
            with pytest.raises(DriverError, match=f"mqtt=…:{own_broker.address[1]}"):
                list(received)
        assert controller.wait(30)
        assert controller.motions_started == 1


def test_torque_from_currents_equals_the_measured_torque(arm, bench):
    """Through currents and back: what the driver hands out is what the controller measured."""
    with connected(bench.server.address, arm) as driver:
        blocks = list(start(driver, ARM.replace("2000", "1")))
    _, _, true = bench.controller.fetch(0, 100_000)
    got = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in vars(true)}
    at = next(k for k, torque in enumerate(got["torque"]) if np.allclose(torque, true.torque[1], rtol=1e-9))
    for name, values in vars(true).items():
        np.testing.assert_allclose(got[name][at : at + len(values) - 1], values[1:], rtol=1e-9, atol=1e-9)


def test_points_of_a_stopped_motion_are_not_kept_for_the_next(serve):
    """The programs go on with what was stopped only; nobody expects that of a start."""
    away, back = (ViaPoint(np.radians([turn, 0.0, -90.0, 0.0, 20.0, 0.0]), 0.0, 0.05) for turn in (10.0, 0.0))
    bench = serve("comau_ns16")
    server, controller = bench.server, bench.controller
    with connected(server.address, "comau_ns16") as driver:  # the pose it begins in is singular
        samples = start(driver, "PROGRAM p\nBEGIN\n  MOVE JOINT TO {0, 0, -90, 0, 20, 0}\nEND p\n")
        assert sum(map(len, samples)) > 0
    with connected(f"{server.address},mode=points", "comau_ns16") as driver:
        driver.load("swing", "0" * 64, [away, back])
        driver.start("swing", "0" * 64)
        received = driver.samples()
        next(received)
        driver.stop()
        assert not controller.moving
        assert sum(map(len, received)) > 0
        assert controller.motions_started == 2
        assert not driver._link.command(MessageType.START).success
        driver.load("back", "1" * 64, [back])
        driver.start("back", "1" * 64)
        assert sum(map(len, driver.samples())) > 0
    assert controller.ends == [EndReason.DONE, EndReason.STOPPED, EndReason.DONE]


def test_with_start_by_hand_an_operator_starts_and_stops(arm, bench):
    """The socket programs know nothing of a program that was started by hand: they ignore a stop."""
    told = []

    def person(text):
        told.append(text)
        if "press START" in text:
            bench.server.press_start()
        if "press HOLD" in text:
            bench.controller.stop(EndReason.STOPPED, "by hand")

    with connected(f"{bench.server.address},start=hand", arm) as driver:
        driver.tell = person
        received = start(driver, ARM)
        next(received)
        driver.stop()
        assert not bench.controller.moving
        assert sum(map(len, received)) > 0
        assert sum(map(len, start(driver, ARM.replace("2000", "1")))) > 0
    assert ["select program p" in text for text in told] == [True, False, True]
    assert bench.controller.ends == [EndReason.STOPPED, EndReason.DONE]


def test_a_rest_in_a_program_that_was_started_by_hand_is_no_stop(arm, serve):
    """Nobody presses HOLD, and the program rests for 1.5 s after every second move."""
    bench = serve(clock="real")
    with connected(f"{bench.server.address},start=hand", arm, start_timeout=patience(2.5)) as driver:
        driver.tell = lambda text: bench.server.press_start() if "press START" in text else None
        next(start(driver, ARM.replace("-20, 30}", "19, -30}\n    DELAY 1500")))
        with pytest.raises(DriverError, match="does not report the arm at rest; use the emergency stop"):
            driver.stop()
        assert bench.controller.moving


@pytest.mark.verify
def test_ten_minutes_at_500_hz(tmp_path, broker, measured):
    """Real time, five topics: every sample joined; the CPU is that of driver and reader."""
    options = ["--watchdog", "5", "--broker", "{}:{}".format(*broker.address)]
    with (
        emulator(tmp_path, "cnr_comau", "real", *options) as (_, address),
        connected(address, "comau_ns16") as driver,
    ):
        driver.start("p", driver.upload("p", NS16))
        began, cpu = time.monotonic(), time.process_time()
        sequence, stopped = [], False
        for block in driver.samples():
            sequence.append(block.sequence)
            if not stopped and time.monotonic() - began > TEN_MINUTES:
                share = (time.process_time() - cpu) / (time.monotonic() - began)
                driver.stop()
                stopped = True
        gaps, facts = driver.gaps, driver.facts
    count = sum(map(len, sequence))
    missing = {name: value for name, value in facts.items() if name.startswith("missing_") and value != "0"}
    measured("cnr_comau: samples joined of ten minutes at 500 Hz, lost", f"{count}, {len(gaps)}", "", "all", not gaps)
    measured("cnr_comau: CPU of the driver at 500 Hz", 100 * share, "% of a core", "below 60 %", share < CPU)
    np.testing.assert_array_equal(np.concatenate(sequence), np.arange(count))
    assert (gaps, missing) == ((), {})
    assert count >= 0.99 * 500 * TEN_MINUTES
    assert share < CPU


@pytest.mark.parametrize("mended", [False, True])
def test_warns_of_a_controller_without_a_confirmed_watchdog(arm, serve, tmp_path, mended, monkeypatch):
    """By the driver, and by `agent check`."""
    write = FtpFolder.write_identity

    def write_less(folder):
        write(folder)
        identity = folder.path / IDENTITY_FILE
        entry = json.loads(identity.read_text(encoding="utf-8"))
        del entry["watchdog"]
        identity.write_text(json.dumps(entry), encoding="utf-8")

    if not mended:
        monkeypatch.setattr(FtpFolder, "write_identity", write_less)
    server = serve().server
    with connected(server.address, arm) as driver:
        assert bool(driver.identify().unguarded) != mended
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE.format(robot=arm, driver="cnr_comau", address=server.address), encoding="utf-8")
    found = check_recipe(recipe, Console(-1))
    (said,) = (finding for finding in found.findings if finding.subject == "controller")
    assert said.exit_code == (0 if mended else 4)
    assert ("the published programs run on" in said.message) != mended
