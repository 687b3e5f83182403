"""Every driver against the emulator as a process of its own: quickly, and for ten minutes of motion."""

import os
import signal
import time
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from agent.recording import LogWriter, read_log
from agent.recording.mcap import writer
from agent.recording.mcap.log_file import LogFile
from drivers.registry import create
from tests.conftest import patience
from tests.warm import PipedProcess

MINUTE = 60.0  # s
TEN_MINUTES = 370  # cycles of the program below
WIRES = ("tcp", "modbus")


def program(cycles):
    return (
        "PROGRAM p HOLD, PROG_ARM=1\nVAR\n  k : INTEGER\nBEGIN\n"
        f"  FOR k := 1 TO {cycles} DO\n    MOVE JOINT TO {{20, 10, -80, 20, 20, 20}}\n"
        "    MOVE JOINT TO {0, 0, -90, 0, 0, 0}\n  ENDFOR\nEND p\n"
    )


@contextmanager
def emulator(tmp_path, wire, clock, *more):
    """The process, and the address it serves at."""
    ready = tmp_path / "ready"
    options = ("--driver", wire, "--clock", clock, "--port", "0", "--ready-file", ready, *more)
    with PipedProcess("fake_controller", *options) as process:
        assert process.stdout.readline()
        yield process, ready.read_text(encoding="utf-8").strip()


def cpu_of(process):
    """Seconds of CPU that a process has used."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_the_emulator_serves_modbus(tmp_path):
    with emulator(tmp_path, "modbus", "fast") as (process, address):
        with closing(create("modbus", address)) as driver:
            driver.connect()
            assert driver.identify().robot == "comau_ns16"
            driver.start("p", driver.upload("p", program(1)))
            sequence = np.concatenate([block.sequence for block in driver.samples()])
            np.testing.assert_array_equal(sequence, np.arange(len(sequence)))
            assert driver.gaps == ()
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


@pytest.mark.verify
def test_modbus_samples_per_second(tmp_path, measured):
    """Six joints over loopback, as fast as the emulator moves its arm."""
    with emulator(tmp_path, "modbus", "fast") as (_, address), closing(create("modbus", address)) as driver:
        driver.connect()
        driver.start("p", driver.upload("p", program(30)))
        began, cpu = time.monotonic(), time.process_time()
        count = sum(len(block) for block in driver.samples())
        rate, cost = count / (time.monotonic() - began), (time.process_time() - cpu) / count
        assert driver.gaps == ()
    measured("Modbus/TCP, six joints, loopback", rate, "samples/s", "at least 2 000", rate >= 2000)
    measured("CPU of the Modbus driver", 1e6 * cost, "µs a sample", "")
    assert rate >= 2000


@pytest.mark.verify
@pytest.mark.parametrize("wire", WIRES)
def test_ten_minutes_without_loss(tmp_path, measured, monkeypatch, wire):
    """300 000 samples, as fast as the wire carries them, onto a disk that stalls: every one, once, in order."""
    monkeypatch.setattr(writer, "LogFile", SlowDisk)
    path = tmp_path / "log.mcap"
    behind = 0
    with emulator(tmp_path, wire, "fast") as (_, address), closing(create(wire, address)) as driver:
        driver.connect()
        joints = driver.identify().joint_names
        driver.start("p", driver.upload("p", program(TEN_MINUTES)))
        with LogWriter(path, joints, robot="comau_ns16", motion="soak", sample_rate=500.0) as log:
            began, count = time.monotonic(), 0
            for block in driver.samples():
                assert block.sequence[0] == count
                count += len(block)
                log.write(block)
                behind = max(behind, log.backlog)
            elapsed = time.monotonic() - began
        assert driver.gaps == ()
        assert log.lost == 0
    stamps = read_log(path).t
    np.testing.assert_allclose(np.diff(stamps), 0.002, atol=1e-6)
    assert len(stamps) == count >= 300_000
    assert behind > 0
    measured(f"{wire}: samples of one run through a slow disk, lost", f"{count}, 0", "", "300 000, none")
    measured(f"{wire}: samples/s from a controller without a clock", count / elapsed, "samples/s", "")
    measured(f"{wire}: most that waited for the disk", behind / 2**20, "MiB", "below 256")


@pytest.mark.verify
@pytest.mark.parametrize("wire", WIRES)
def test_cost_at_500_hz(tmp_path, measured, wire):
    """A minute of real time; CPU of driver and reader, and of the whole emulator. A busy machine may stall for long."""
    with (
        emulator(tmp_path, wire, "real") as (process, address),
        closing(create(wire, address, watchdog=patience(2.0))) as driver,
    ):
        driver.connect()
        driver.start("p", driver.upload("p", program(10_000)))
        began, cpu, theirs = time.monotonic(), time.process_time(), cpu_of(process)
        count, stopped = 0, False
        for block in driver.samples():
            assert block.sequence[0] == count
            count += len(block)
            if not stopped and time.monotonic() - began > MINUTE:
                elapsed = time.monotonic() - began
                share, their_share = (time.process_time() - cpu) / elapsed, (cpu_of(process) - theirs) / elapsed
                driver.stop()
                stopped = True
        assert driver.gaps == ()
    assert count >= 0.99 * 500 * MINUTE
    measured(f"{wire}: CPU of the driver at 500 Hz", 100 * share, "% of a core", "below 35 %", share < 0.35)
    measured(f"{wire}: CPU of the emulator at 500 Hz, simulation included", 100 * their_share, "% of a core", "")
    assert share < 0.35


class SlowDisk(LogFile):
    """Stands still for a second now and then, as a memory card does."""

    EVERY = 10_000  # samples

    def write(self, samples):
        if samples.sequence[-1] // self.EVERY != (samples.sequence[0] - 1) // self.EVERY:
            time.sleep(1.0)
        super().write(samples)
