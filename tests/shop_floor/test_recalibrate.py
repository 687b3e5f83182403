"""Calibrating again by the clock, over a real socket, with everything that can be in the way."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.model import IdentifiedModel
from tests.shop_floor.conftest import agent, authorisation, runs_with_state

ADDRESS = r'address: "[^"]*"'


def _change_recipe(shop: Path, old: str, new: str) -> None:
    recipe = shop / "recipe.yaml"
    recipe.write_text(re.sub(old, new, recipe.read_text(encoding="utf-8")), encoding="utf-8")


def _current(shop: Path) -> Path:
    return shop / "logs" / "models" / "comau_ns16_FAKE-0007" / "current" / "model.json"


def test_reruns_the_stored_loop_and_makes_the_accepted_model_current(calibrated, recalibrated):
    (first,) = runs_with_state(calibrated)
    assert _current(calibrated).read_bytes() == (first / "model.json").read_bytes(), "the first accepted one is current"
    shop, folder, said = recalibrated
    first, later = shop / "logs" / first.name, shop / "logs" / f"{first.name}_2"
    assert "search" not in said
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert result["accepted"]
    assert result["reference"] == first.name, "what it was compared with: the current model, not the newest run"
    assert json.loads((folder / "state.json").read_text(encoding="utf-8"))["reference"] == first.name
    assert json.loads((folder / "comparison.json").read_text(encoding="utf-8"))["before"] == first.name
    assert result["current_model"] == folder.name
    assert "current model       this run" in said
    assert result["diagnosis"] is None
    assert max(result["validation"]["normalised_rmse"]) < 0.01
    assert (folder / "program.pdl").read_bytes() == (first / "program.pdl").read_bytes()
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")

    before, after = (IdentifiedModel.load(path / "model.json") for path in (first, folder))
    assert np.array_equal(before.base_values, after.base_values), "friction alone was estimated"
    assert not np.array_equal(before.values, after.values)
    assert before.names == after.names
    assert (
        np.linalg.eigvalsh(after.covariance / np.outer(after.standard_deviations, after.standard_deviations))[0] > -1e-9
    )
    assert _current(shop).read_bytes() == (folder / "model.json").read_bytes()

    listed = json.loads(agent(shop, "history", "--json").stdout)["runs"]
    assert [(entry["run"], entry["kind"], entry["current"]) for entry in listed] == [
        (first.name, "calibrate", False),
        (later.name, "calibrate", False),
        (folder.name, "recalibrate", True),
    ]
    compared = json.loads(agent(shop, "compare", first.name, folder.name, "--json").stdout)
    assert not any(entry["moved"] for entry in compared["parameters"]), "nothing was done to the machine"
    assert max(compared["torque"]["normalised_rmse"]) < 0.005


def test_skips_a_recent_calibration_with_a_reason_and_opens_no_port(shop, run_agent):
    _change_recipe(shop, ADDRESS, 'address: "127.0.0.1:1"')
    _change_recipe(shop, "every: 1 s", "every: 7 d")
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("skipped: the last accepted run")
    assert "due in 7.0 d" in run.stdout
    assert len(runs_with_state(shop)) == 1, "a skipped one leaves no folder"


def test_without_a_calibration_the_message_says_what_to_do(tmp_path, shop, run_agent):
    run = run_agent("recalibrate", "recipe.yaml", "--logs", tmp_path / "other")
    assert run.returncode == 2
    assert "agent calibrate" in run.stderr


def test_another_sub_region_needs_its_own_calibration(shop, run_agent):
    _change_recipe(shop, "500 mm, 600 mm", "450 mm, 600 mm")
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 2
    assert "no accepted calibration" in run.stderr


def test_a_missed_gate_keeps_the_current_model(shop, run_agent):
    _change_recipe(shop, "3 %", "0.01 %")
    before = _current(shop).read_bytes()
    run = run_agent("recalibrate", "recipe.yaml", "--json")
    assert run.returncode == 3
    result = json.loads(run.stdout)
    assert not result["accepted"]
    assert "the gate is 0.01 %" in result["reason"]
    assert _current(shop).read_bytes() == before
    assert run_agent("apply", runs_with_state(shop)[-1].name).returncode == 2, (
        "a rejected model is not applied by hand either"
    )


def test_impossible_torque_makes_no_model(shop, run_agent, tmp_path, start_controller):
    effects = tmp_path / "millimetres.json"
    joints = [f"joint_{k + 1}" for k in range(6)]
    effects.write_text(
        json.dumps([{"effect": "torque_constant", "joints": joints, "parameters": {"scale": 1000}}]), encoding="utf-8"
    )
    other = start_controller("--effects", str(effects))
    _change_recipe(shop, ADDRESS, f'address: "{other.address}"')
    before = _current(shop).read_bytes()
    run = run_agent("recalibrate", "recipe.yaml", "--yes")
    assert run.returncode == 3, run.stderr
    assert "excitation.mcap: torques look like N·mm" in run.stderr
    assert not (runs_with_state(shop)[-1] / "model.json").exists()
    assert _current(shop).read_bytes() == before


def test_refuses_another_machine_of_the_same_type(shop, run_agent, start_controller):
    other = start_controller("--seed", "8")
    _change_recipe(shop, ADDRESS, f'address: "{other.address}"')
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 4
    assert "FAKE-0008" in run.stderr
    assert "FAKE-0007" in run.stderr


def test_an_unreachable_controller_exits_with_4_and_is_in_the_history(shop, run_agent):
    _change_recipe(shop, ADDRESS, 'address: "127.0.0.1:1"')
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 4
    assert "Traceback" not in run.stderr
    listed = json.loads(run_agent("history", "--json").stdout)["runs"]
    assert listed[-1]["status"] == "stopped"
    assert "no controller answers" in listed[-1]["reason"]


def test_a_busy_robot_exits_with_75(shop, run_agent, controller):
    hold = (
        "import sys\nfrom agent.runs.lock import robot_lock\n"
        f"with robot_lock('tcp', '{controller.address}'):\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )
    root = Path(__file__).resolve().parents[2]
    holder = subprocess.Popen(
        [sys.executable, "-c", hold],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert holder.stdout.readline() == "held\n"
    run = run_agent("recalibrate", "recipe.yaml")
    holder.communicate("")
    assert run.returncode == 75
    assert len(runs_with_state(shop)) == 1


@pytest.fixture(scope="module")
def estimated_again(calibrated: Path, tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The shop after an authorised recalibration of all parameters."""
    folder = tmp_path_factory.mktemp("again") / "shop"
    shutil.copytree(calibrated, folder, symlinks=True)
    _change_recipe(folder, "parameters: friction", "parameters: all")
    return folder, agent(folder, "recalibrate", "recipe.yaml", "--authorisation", authorisation(folder), "-q")


