"""Faults that users met once."""

import json
from pathlib import Path

import numpy as np
import pytest

URDF = """<robot name="r"><link name="base"/>
<link name="l1"><inertial><mass value="{mass}"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><axis xyz="{axis}"/>
<limit lower="{lower}" upper="1" effort="1" velocity="1"/></joint></robot>"""
ROBOT = "name: r\nurdf: r.urdf\ntip_frame: l1\njoints: [{name: j1, max_velocity: 1, max_acceleration: 1}]\n"


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ({"mass": "heavy"}, "link 'l1': mass value"),
        ({"mass": "nan"}, "link 'l1': mass value"),
        ({"axis": "a b c"}, "joint 'j1': axis xyz"),
        ({"lower": "abc"}, "joint 'j1': limit lower"),
        ({"lower": "nan"}, "joint 'j1': limit lower"),
    ],
)
def test_names_the_urdf_attribute_that_is_not_a_number(tmp_path: Path, fault, named):
    from agent.core.errors import InputError
    from agent.robot import load_robot

    (tmp_path / "r.urdf").write_text(URDF.format(**{"mass": "1", "axis": "0 0 1", "lower": "-1"} | fault))
    (tmp_path / "robot.yaml").write_text(ROBOT)
    with pytest.raises(InputError, match=named):
        load_robot(tmp_path / "robot.yaml")


def test_a_plan_without_a_usable_folder_is_refused_before_the_search(write_recipe, run_agent, tmp_path: Path):
    (tmp_path / "file").write_text("")
    result = run_agent("plan", str(write_recipe("127.0.0.1:9")), "-o", str(tmp_path / "file"))
    assert result.returncode == 2
    assert "no folder for the plan can be made there" in result.stderr
    assert "search" not in result.stderr


def test_estimate_never_writes_the_model_over_a_log(run_agent, tmp_path: Path):
    log = tmp_path / "motion.mcap"
    log.write_bytes(b"data of a day")
    result = run_agent("estimate", "--robot", "comau_ns16", "-o", str(log), str(log))
    assert result.returncode == 2
    assert "is one of the logs" in result.stderr
    assert log.read_bytes() == b"data of a day"


def test_refuses_a_program_without_motion_and_creates_no_log(write_recipe, run_agent, start_controller, tmp_path: Path):
    program = tmp_path / "still.pdl"
    program.write_text("PROGRAM still\nBEGIN\nEND still\n")
    recipe = write_recipe(start_controller("--clock", "fast").address)
    result = run_agent("record", str(recipe), "--program", str(program), "--yes")
    assert result.returncode == 2
    assert "moves nothing" in result.stderr
    assert not program.with_suffix(".mcap").exists()
    assert not result.stdout


@pytest.mark.parametrize(("moving", "said"), [(False, "no joint moves"), (True, "the torque is zero")])
def test_logs_without_motion_or_torque_are_refused(moving, said):
    from agent.core.errors import InputError
    from agent.estimation import estimate
    from agent.recording.log import Log
    from agent.robot import load_robot

    robot, t = load_robot("comau_ns16"), np.arange(2000) / 500
    position = np.outer(np.sin(3 * t) if moving else np.zeros(2000), np.ones(robot.dof))
    still = np.zeros_like(position)
    log = Log(Path("a.mcap"), robot.joint_names, t, position, None, still, None, None, 500.0, 0.0, ((0, 2000),))
    with pytest.raises(InputError, match=said):
        estimate(robot, [log])


@pytest.mark.parametrize(
    ("key", "value"), [("projection", None), ("projection", [[1.0]]), ("residual_rmse", None), ("covariance", "nan")]
)
def test_a_model_file_that_was_damaged_by_hand_is_refused(tmp_path: Path, key, value):
    from agent.core.errors import InputError
    from agent.estimation import EstimationSettings, estimate
    from agent.model import IdentifiedModel
    from agent.recording.log import Log
    from agent.robot import load_robot

    (tmp_path / "r.urdf").write_text(URDF.format(mass="1", axis="0 1 0", lower="-1"))
    (tmp_path / "robot.yaml").write_text(ROBOT)
    robot, t = load_robot(tmp_path / "robot.yaml"), np.arange(2000)[:, None] / 500
    q = 0.5 * np.sin(3 * t)
    log = Log(Path("a.mcap"), ("j1",), t[:, 0], q, None, -0.9 * q, None, None, 500.0, 0.0, ((0, 2000),))
    data = estimate(robot, [log], EstimationSettings.create(method="weighted")).to_dict()
    path = tmp_path / "model.json"
    path.write_text(json.dumps(data))
    assert IdentifiedModel.load(path).robot.name == "r"
    damaged = np.full_like(data[key], np.nan, dtype=float).tolist() if value == "nan" else value
    path.write_text(json.dumps({**data, key: damaged}))
    with pytest.raises(InputError, match="incomplete or damaged"):
        IdentifiedModel.load(path)
