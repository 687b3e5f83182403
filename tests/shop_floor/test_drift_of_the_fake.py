"""The whole way, twenty recalibrations of a machine that wears and warms up: found where it is, and not where not."""

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest

from agent.runs import History, watch

RUNS = 20
JOINTS = [f"joint_{k + 1}" for k in range(6)]


def _history(shop: Path, run_agent, start_controller, seed: int, worn: str | None) -> tuple:
    """Recalibrate `RUNS` times; each run starts somewhere in the warm-up of all axles."""
    rng = np.random.default_rng(seed)
    recipe = shop / "recipe.yaml"
    for number in range(RUNS):
        warm_up = {
            "start": -25.0 * rng.uniform(),
            "equilibrium": 5.0,
            "time_constant": 600.0,
            "coulomb_rate": 0.002,
            "viscous_rate": 0.01,
        }
        effects = [{"effect": "thermal_friction", "joints": JOINTS, "parameters": warm_up}]
        if worn is not None:
            level = 1.0 + 0.10 * number / (RUNS - 1)
            change = {"coulomb": level, "viscous": level}
            effects.append({"effect": "friction_change", "joints": [worn], "parameters": change})
        path = shop / "effects.json"
        path.write_text(json.dumps(effects), encoding="utf-8")
        machine = start_controller("--seed", "7", "--effects", str(path))
        text = re.sub(r'address: "[^"]*"', f'address: "{machine.address}"', recipe.read_text(encoding="utf-8"))
        recipe.write_text(text, encoding="utf-8")
        run = run_agent("recalibrate", "recipe.yaml", "-q")
        machine.end()
        assert run.returncode == 0, run.stderr
    history = History(shop / "logs")
    return tuple(watch(history.runs()))


@pytest.mark.verify
def test_finds_wear_on_its_axle(shop, run_agent, start_controller, measured):
    (one,) = _history(shop, run_agent, start_controller, 1, "joint_3")
    found = [trend.joint for trend in one.alarms]
    change = next((trend.change for trend in one.alarms if trend.joint == "joint_3"), 0.0)
    measured("wear of +10 % on joint_3 over 20 runs, warm-up on all: alarms on", ", ".join(found), "", "joint_3 alone")
    measured("its size as found", 100 * change, "%", "10 %", 0.05 < change < 0.15)
    assert found == ["joint_3"]


@pytest.mark.verify
def test_no_alarm_without_wear(shop, run_agent, start_controller, measured):
    (one,) = _history(shop, run_agent, start_controller, 2, None)
    found = [trend.joint for trend in one.alarms]
    measured("20 runs with warm-up on all axles and no wear: alarms", len(found), "", "none", not found)
    assert found == []


@pytest.mark.verify
def test_a_recalibration_in_real_time_takes_its_motion_and_a_little(shop, run_agent, start_controller, measured):
    """The motion's own time plus at most 10 s."""
    machine = start_controller("--seed", "7", "--clock", "real")
    recipe = shop / "recipe.yaml"
    text = re.sub(r'address: "[^"]*"', f'address: "{machine.address}"', recipe.read_text(encoding="utf-8"))
    recipe.write_text(text, encoding="utf-8")
    started = time.monotonic()
    run = run_agent("recalibrate", "recipe.yaml", "--json", "-q")
    took = time.monotonic() - started
    assert run.returncode == 0, run.stderr
    motion = json.loads(run.stdout)["recordings"][0]["duration"]
    beyond = took - motion
    measured("recalibration in real time, beyond the motion itself", beyond, "s", "at most 10 s", beyond <= 10)
    assert took > motion, "in real time a motion takes its time"