def test_a_matching_authorisation_allows_the_motion(estimated_again):
    _, run = estimated_again
    assert run.returncode == 0, run.stderr


def test_estimates_all_parameters_again_on_request(estimated_again):
    before, after = (IdentifiedModel.load(path / "model.json") for path in runs_with_state(estimated_again[0]))
    assert before.names == after.names, "the structure is kept, so that runs can be compared"
    assert not np.array_equal(before.base_values, after.base_values)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"serial": "FAKE-0008"}, "it is for serial FAKE-0008"),
        ({"program": "0" * 64}, "it is for program 000000000000"),
        ({"limits": {"speed": "0.25 m/s", "duration": "5 min"}}, "0.25 m/s are allowed"),
        ({"limits": {"speed": "1.1 m/s", "duration": "5 s"}}, "5 s are allowed"),
        ({"expires": "2020-01-01"}, "it ended on 2020-01-01"),
    ],
)
def test_an_authorisation_for_something_else_prevents_motion(shop, run_agent, changes, why: str):
    path = authorisation(shop, **changes)
    run = run_agent("recalibrate", "recipe.yaml", "--authorisation", path)
    assert run.returncode == 2
    assert why in run.stderr
    assert not (runs_with_state(shop)[-1] / "excitation.mcap").exists()


@pytest.mark.verify
def test_authorised_new_motions_settle_an_open_question(shop, run_agent, tmp_path, start_controller):
    effects = tmp_path / "spring.json"
    spring = {"preload": 12.0, "rate": 6.0, "angle": 0.3}
    effects.write_text(
        json.dumps([{"effect": "gravity_spring", "joints": ["joint_6"], "parameters": spring}]), encoding="utf-8"
    )
    changed = start_controller("--clock", "fast", "--effects", str(effects))
    _change_recipe(shop, ADDRESS, f'address: "{changed.address}"')
    run = run_agent("recalibrate", "recipe.yaml", "--authorisation", authorisation(shop), "--json")
    assert "rounds" not in json.loads(run.stdout)["diagnosis"]["result"], "not released"
    released = authorisation(shop, new_motions={"duration": "2 min"})
    run = run_agent("recalibrate", "recipe.yaml", "--authorisation", released, "--json")
    found = json.loads(run.stdout)["diagnosis"]["result"]
    assert found["rounds_end"]
    folder = runs_with_state(shop)[-1]
    for number, one in enumerate(found["rounds"], start=1):
        assert one["duration_s"] <= 60.0
        assert (folder / f"experiment_{number:02d}.mcap").exists()
    assert "Results of further motions" in (folder / "report.html").read_text(encoding="utf-8")
