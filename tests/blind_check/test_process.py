"""The diagnosing process apart, and some runs from end to end."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from agent.blind_check import BlindCheck
from agent.core import Console, InputError, LocalProcesses, SafetyError, available_cores, sha256_text

ROOT = Path(__file__).resolve().parents[2]
QUIET = Console(verbosity=-1)


def test_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="at least one run"):
        BlindCheck(0, 1, tmp_path).run(QUIET)


def test_the_diagnosis_can_open_nothing_near_the_key_but_what_it_is_told(tmp_path):
    script = (
        "import os, sys\n"
        "from agent.blind_check.worker import Guard\n"
        "folder = sys.argv[1]\n"
        "guard = Guard(folder)\n"
        "guard.allowed = {os.path.realpath(os.path.join(folder, 'told.json'))}\n"
        "guard.closed = True\n"
        "sys.addaudithook(guard)\n"
        "print(open(os.path.join(folder, 'told.json')).read())\n"
        "def tried(what):\n"
        "    try: what()\n"
        "    except PermissionError: return 'refused'\n"
        "    return 'done'\n"
        "import socket, subprocess\n"
        "print(tried(lambda: open(os.path.join(folder, 'key.json'))))\n"
        "print(tried(lambda: open(os.path.join(folder, 'x', '..', 'key.json'))))\n"
        "print(tried(lambda: os.listdir(folder)))\n"
        "print(tried(lambda: subprocess.run(['cat', os.path.join(folder, 'key.json')])))\n"
        "print(tried(lambda: socket.create_connection(('127.0.0.1', 9))))\n"
    )
    (tmp_path / "told.json").write_text("told")
    (tmp_path / "key.json").write_text("secret")
    run = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.split() == ["told", *["refused"] * 5], run.stderr


def test_a_run_that_breaks_the_diagnosis_is_told_and_does_not_end_the_check(tmp_path, monkeypatch, capsys):
    from agent.blind_check import worker

    def broken(job):
        raise FloatingPointError("overflow")

    monkeypatch.setattr(worker, "diagnose_job", broken)
    assert worker._answer({}) == {"error": "internal error in the diagnosis: FloatingPointError: overflow"}
    assert "FloatingPointError" in capsys.readouterr().err


def write_small_arm(folder: Path) -> Path:
    """A robot.yaml of three axes, so that a run takes seconds."""
    parts, joints, parent = ['<robot name="bars"><link name="base"/>'], [], "base"
    drives = ((40, "0 0 1", 1.5, 4e-4), (25, "0 1 0", 1.5, 4e-4), (10, "0 1 0", 0.6, 1.5e-4))
    for k, (mass, axis, torque, rotor) in enumerate(drives, start=1):
        bar = mass * 0.4**2 / 12
        place = ("0 0 0.5", "0 0 0", "0.4 0 0")[k - 1]
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="0.2 0 0.05"/><mass value="{mass}"/>'
            f'<inertia ixx="{0.1 * bar}" iyy="{bar}" izz="{bar}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint_{k}" type="revolute"><parent link="{parent}"/><child link="link_{k}"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/>'
            '<limit lower="-2.2" upper="2.2" velocity="3" effort="2000"/></joint>'
        )
        parent = f"link_{k}"
        joints.append(
            f"  - {{name: joint_{k}, gear_ratio: 100, nominal_motor_torque: {torque}, max_velocity: 2.5, "
            f"max_acceleration: 6.0, rotor_inertia: {rotor}}}"
        )
    (folder / "bars.urdf").write_text("".join([*parts, "</robot>"]))
    robot = folder / "robot.yaml"
    robot.write_text("\n".join(["name: bars", "urdf: bars.urdf", f"tip_frame: {parent}", "joints:", *joints, ""]))
    return robot


def test_a_machine_of_which_no_model_can_be_made_does_not_end_the_check(tmp_path, monkeypatch):
    def stopped(self, case):
        raise SafetyError("the tool is 302 mm off")

    monkeypatch.setattr(BlindCheck, "_make_model", stopped)
    scores = BlindCheck(2, 1, tmp_path / "check").run(QUIET)
    assert [case["outcome"] for case in scores["cases"]] == ["not recorded"] * 2


@pytest.fixture(scope="module")
def check(tmp_path_factory) -> BlindCheck:
    """Six short runs, done: two without an effect, three with, and one with an effect outside the catalogue."""
    folder = tmp_path_factory.mktemp("blind")
    whole = BlindCheck(6, 1, folder / "check", robot=str(write_small_arm(folder)), cycle=1.6)
    with LocalProcesses(2) as engine:
        whole.run(QUIET, engine)
    return whole


@pytest.fixture(scope="module")
def done(check) -> Path:
    """Their folder."""
    return check.folder


def test_runs_are_recorded_diagnosed_and_scored(done):
    scores = json.loads((done / "blind_check.json").read_text())
    assert scores["runs"] == 6
    assert scores["not_recorded"] == []
    assert sum(sum(kinds.values()) for kinds in scores["outcomes"].values()) == 6
    assert scores["kinds"] == {"one": 2, "two": 1, "none": 2, "outside": 1}
    assert scores["false_alarms"] | {"count": 0, "of": 2} == scores["false_alarms"]
    assert scores["top_1"]["count"] >= 2
    assert scores["closure"]["of_oracle"] > 0.8
    assert scores["closure"]["wrong_effect"] < scores["closure"]["oracle"]
    assert (done / "blind_check.md").read_text().startswith("# Blind check")


def test_the_key_is_the_one_that_was_sealed(done):
    sealed = (done / "key.sha256").read_text().split()[0]
    assert sha256_text((done / "key.json").read_text()) == sealed
    assert json.loads((done / "blind_check.json").read_text())["key_sha256"] == sealed


def test_nothing_but_the_key_tells_what_was_built_in(done):
    key = json.loads((done / "key.json").read_text())
    machines = {str(case["machine"]) for case in key["cases"]}
    for path in done.glob("runs/*/diagnosis.json"):
        assert not machines & set(path.read_text().replace('"', " ").split())
    for path in done.rglob("*.mcap"):
        data = path.read_bytes()
        assert not any(effect["effect"].encode() in data for case in key["cases"] for effect in case["effects"])


def test_a_rerun_goes_on_and_does_nothing_twice(check, done):
    def stamps():
        return {path: path.stat().st_mtime_ns for path in done.rglob("diagnosis.json")}

    before = stamps()
    # One without an effect: it is the quickest to judge again.
    key = json.loads((done / "key.json").read_text())
    number = next(case["number"] for case in key["cases"] if not case["effects"])
    (lost,) = (path for path in before if int(path.parent.name) == number)
    first = json.loads(lost.read_text())["result"]
    lost.unlink()
    (lost.parent / "judged.json").unlink()
    check.run(QUIET)
    after = stamps()
    assert {path for path in before if after[path] != before[path]} == {lost}
    assert json.loads((lost.parent / "judged.json").read_text())["number"] == number
    assert json.loads(lost.read_text())["result"] == first, "another process comes to another answer"


@pytest.mark.verify
def test_blind_check(measured):
    """What is finished is kept in `.verify/`, and so is its page."""
    folder = ROOT / ".verify" / "blind_check"
    with LocalProcesses(available_cores()) as engine:
        scores = BlindCheck(400, 1, folder).run(Console(), engine)
    alarms = scores["false_alarms"]["count"]
    figures = (
        ("false alarms in effect-free runs", alarms, "at most 1 of 150", alarms <= 1),
        ("first cause right", scores["top_1"]["share"], "at least 0.9", scores["top_1"]["share"] >= 0.9),
        ("right joint", scores["joint"]["share"], "at least 0.95", scores["joint"]["share"] >= 0.95),
        (
            "effects outside the catalogue called unknown",
            scores["unknowns_recognised"]["share"],
            "at least 0.8",
            scores["unknowns_recognised"]["share"] >= 0.8,
        ),
        (
            "median closure over the oracle's",
            scores["closure"]["of_oracle"],
            "at least 0.9",
            scores["closure"]["of_oracle"] >= 0.9,
        ),
        (
            "confident wrong names with the true effect withheld",
            scores["withheld"]["confident_wrong_names"]["share"],
            "at most 0.1",
            scores["withheld"]["confident_wrong_names"]["share"] <= 0.1,
        ),
    )
    for what, value, target, ok in figures:
        measured(f"blind check: {what}", value, "", target, ok)
    assert scores["runs"] == 400
