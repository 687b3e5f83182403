"""Measured data of real arms: known effects are named, and no cause where a model meets other logs of its own arm."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agent.diagnosis import diagnose
from agent.estimation import estimate
from agent.recording import import_log, read_log
from agent.robot import load_robot

EXAMPLES = Path(__file__).resolve().parents[2] / "recipes/examples"
TX40 = ("tx40/pos_read_data.csv", "tx40/curr_data.csv")
SLOW = pytest.mark.verify
XL330 = [f"kp{gain}_{motion}" for gain in (200, 400) for motion in ("sin_sin", "up_and_down")]


def _imported(shared_data, tmp_path, map_file, *tables):
    file = EXAMPLES / map_file
    robot, out = load_robot(file.parent / "robot.yaml"), tmp_path / f"{file.stem}.mcap"
    import_log(robot, file, [shared_data / table for table in tables], out)
    return robot, read_log(out, robot)


def test_a_wrist_coupling_left_out_is_found(shared_data, tmp_path, measured):
    imported = [_imported(shared_data, tmp_path, f"tx40/map_{part}.yaml", *TX40) for part in ("fit", "held_out")]
    uncoupled = replace(imported[0][0], motor_coupling=tuple(tuple(float(i == j) for j in range(6)) for i in range(6)))
    cause = diagnose(uncoupled, [log for _, log in imported], cutoff=20.0).result["causes"][0]
    right = (cause["effect"], cause["joints"]) == ("wrist_coupling", ["joint_5", "joint_6"])
    measured("TX40 without its wrist coupling", cause["effect"], "", "wrist_coupling, joints 5 and 6", right)
    assert right


def test_asymmetric_friction_of_a_linear_drive_is_found(shared_data, tmp_path, measured):
    robot, log = _imported(shared_data, tmp_path, "emps/map.yaml", "emps/DATA_EMPS.mat")
    cause = diagnose(robot, [log]).result["causes"][0]
    named = [cause["effect"], *(entry["effect"] for entry in cause["equivalent_to"])]
    measured("EMPS, symmetric friction", cause["effect"], "", "asymmetric_friction", "asymmetric_friction" in named)
    assert "asymmetric_friction" in named


def _control(robot, fitted, held_out) -> None:
    result = diagnose(robot, held_out, estimate(robot, fitted)).result
    assert result["verdict"] in ("no_gap", "unknown")
    assert result["causes"] == []


@pytest.mark.parametrize(
    ("folder", "description", "fitted", "held_out"),
    [
        ("bam_xl330", "robot.yaml", XL330[::2], XL330[1::2]),
        ("kr300", "robot_real.yaml", "AB", "C"),  # it begins in motion, with a friction that nobody knows
        ("kr300", "robot_dummy.yaml", "BC", "A"),  # simulations of its elasticity are unstable
        *(
            pytest.param("kr300", f"robot_{inertials}.yaml", sorted({*"ABC"} - {held_out}), held_out, marks=SLOW)
            for inertials in ("real", "none", "dummy")
            for held_out in "ABC"
            if (inertials, held_out) not in (("real", "C"), ("dummy", "A"))
        ),
        pytest.param("bam_xl330", "robot.yaml", XL330[1::2], XL330[::2], marks=SLOW),
        pytest.param("tiago", "robot.yaml", ["fit"], ["held"], marks=SLOW),
        pytest.param("tiago", "robot.yaml", ["held"], ["fit"], marks=SLOW),
    ],
)
def test_a_model_of_some_logs_finds_no_cause_in_the_others(shared_data, folder, description, fitted, held_out):
    source = shared_data / "real-dev" / folder
    robot = load_robot(source / description)
    logs = {name: read_log(source / f"{name}.mcap", robot) for name in (*fitted, *held_out)}
    _control(robot, [logs[name] for name in fitted], [logs[name] for name in held_out])


@SLOW
@pytest.mark.parametrize("order", [1, -1])
def test_a_model_of_half_of_a_linear_drives_log_finds_no_cause_in_the_other(shared_data, tmp_path, order):
    robot, log = _imported(shared_data, tmp_path, "emps/map.yaml", "emps/DATA_EMPS.mat")
    edges = np.linspace(log.t[0], log.t[-1] + 1, 3)
    halves = [log.between(start, stop) for start, stop in pairwise(edges)][::order]
    _control(robot, halves[:1], halves[1:])


@SLOW
def test_a_model_of_the_end_of_a_log_of_a_tx40_finds_no_cause_in_its_beginning(shared_data, tmp_path):
    robot, end = _imported(shared_data, tmp_path, "tx40/map_held_out.yaml", *TX40)
    _, beginning = _imported(shared_data, tmp_path, "tx40/map_fit.yaml", *TX40)
    _control(robot, [end], [beginning])


def test_where_nothing_is_named_nothing_is_closed(shared_data):
    """A model of too few motions takes most of the gap of another into its own parameters."""
    source = shared_data / "real-dev/bam_xl330"
    robot = load_robot(source / "robot.yaml")
    logs = {path.stem: read_log(path, robot) for path in source.glob("kp400_*.mcap")}
    held_out = logs.pop("kp400_sin_sin")
    found = diagnose(robot, [held_out], estimate(robot, list(logs.values()))).result
    assert (found["verdict"], found["causes"], found["closure"]) == ("no_gap", [], 0.0)
    assert found["gap"]["after"] == found["gap"]["before"]
    assert any("explain" in text and "within their uncertainty" in text for text in found["warnings"])
