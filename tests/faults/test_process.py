"""What only processes of their own show: scenarios and effects by hand, full disks, signals, kill -9."""

import json
import resource
import signal
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from agent.recording import read_log
from drivers.errors import DriverError
from drivers.registry import create
from fake_controller.scenario import FOLDER
from tests import warm
from tests.faults.conftest import LONG


def until_it_moves(agent: warm.PipedProcess) -> None:
    assert any("of motion" in line for line in agent.stderr), "the agent ended before anything moved"


def until_it_rests(wire: str, address: str) -> None:
    """A client that comes after one that was lost sees the end of the stop, which a controller may be slow to begin."""
    until = time.monotonic() + 60.0
    while True:
        try:
            with closing(create(wire, address)) as driver:
                driver.connect()
                if not driver.status().moving:
                    return
        except DriverError:  # it has not noticed yet that the one before is gone
            assert time.monotonic() < until
        assert time.monotonic() < until, "the arm still moves"


BY_HAND = ["tcp", pytest.param("modbus", marks=pytest.mark.verify)]


@pytest.mark.parametrize("wire", BY_HAND)
def test_the_emulator_runs_a_scenario(bench, tmp_path: Path, arm: str, wire):
    """`agent emulator --scenario` on a wire: it says what it is, and at its end what was done with it."""
    scenario = tmp_path / "s.yaml"
    scenario.write_text(
        f"title: pulled\nsetup: {{robot: '{arm}', seed: 4}}\nfaults: [{{fault: drop, phase: start}}]\n"
        "expect: {exit_code: 4}\n",
        encoding="utf-8",
    )
    words = ("emulator", "--scenario", scenario, "--driver", wire, "--port", "0")
    with warm.PipedProcess("agent", *words, cwd=tmp_path) as fake:
        greeting = fake.stdout.readline()
        assert greeting.startswith("fake controller: small_arm at ")
        address = greeting.split(" at ")[1].split(", clock")[0]
        bench.write_for(wire, address)
        ended = bench.record()
        assert ended.code == 4, ended.errors
        until_it_rests(wire, address)
        fake.send_signal(signal.SIGTERM)
        said, errors = fake.communicate()
    assert fake.returncode == 0
    assert "scenario" in errors
    assert "pulled" in errors
    assert "motions started 1; ended: " in said
    assert "at rest" in said


def test_refuses_a_scenario_impossible_on_its_wire(tmp_path: Path):
    scenario = ["--scenario", FOLDER / "unruly_line.yaml", "--driver", "modbus", "--port", "0"]
    refused = warm.run("fake_controller", *scenario, cwd=tmp_path)
    assert refused.returncode == 2
    assert "reorder makes no sense on modbus" in refused.stderr


def test_the_emulator_takes_effects_from_a_file(start_controller, tmp_path: Path, arm: str):
    effects = tmp_path / "effects.json"
    effects.write_text(json.dumps([{"effect": "payload", "parameters": {"mass": 2.0}}]), encoding="utf-8")
    assert "small_arm at 127.0.0.1:" in start_controller("--robot", arm, "--effects", str(effects)).greeting
    effects.write_text('{"effect": "payload"}', encoding="utf-8")
    wrong = warm.run("fake_controller", "--effects", effects, "--port", "0", cwd=tmp_path)
    assert wrong.returncode == 2
    assert "a list of effects is expected" in wrong.stderr


def test_a_full_disk_stops_the_arm(bench, tmp_path: Path, assert_at_rest, assert_readable):
    """No file grows beyond 100 kB."""
    controller = bench.serve()
    bench.program.write_text(LONG, encoding="utf-8")
    record = ("agent", "record", bench.recipe, "--program", bench.program, "-o", bench.log)
    with warm.PipedProcess(*record, cwd=tmp_path) as agent:
        resource.prlimit(agent.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
        _, errors = agent.communicate()
    assert agent.returncode == 1, errors
    assert "Traceback" not in errors
    assert str(bench.log) in errors
    assert "free" in errors
    assert_at_rest(controller, 1)
    assert controller.ends[0].name in ("STOPPED", "WATCHDOG")
    assert assert_readable(bench.log) > 0


def test_an_unwritable_folder_prevents_motion(bench, run):
    controller = bench.serve()
    bench.log = Path("/proc/no_such_folder/log.mcap")
    ended = bench.record()
    assert ended.code == 1
    assert "/proc/no_such_folder/log.mcap" in ended.errors
    assert controller.motions_started == 0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_in_a_controlled_stop(bench, assert_at_rest, assert_readable, number, code):
    controller = bench.serve(clock="real", interrupt=0.3, number=number)
    ended = bench.record()
    assert ended.code == code
    assert_at_rest(controller, 1)
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert assert_readable(bench.log) > 100


def test_a_second_agent_on_one_robot_exits_with_75(bench, tmp_path: Path):
    controller = bench.serve(clock="real")
    record = ("agent", "record", bench.recipe, "--program", bench.program, "-o")
    with warm.PipedProcess(*record, bench.log, cwd=tmp_path) as first:
        until_it_moves(first)
        second = warm.run(*record, bench.folder / "second.mcap", cwd=tmp_path)
    assert second.returncode == 75
    assert "another run holds this robot" in second.stderr
    assert controller.motions_started == 1


def test_a_clock_that_jumps_changes_nothing(bench, monkeypatch, assert_readable):
    """Receive time is the wall's; analysis and watchdogs do not depend on it."""
    import time

    true, calls = time.time, iter(range(10**9))
    monkeypatch.setattr(time, "time", lambda: true() + (-1) ** next(calls) * 86_400)
    bench.serve()
    ended = bench.record()
    assert ended.code == 0, ended.errors
    assert assert_readable(bench.log) > 1000


@pytest.mark.parametrize("attempt", [0, *(pytest.param(k, marks=pytest.mark.verify) for k in range(1, 12))])
def test_kill_9_at_any_moment(bench, tmp_path: Path, assert_at_rest, attempt):
    controller = bench.serve(clock="real")
    bench.program.write_text(LONG, encoding="utf-8")
    moment = int(np.random.default_rng(attempt).integers(200, 1500))
    record = ("agent", "record", bench.recipe, "--program", bench.program, "-o", bench.log)
    with warm.PipedProcess(*record, cwd=tmp_path) as agent:
        until_it_moves(agent)
        while controller.recorded < moment:
            time.sleep(0.001)
        sent = controller.recorded
        agent.kill()
    assert controller.wait(20.0)
    assert controller.ends[0].name == "WATCHDOG"
    assert_at_rest(controller, 1)
    log = read_log(bench.log)
    assert len(log.t) >= sent - 500, "more than the last second is missing"
    assert np.all(np.diff(log.t) > 0)
