"""Arms whose description has no nominal torque: figures in N·m, and nobody says that a gate judged them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import error_text, finite
from agent.pages.calibration.prediction import error_table
from agent.pages.calibration.runs import _colour, _headline
from agent.pipeline.calibrate import calibration_text
from agent.pipeline.reports import worse_joints
from agent.pipeline.result import gate_decision
from agent.robot import RobotDescription, figure_text, load_robot, not_judged_text
from agent.runs.history import History, history_json, history_table

NAMES = ("j1", "j2")


def result(*shares: float | None, gate: float = 0.03) -> dict:
    missing = [name for name, share in zip(NAMES, shares, strict=True) if share is None]
    return {
        "schema": "calibration/1",
        "accepted": None if len(missing) == len(NAMES) else True,
        "reason": "",
        "gate": {"normalised_rmse": gate, "not_judged": missing},
        "search": {"fitness": 10.0},
        "estimation": {"condition_number": 50.0},
        "validation": {
            "motions": 2,
            "speed": 0.1,
            "joints": list(NAMES),
            "units": ["N·m", "N"],
            "rmse": [0.25, 0.5],
            "normalised_rmse": list(shares),
        },
    }


def without(robot: RobotDescription, *names: str) -> RobotDescription:
    joints = (replace(j, nominal_motor_torque=None) if j.name in names else j for j in robot.joints)
    return replace(robot, joints=tuple(joints))


@pytest.mark.parametrize(
    ("shares", "said"),
    [
        ((None, None), ("j1 0.25 N·m  j2 0.5 N", "done, not judged")),
        ((0.012, None), ("j1 1.20 %  j2 0.5 N", "accepted, without j2")),
        ((0.012, 0.02), ("j1 1.20 %  j2 2.00 %", "accepted  (gate")),
    ],
)
def test_summary_and_headline_without_nominal_torque(shares, said):
    text = calibration_text(result(*shares), Path("run"))
    headline = _headline(result(*shares))
    for words in said:
        assert words in text
    assert "nan" not in text + headline
    assert ("0.25 N·m on j1" in headline) == (shares[0] is None)
    assert ("Not judged" in headline) == (None in shares)
    assert _colour({**result(*shares), "diagnosis": None}) == ("plain" if shares == (None, None) else "good")


@pytest.mark.parametrize(
    ("shares", "row"), [((None, None), "not judged  0.5 N·m"), ((0.012, None), "accepted  1.20 %")]
)
def test_history_without_nominal_torque(tmp_path: Path, shares, row):
    run = tmp_path / "20260101T000000Z_arm"
    run.mkdir()
    state = {"robot": "arm", "started": "2026-01-01T00:00:00+00:00", "status": "finished"}
    (run / "state.json").write_text(json.dumps(state), encoding="utf-8")
    (run / "result.json").write_text(json.dumps(result(*shares)), encoding="utf-8")
    history = History(tmp_path)
    table = history_table(history.runs())
    (told,) = history_json(history, history.runs())["runs"]
    assert row in table
    assert "nan" not in table
    assert told["accepted"] is (None if row.startswith("not judged") else True)


@pytest.mark.parametrize(
    ("shares", "word"),
    [((np.nan, np.nan), None), ((0.01, np.nan), True), ((0.05, np.nan), False), ((0.01, 0.05), False)],
)
def test_a_gate_that_can_judge_no_joint_accepts_nothing(shares, word):
    missing = [name for name, share in zip(NAMES, shares, strict=True) if np.isnan(share)]
    accepted, reason = gate_decision(0.03, NAMES, shares, missing)
    assert accepted is word
    assert ("the gate is 3.00 %" in reason) == (word is False)


def test_names_joints_that_the_gate_cannot_judge_before_motion():
    robot = load_robot("comau_ns16")
    assert not_judged_text(robot, 0.03) == ""
    assert "joint_2 not" in not_judged_text(without(robot, "joint_2"), 0.03)
    assert "nominal_motor_torque" in not_judged_text(without(robot, *robot.joint_names), 0.03)


@pytest.mark.parametrize("nominal", [(np.nan, np.nan), (10.0, np.nan), (10.0, 10.0)])
def test_box_plot_keeps_the_torque_of_joints_without_one(nominal):
    rmse = np.array([[0.1, 0.2], [0.3, 0.4]])
    rows = error_table(rmse, np.array(nominal), NAMES, 0.03, "").rows
    expected = np.where(np.isfinite(nominal), 100 * rmse / np.nan_to_num(nominal, nan=1.0), rmse)
    shown = [[float(row[1]), float(row[5])] for row in rows]
    np.testing.assert_allclose(shown, np.column_stack([expected.min(axis=0), expected.max(axis=0)]), rtol=1e-3)
    assert [row[6] for row in rows] == ["%" if np.isfinite(one) else "N·m" for one in nominal]
    assert [3.0 in [place for place, _ in row[7].marks] for row in rows] == list(np.isfinite(nominal)), "the gate"


def test_without_a_nominal_torque_the_models_own_error_is_the_scale():
    robot = load_robot("comau_ns16")
    model = SimpleNamespace(robot=without(robot, "joint_2"), held_out_rmse=np.ones(6))
    assert worse_joints(model, np.full(6, 1.4)) == [
        joint.name
        for joint, nominal in zip(robot.joints, robot.nominal_torque, strict=True)
        if joint.name != "joint_2" and nominal < 150
    ]
    assert "joint_2" in worse_joints(model, np.full(6, 1.6))


def test_formats_figures_with_and_without_nominal_torque():
    assert error_text(0.0123, 5.0) == "1.23 %"
    assert error_text(None, 5.0) == error_text(float("nan"), 5.0) == "5 N·m"
    assert error_text(None, None) == "-"
    assert figure_text(0.5, "of nominal") == "50.00 %"
    assert figure_text(0.5, "N") == "0.5 N"


def test_a_number_that_is_not_finite_is_null_in_results():
    figures = {"rmse": np.array([0.01, np.nan]), "worst": [np.inf, 2.0]}
    assert finite(figures) == {"rmse": [0.01, None], "worst": [None, 2.0]}
