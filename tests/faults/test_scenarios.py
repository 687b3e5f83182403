"""Every scenario that comes with the fake ends as its file says; and scenario files that make no sense are refused."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from drivers.wire.reasons import EndReason
from fake_controller.actuation import EFFECTS, OUTSIDE, load_effect
from fake_controller.build import build_controller
from fake_controller.faults import FAULTS, PHASES, Fault
from fake_controller.scenario import builtin_scenarios, load_scenario
from fake_controller.servers import open_server
from tests import warm
from tests.conftest import ROOT

#: In the quick tests; each fault on its own is there already.
QUICK = {
    ("unruly_line", "tcp"),
    ("emergency_stop_before_start", "tcp"),
    ("override_not_full", "modbus"),
    ("interrupted_and_cut", "modbus"),
}


@pytest.mark.parametrize(
    ("path", "wire"),
    [
        pytest.param(
            path, wire, id=f"{path.stem}-{wire}", marks=() if (path.stem, wire) in QUICK else pytest.mark.verify
        )
        for path in builtin_scenarios()
        for wire in load_scenario(path).wires
    ],
)
def test_scenario(bench, assert_at_rest, assert_readable, path: Path, wire: str):
    scenario = load_scenario(path)
    setup, expect = scenario.setup, scenario.expected(wire)
    state = setup.state.model_dump()
    # Only TCP carries the samples as fast as the arm can move.
    clock = setup.clock if wire == "tcp" else "real"
    controller = bench.serve(scenario.build_faults(), wire, clock, interrupt=scenario.interrupt, **state)
    ended = bench.record()
    assert ended.code == expect.exit_code, ended.errors
    astray = any(
        section.fault in ("off_path", "off_speed", "servo_error", "other_motion") for section in scenario.faults
    )
    assert_at_rest(controller, expect.motions, *((np.inf,) if astray else ()))
    if expect.controlled_stop and expect.motions and expect.exit_code:
        assert controller.ends != [EndReason.DONE]
    assert bench.log.exists() is expect.log_readable
    if expect.log_readable:
        assert assert_readable(bench.log) > 0


def test_every_fault_can_be_written_in_a_scenario(tmp_path: Path):
    lines = [f"  - {{fault: {name}, phase: {phase}}}" for name in FAULTS for phase in PHASES if phase in FAULTS[name]]
    path = tmp_path / "all.yaml"
    path.write_text("title: all\nfaults:\n" + "\n".join(lines) + "\nexpect: {exit_code: 4}\n", encoding="utf-8")
    assert len(load_scenario(path).build_faults()) == len(lines)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("faults: [{fault: gremlin, phase: connect}]", "there is no fault 'gremlin'"),
        ("faults: [{fault: refuse, phase: stop}]", "strikes in phase connect, not in 'stop'"),
        ("faults: [{fault: drop, phase: streaming, after: 1 kg}]", "after"),
        ("setup: {clock: slow}", "clock"),
        ("elsewhere: {telex: {exit_code: 0}}", "there is no wire 'telex'"),
        ("surprise: 1", "unknown key"),
    ],
)
def test_refuses_an_invalid_scenario(tmp_path: Path, text: str, said: str):
    path = tmp_path / "wrong.yaml"
    path.write_text(f"title: wrong\nexpect: {{exit_code: 4}}\n{text}\n", encoding="utf-8")
    with pytest.raises(InputError, match=said):
        load_scenario(path)


def test_refuses_an_invalid_fault():
    with pytest.raises(ValueError, match="strikes in phase"):
        Fault("wrong_robot", "streaming")


def test_refuses_a_fault_impossible_on_its_wire(arm):
    controller = build_controller(arm, 3, "fast", faults=[Fault("reorder", "streaming")])
    with pytest.raises(ValueError, match="reorder makes no sense on modbus: it sends one answer at a time"):
        open_server("modbus", controller)


def test_lists_all_effects_with_units_and_a_working_example(arm):
    listed = warm.run("fake_controller", "--list-effects", cwd=ROOT).stdout
    assert [effect for effect in [*EFFECTS, *OUTSIDE] if f"{effect} (joints: " not in listed] == []
    assert re.search(r"rise +\[N·m\] +required", listed)
    assert re.search(r"encoder_offset \(joints: one or more\)\n.*\n +offset +\[rad\]", listed)
    assert load_effect(json.loads(listed.splitlines()[1])).joints == ("joint_4",)
    here, there = os.pipe()
    os.close(here)  # a reader that has ended, as `head` does
    with open(there, "wb") as nobody:
        command = [sys.executable, "-m", "fake_controller", "--list-effects"]
        ended = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, check=True, cwd=ROOT)
    assert ended.stderr == b""


def test_a_fault_takes_a_joint_by_name_or_number(tmp_path: Path):
    path = tmp_path / "by_hand.yaml"
    named = "{fault: servo_error, phase: streaming, joint: joint_3}"
    path.write_text(f"title: by hand\nfaults: [{named}]\n", encoding="utf-8")
    (fault,) = load_scenario(path).build_faults()
    assert fault.joint == 3
    path.write_text(path.read_text().replace("joint_3", "elbow"), encoding="utf-8")
    with pytest.raises(InputError, match="there is no 'elbow'; there are joint_1, "):
        load_scenario(path).build_faults()
    assert all("expect" in load_scenario(path).model_fields_set for path in builtin_scenarios())
