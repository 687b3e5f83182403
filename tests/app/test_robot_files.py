"""A URDF or MJCF where a robot.yaml is expected, and files that have to be converted first."""

import numpy as np
import pytest

from agent.core import InputError
from agent.pipeline import import_files, load_arm
from agent.recording import read_log
from agent.robot import load_robot
from agent.simulators import load_simulator

URDF = """<robot name="two and a half"><link name="foot"/><link name="a"/><link name="b"/>
<link name="f1"/><link name="f2"/>
<joint name="turn" type="continuous"><parent link="foot"/><child link="a"/><axis xyz="0 0 1"/></joint>
<joint name="lift" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1.5" effort="60"/></joint>
<joint name="finger_1" type="prismatic"><parent link="b"/><child link="f1"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.04" velocity="0.2" effort="20"/></joint>
<joint name="finger_2" type="prismatic"><parent link="b"/><child link="f2"/><axis xyz="0 -1 0"/>
<limit lower="0" upper="0.04" velocity="0.2" effort="20"/><mimic joint="finger_1"/></joint></robot>"""
MJCF = """<mujoco model="two"><compiler angle="radian"/><worldbody><body name="a"><inertial pos="0 0 0" mass="2"
diaginertia="0.1 0.1 0.1"/><joint name="turn" axis="0 0 1" armature="0.2"/><body name="b" pos="0 0 0.4"><inertial
pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/><joint name="lift" axis="0 1 0" range="-2 2" limited="true"/>
<body name="f1"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/><joint
name="finger_1" type="slide"/></body>
<body name="f2"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/><joint
name="finger_2" type="slide"/></body>
</body></body></worldbody><equality><joint joint1="finger_1" joint2="finger_2"/></equality></mujoco>"""
XACRO = '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="a"><xacro:include filename="b.xacro"/></robot>'
UNBOUND = '<robot name="a"><xacro:arm prefix=""/></robot>'
VARIABLE = '<robot name="a"><link name="${prefix}base"/></robot>'
SDF = '<sdf version="1.9"><model name="a"><link name="l"/></model></sdf>'


@pytest.fixture(params=["urdf", "xml"])
def file(request, tmp_path):
    """The same arm with a gripper, in either format."""
    if request.param == "xml":
        pytest.importorskip("mujoco", reason="an MJCF needs an extra: pip install '.[mujoco]'")
    path = tmp_path / f"arm.{request.param}"
    path.write_text(MJCF if request.param == "xml" else URDF)
    return path


def test_takes_the_longest_chain_of_a_file_without_the_gripper(file):
    robot = load_arm(str(file))
    assert robot.joint_names == ("turn", "lift")
    assert np.isnan(robot.nominal_torque).all()
    np.testing.assert_allclose(robot.position_limits[1], [np.inf, 2])
    np.testing.assert_array_equal(robot.gear_ratios, [1, 1])


def test_takes_only_the_joints_present_in_the_log(file, tmp_path):
    from tests.recording.conftest import write_foreign

    messages = [
        {"time": k / 100, "names": [name], "position": [0.0], "effort": [0.0]}
        for k in range(9)
        for name in ("x", "lift")
    ]
    log = write_foreign(tmp_path / "log.mcap", messages)
    assert load_arm(str(file), [log]).joint_names == ("lift",)
    other = write_foreign(tmp_path / "other.mcap", [{**message, "names": ["y"]} for message in messages])
    with pytest.raises(InputError, match=r"none of its joints moves the arm \(turn, lift, .*those of the log are y"):
        load_arm(str(file), [other])


@pytest.mark.parametrize("columns", ["[a, b]", "q"])
def test_a_table_is_imported_for_a_file_without_drives(file, tmp_path, columns):
    """A joint of the gripper that follows none is on the way to the tip, and the map has no column for it."""
    text = file.read_text()
    for tie in ('<mimic joint="finger_1"/>', '<equality><joint joint1="finger_1" joint2="finger_2"/></equality>'):
        text = text.replace(tie, "")
    file.write_text(text)
    rows = "".join(f"{k / 200},{k / 1e3},{k / 2e3},0.0,3.5,1.5,0.0\n" for k in range(100))
    table = tmp_path / "t.csv"
    table.write_text("t,a,b,c,e,f,g\n" + rows if columns != "q" else "t,q[1],q[2],q[3],e,f,g\n" + rows)
    (tmp_path / "map.yaml").write_text(f"time: {{column: t}}\nposition: {{columns: {columns}}}\n")
    if columns == "q":  # three numbers, and either finger may be the third joint
        with pytest.raises(InputError, match=r"names of the 3 columns .* do not say which"):
            import_files(str(file), tmp_path / "map.yaml", [table], tmp_path / "out.mcap")
        return
    import_files(str(file), tmp_path / "map.yaml", [table], tmp_path / "out.mcap")
    assert read_log(tmp_path / "out.mcap").joint_names == ("turn", "lift")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *((text, r"a xacro file.*xacro {name} > arm\.urdf") for text in (XACRO, UNBOUND, VARIABLE)),
        (SDF, r"an SDF.*sdf2mjcf {name} arm\.xml"),
    ],
)
@pytest.mark.parametrize("ending", ["urdf", "xacro", "sdf"])
def test_names_the_conversion_command_of_an_unsupported_file(tmp_path, text, said, ending):
    path = tmp_path / f"given.{ending}"
    path.write_text(text)
    (tmp_path / "robot.yaml").write_text(
        f"name: a\nurdf: {path.name}\ntip_frame: l\njoints: [{{name: j, max_velocity: 1, max_acceleration: 1}}]\n"
    )
    said = said.format(name=path.name.replace(".", r"\."))
    for read in (lambda: load_arm(str(path)), lambda: load_robot(tmp_path / "robot.yaml")):
        with pytest.raises(InputError, match=said):
            read()
    with pytest.raises(InputError, match=said):
        load_simulator(path, None, ())


def test_an_mjcf_in_a_robot_yaml_is_named(tmp_path):
    (tmp_path / "arm.xml").write_text(MJCF)
    (tmp_path / "robot.yaml").write_text(
        "name: a\nurdf: arm.xml\ntip_frame: l\njoints: [{name: j, max_velocity: 1, max_acceleration: 1}]\n"
    )
    with pytest.raises(InputError, match=r"arm\.xml is an MJCF: name it with --robot"):
        load_robot(tmp_path / "robot.yaml")


def test_asks_for_a_robot_yaml_if_drives_are_needed(file):
    with pytest.raises(InputError, match=r"write a robot\.yaml for it"):
        load_robot(file)
