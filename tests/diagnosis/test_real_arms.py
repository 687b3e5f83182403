"""Measured data: the wrist coupling of a TX40 left out, and the asymmetric friction of a linear drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from agent.diagnosis import diagnose
from agent.recording import import_log, read_log
from agent.robot import load_robot

EXAMPLES = Path(__file__).resolve().parents[2] / "recipes/examples"


def test_a_wrist_coupling_left_out_is_found(shared_data, tmp_path, measured):
    robot = load_robot(EXAMPLES / "tx40/robot.yaml")
    tables = [shared_data / "tx40/pos_read_data.csv", shared_data / "tx40/curr_data.csv"]
    logs = []
    for part in ("fit", "held_out"):
        import_log(robot, EXAMPLES / f"tx40/map_{part}.yaml", tables, tmp_path / f"{part}.mcap")
        logs.append(read_log(tmp_path / f"{part}.mcap", robot))
    uncoupled = replace(robot, motor_coupling=tuple(tuple(float(i == j) for j in range(6)) for i in range(6)))
    cause = diagnose(uncoupled, logs, cutoff=20.0).result["causes"][0]
    right = (cause["effect"], cause["joints"]) == ("wrist_coupling", ["joint_5", "joint_6"])
    measured("TX40 without its wrist coupling", cause["effect"], "", "wrist_coupling, joints 5 and 6", right)
    assert right


def test_asymmetric_friction_of_a_linear_drive_is_found(shared_data, tmp_path, measured):
    robot = load_robot(EXAMPLES / "emps/robot.yaml")
    import_log(robot, EXAMPLES / "emps/map.yaml", [shared_data / "emps/DATA_EMPS.mat"], tmp_path / "emps.mcap")
    cause = diagnose(robot, [read_log(tmp_path / "emps.mcap", robot)]).result["causes"][0]
    named = [cause["effect"], *(entry["effect"] for entry in cause["equivalent_to"])]
    measured("EMPS, symmetric friction", cause["effect"], "", "asymmetric_friction", "asymmetric_friction" in named)
    assert "asymmetric_friction" in named
