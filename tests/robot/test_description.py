"""A description that cannot be used is refused with what is wrong and where."""

import re
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.robot import load_robot

YAML = """
name: pair
urdf: pair.urdf
tip_frame: tip
joints:
  - {name: turn, max_velocity: 2, max_acceleration: 5}
  - {name: slide, max_velocity: 1, max_acceleration: 5}
"""
URDF = """<robot name="pair"><link name="base"/><link name="middle"><inertial><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tip"/><link name="finger"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="middle"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="9"/></joint>
<joint name="slide" type="prismatic"><parent link="middle"/><child link="tip"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="9"/></joint>
<joint name="grip" type="prismatic"><parent link="tip"/><child link="finger"/><axis xyz="1 0 0"/>
<limit lower="0" upper="1" velocity="1" effort="9"/></joint></robot>"""


@pytest.fixture
def described(tmp_path: Path):
    """Load the description with a part of the URDF or the YAML replaced by something else."""

    def load(old: str = "", new: str = ""):
        assert old in YAML + URDF
        (tmp_path / "robot.yaml").write_text(YAML.replace(old, new) if old in YAML else YAML, encoding="utf-8")
        (tmp_path / "pair.urdf").write_text(URDF.replace(old, new, 1) if old in URDF else URDF, encoding="utf-8")
        return load_robot(tmp_path / "robot.yaml")

    return load


def test_reads_a_description(described):
    assert described("name: pair", "name: Zelle 3_b").name == "Zelle 3_b"


def test_an_unknown_tip_link_lists_the_possible_ones(described):
    with pytest.raises(InputError, match=r"no link 'tool0'; those at the end of a branch are finger$"):
        described("tip_frame: tip", "tip_frame: tool0")


@pytest.mark.parametrize("name", ["../../x", "a/b", ".hidden", "''", "x" * 65, '"a\\nb"'])
def test_refuses_a_name_that_is_not_a_file_name(described, name):
    with pytest.raises(InputError, match=r"robot\.yaml:2: name: .*files are named after the robot"):
        described("name: pair", f"name: {name}")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="2"/>', '<mass value="-2"/>', "link 'middle': mass value: -2 is below zero"),
        ('ixx="0.1"', 'ixx="-0.1"', "link 'middle': inertia ixx: -0.1 is below zero"),
        ('ixx="0.1" ', "", "link 'middle': inertia ixx is missing"),
        ('ixy="0" ixz="0"', "", "link 'middle': inertia ixy, ixz is missing"),
        ('<mass value="2"/>', "", "link 'middle': mass value is missing"),
        ('<mass value="2"/>', '<mass value="2 3"/>', "link 'middle': mass value is one number, not '2 3'"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 1"/>', "joint 'turn': axis xyz is three numbers, not '0 1'"),
        ("<inertial>", '<inertial><origin xyz="0.3 0"/>', "link 'middle': origin xyz is three numbers, not '0.3 0'"),
        ('<axis xyz="1 0 0"/>', '<origin rpy="0 0 0 1"/>', "joint 'grip': origin rpy is three numbers, not '0 0 0 1'"),
        ('<axis xyz="1 0 0"/>', '<origin xyz=""/>', "joint 'grip': origin xyz is three numbers, not ''"),
        ('<link name="finger"/>', '<link name="finger"/><link name="lost"/>', r"2 links have no parent \(base, lost\)"),
        ('<child link="tip"/>', '<child link="palm"/>', "joint 'slide': child 'palm' is no link"),
        ('<child link="finger"/>', '<child link="middle"/>', "link 'middle' is the child of two joints"),
        ('<parent link="base"/>', '<parent link="tip"/>', "a loop"),
        ('<link name="finger"/>', '<link name="finger"/><link name="finger"/>', "link 'finger' stands twice"),
        ('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><mimic joint="slide"/>', "'grip' follows 'slide'"),
    ],
)
def test_refuses_a_urdf_that_is_not_a_serial_arm(described, old, new, message):
    with pytest.raises(InputError, match=rf"pair\.urdf: .*{message}"):
        described(old, new)


@pytest.mark.parametrize(
    ("given", "ends"), [('lower="-3"', (-3, np.inf)), ('upper="3"', (-np.inf, 3)), ("", (-np.inf, np.inf))]
)
def test_a_missing_range_limit_is_unbounded(described, given, ends):
    turn = described('lower="-3" upper="3"', given).joints[0]
    assert (turn.lower, turn.upper) == ends


@pytest.mark.parametrize("value", [".nan", ".inf", "5e-324", "1e-300", "1e308", "0", "-1"])
@pytest.mark.parametrize("key", ["max_velocity", "max_acceleration"])
def test_refuses_a_non_finite_or_negative_limit(arm, tmp_path, key, value):
    folder = Path(arm).parent
    (tmp_path / "arm.urdf").write_text((folder / "arm.urdf").read_text(encoding="utf-8"), encoding="utf-8")
    text = re.sub(rf"{key}: \d+", f"{key}: {value}", (folder / "robot.yaml").read_text(encoding="utf-8"))
    (tmp_path / "robot.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=key):
        load_robot(str(tmp_path / "robot.yaml"))


@pytest.mark.parametrize("value", [".nan", "-.inf", "1e308", "-1e300", "true", "null", "''"])
@pytest.mark.parametrize(
    ("key", "where"),
    [
        ("gravity", "name: pair\ngravity: [0, {}, -9.81]"),
        ("gear_ratio", "max_velocity: 2, gear_ratio: {}"),
        ("motor_coupling", "name: pair\nmotor_coupling: [[1, {}], [0, 1]]"),
        ("from", "name: pair\nbodies: {{middle: [{{from: [0, 0, {}], to: [0, 0, 1], radius: 0.1}}]}}"),
        ("radius", "name: pair\nbodies: {{middle: [{{from: [0, 0, 0], to: [0, 0, 1], radius: {}}}]}}"),
    ],
)
def test_refuses_impossible_values(described, key, where, value):
    with pytest.raises(InputError, match=key):
        described("max_velocity: 2" if key == "gear_ratio" else "name: pair", where.format(value))


@pytest.mark.parametrize("ratio", ["0", "5e-324", "-1e-12"])
def test_refuses_a_gear_ratio_of_zero(described, ratio):
    with pytest.raises(InputError, match="gear_ratio"):
        described("max_velocity: 2", f"max_velocity: 2, gear_ratio: {ratio}")


def test_accepts_values_that_are_zero_by_round_off(described):
    assert described("name: pair", "name: pair\ngravity: [6e-16, -1e-300, -9.81]").gravity[0] == 6e-16


@pytest.mark.parametrize("end", ["lower", "upper"])
def test_refuses_a_nan_joint_range(arm, tmp_path, end):
    folder = Path(arm).parent
    text = re.sub(rf'{end}="[-\d]+"', f'{end}="nan"', (folder / "arm.urdf").read_text(encoding="utf-8"))
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    (tmp_path / "robot.yaml").write_text((folder / "robot.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(InputError):
        load_robot(str(tmp_path / "robot.yaml"))
