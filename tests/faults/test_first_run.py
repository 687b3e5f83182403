"""A program that is new to a machine, through the command line; the fake says that it drives one."""

import json

import numpy as np

from agent.recording import Log, read_log
from agent.robot import kinematics_for
from fake_controller.controller import PERIOD, Controller
from fake_controller.faults import Fault


def tool_speed(log: Log, controller: Controller) -> float:
    """Highest speed of the tool centre point that the controller asked for [m/s]."""
    place = kinematics_for(controller.robot).forward(log.reference_position)[:, :3, 3]
    return float(np.linalg.norm(np.diff(place, axis=0), axis=1).max() / PERIOD)


def test_the_first_run_is_slow_and_the_second_is_not(bench, assert_at_rest):
    controller = bench.serve(emulator=False)
    asked = bench.record()
    assert asked.code == 2
    assert "nobody confirmed" in asked.errors
    assert controller.motions_started == 0

    first = bench.record("--yes")
    assert first.code == 0, first.errors
    assert "no more than 0.25 m/s" in first.errors
    assert_at_rest(controller, 2)
    slow, full = read_log(bench.folder / "swing.first_run.mcap"), read_log(bench.log)
    assert slow.metadata["motion"] == "first_run"
    assert tool_speed(slow, controller) < 1.1 * 0.25 < tool_speed(full, controller)
    kept = json.loads((bench.folder / "logs" / "checked_programs.json").read_text(encoding="utf-8"))
    assert [entry["serial"] for entry in kept["programs"]] == [controller.serial]

    bench.log = bench.folder / "again.mcap"
    again = bench.record("--yes")
    assert again.code == 0, again.errors
    assert controller.motions_started == 3, "what has run slowly once is not run slowly again"

    bench.log = bench.folder / "other.mcap"
    other = bench.serve(emulator=False)
    other.serial = "FAKE-0004"
    assert bench.record("--yes").code == 0
    assert other.motions_started == 2, "another machine"


def test_repeats_a_slow_first_run_that_was_cut_short(bench):
    controller = bench.serve([Fault("emergency_stop", "streaming", 0.3)], emulator=False)
    assert bench.record("--yes").code == 5
    assert controller.motions_started == 1
    controller.state.emergency_stop, controller.state.drives_on = False, True
    assert bench.record("--yes").code == 0
    assert controller.motions_started == 3
    assert (bench.folder / "swing.first_run.2.mcap").exists()
