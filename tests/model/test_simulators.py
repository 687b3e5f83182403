"""Simulators of others as models: the torque they give is that of their own engine, and what they cannot be is said."""

import itertools
import re
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core import Console, InputError, RejectedError
from agent.diagnosis.forward.rollout import MujocoEngine
from agent.model.identified_model import IdentifiedModel
from agent.pipeline.gap.diagnose import GapQuestion, diagnose_files
from agent.recording import read_log
from agent.recording.mcap.log_file import STATES, LogFile
from agent.simulators import load_joint_map, load_simulator
from agent.simulators.joints import matched
from tests.model.bench import BODY, CHAIN, MJCF, NAMES, RATE, URDF, mujoco_torque, recorded, scene, states, written


def test_an_mjcf_gives_the_torque_that_mujoco_gives(tmp_path):
    path = written(tmp_path, MJCF, "arm.xml")
    pytest.importorskip("mujoco")
    found = load_simulator(path, None, NAMES)
    q, qd, qdd = states(3)
    qd = qd + 0.1 * np.sign(qd)  # beyond the reversal of friction
    expected = mujoco_torque(path, NAMES, q, qd, qdd)
    torque = found.model.predict(q, qd, qdd, np.arange(len(q)) / 100)
    assert np.max(np.abs(torque - expected)) < 1e-6 * np.max(np.abs(expected))
    assert found.model.robot.gravity == (0.3, 0, -9.7)
    assert [joint.prismatic for joint in found.model.robot.joints] == [False, False, True]
    assert found.model.robot.joints[0].upper == pytest.approx(np.radians(170))
    notes = " ".join(found.notes)
    assert "finger held" in notes
    assert "ignored: no part of the arm" in notes
    assert "density" in notes


def test_a_simulator_is_saved_and_read_like_any_model(tmp_path):
    pytest.importorskip("mujoco")
    found = load_simulator(written(tmp_path, MJCF, "arm.xml"), None, NAMES).model
    found.save(tmp_path / "model.json")
    again = IdentifiedModel.load(tmp_path / "model.json")
    q, qd, qdd = states(3)
    time = np.arange(len(q)) / 100
    np.testing.assert_allclose(again.predict(q, qd, qdd, time), found.predict(q, qd, qdd, time), rtol=1e-12)


def test_a_urdf_gives_its_bodies_damping_and_friction_with_the_drives_of_the_robot(tmp_path, robot):
    found = load_simulator(tmp_path / "arm.urdf", robot, ()).model
    assert list(found.robot.gear_ratios) == [50, 80]
    assert list(found.robot.nominal_torque) == [25, 32]
    still, moving = np.zeros((1, 2)), np.array([[1.0, 0.0]])
    torque = found.predict(still, moving, still) - found.predict(still, still, still)
    assert torque[0, 0] == pytest.approx(2.0, rel=1e-6)
    assert found.predict(still, still, still)[0, 1] == pytest.approx(-3 * 0.2 * 9.80665)
    plain = load_simulator(tmp_path / "arm.urdf", None, ("pan", "lift")).model
    assert list(plain.robot.gear_ratios) == [1, 1]
    assert np.all(np.isnan(plain.robot.nominal_torque))


def test_reports_a_file_with_fewer_joints_than_the_logs():
    with pytest.raises(InputError, match=r"1 joint in the file, 2 in the logs: is it of this arm\? Say which"):
        matched(Path("arm.xml"), ["a"], ["pan", "lift"], "the logs", None)


def test_joints_of_another_arm_in_the_logs_are_not_missed():
    left, right = ([f"{side}_joint_{k}" for k in (1, 2)] for side in ("left", "right"))
    assert matched(Path("arm.xml"), left, [*right, *left], "the logs", None) == {name: name for name in left}
    for wanted in ([*left, "left_joint_3"], [*left, "lift"]):
        with pytest.raises(InputError, match="only in the logs"):
            matched(Path("arm.xml"), left, wanted, "the logs", None)


def test_joints_counted_from_0_are_proposed_in_their_order():
    with pytest.raises(InputError, match=r"matched none.*joints: \{joint_1: joint_0, joint_2: joint_1\}$"):
        matched(Path("arm.xml"), ["joint_1", "joint_2"], ["joint_1", "joint_0"], "the logs", None)


def test_joints_are_matched_by_a_map(tmp_path, robot):
    path = written(tmp_path, URDF.replace('"pan"', '"shoulder"').replace('"lift"', '"elbow"'), "other.urdf")
    with pytest.raises(InputError, match=r"matched none; only in robot bench: pan, lift; .* shoulder, elbow.*--map"):
        load_simulator(path, robot, ())
    with pytest.raises(
        InputError, match=r"joints: \{pan: a_pan_joint, lift: z_lift\}$"
    ):  # not by the order of the logs
        load_simulator(tmp_path / "arm.urdf", None, ("z_lift", "a_pan_joint"))
    names = load_joint_map(written(tmp_path, "joints: {shoulder: pan, elbow: lift}", "map.yaml"))
    found = load_simulator(path, robot, (), names).model
    q, qd, qdd = states(2)
    same = load_simulator(tmp_path / "arm.urdf", robot, ()).model
    np.testing.assert_allclose(found.predict(q, qd, qdd), same.predict(q, qd, qdd))
    with pytest.raises(InputError, match=r"nobody is no joint of other\.urdf"):
        load_simulator(path, robot, (), {"nobody": "pan"})
    with pytest.raises(InputError, match="two joints"):
        load_joint_map(written(tmp_path, "joints: {a: pan, b: pan}", "twice.yaml"))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("named", [("pan",), ("pan", "lift")])
def test_a_map_names_one_arm_of_two_in_file_and_logs(tmp_path, side, named):
    """One joint of an arm is enough: the others of that arm are found by their names."""
    bench = ElementTree.fromstring(URDF)
    two = ElementTree.Element("robot", name="two")
    ElementTree.SubElement(two, "link", name="world")
    for of in ("left", "right"):
        mass = "3" if of == "left" else "4"
        arm = ElementTree.tostring(bench, encoding="unicode").replace('mass value="3"', f'mass value="{mass}"')
        arm = re.sub(r'(name|link)="(\w+)"', rf'\1="{of}_\2"', arm)
        two.extend(ElementTree.fromstring(arm))
        mount = ElementTree.SubElement(two, "joint", name=f"{of}_mount", type="fixed")
        ElementTree.SubElement(mount, "parent", link="world")
        ElementTree.SubElement(mount, "child", link=f"{of}_base")
    path = written(tmp_path, ElementTree.tostring(two, encoding="unicode"), "two.urdf")
    columns = [f"{of}_{joint}" for of in ("left", "right") for joint in ("pan", "lift")]
    with pytest.raises(InputError, match="One serial arm is compared at a time"):
        load_simulator(path, None, columns)
    found = load_simulator(path, None, columns, {f"{side}_{joint}": f"{side}_{joint}" for joint in named})
    assert found.model.robot.joint_names == (f"{side}_pan", f"{side}_lift")
    other = "right" if side == "left" else "left"
    assert f"not compared of the logs: {other}_pan, {other}_lift" in " ".join(found.notes)
    still = np.zeros((1, 2))
    mass = 3 if side == "left" else 4
    assert found.model.predict(still, still, still)[0, 1] == pytest.approx(-mass * 0.2 * 9.80665)


BRANCHES = f'<body><joint name="pan" axis="0 0 1"/>{BODY}</body><body><joint name="lift" axis="0 1 0"/>{BODY}</body>'
REFUSED = {
    "not XML": ("<mujoco", "not valid XML"),
    "something else": ("<sdf/>", "an SDF"),
    "xacro": ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>', "xacro"),
    "an include that is missing": ('<mujoco><include file="nope.xml"/></mujoco>', "nope.xml"),
    "no mass": (scene(f'<body><joint name="pan"/><body>{BODY}<joint name="lift"/></body></body>'), "does not accept"),
    "other joints": (scene(CHAIN.replace("pan", "one").replace("lift", "two")), "--map"),
    "two arms": (scene(BRANCHES), "another branch"),
    "a floating base": (scene(f'<body name="base"><freejoint/>{BODY}{CHAIN}</body>'), "floats"),
    "two joints of one body": (
        scene(f'<body name="wrist"><joint name="pan" axis="0 0 1"/><joint name="lift" axis="0 1 0"/>{BODY}</body>'),
        "pan, lift move one body",
    ),
    "a loop": (scene(CHAIN, '<equality><connect body1="b" anchor="0 0 0"/></equality>'), "closes a loop"),
    "a joint that follows": (scene(CHAIN, '<equality><joint joint1="lift" joint2="pan"/></equality>'), "follows"),
    "a tendon": (scene(CHAIN, '<tendon><fixed damping="3"><joint joint="pan" coef="1"/></fixed></tendon>'), "tendon"),
    "an actuator with inertia": (
        scene(CHAIN, '<actuator><motor joint="pan" armature="2"/></actuator>'),
        "something acts on pan",
    ),
    "a massless URDF": (re.sub(r"(value|i[xyz][xyz])=\"[0-9.]+\"", r'\1="0"', URDF), "positive"),
    "another arm": (URDF.replace('<origin xyz="0.3 0 0"/>', '<origin xyz="0.7 0 0"/>'), "another arm"),
    "a slide for a hinge": (URDF.replace("revolute", "prismatic", 1), "slides here"),
    "joints that follow one another": (
        URDF.replace("</joint></robot>", '<mimic joint="pan"/></joint></robot>'),
        "'lift' follows 'pan'",
    ),
    "angles in degrees": (URDF.replace('xyz="0.3 0 0"/>', 'xyz="0.3 0 0" rpy="90 0 0"/>'), "degrees"),
    "limits in degrees": (URDF.replace('"-2"', '"-170"').replace('"2"', '"170"'), "'pan': 170"),
    "a joint short": (URDF.replace('"lift" type="revolute"', '"lift" type="fixed"'), "only in robot bench: lift"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refuses_unusable_files_with_one_message(what, tmp_path, robot):
    text, message = REFUSED[what]
    if "<mujoco" in text:
        pytest.importorskip("mujoco")
    with pytest.raises(InputError, match=message) as refused:
        load_simulator(written(tmp_path, text, "model.xml"), robot, ())
    assert "model.xml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_more_joints_than_an_arm_has_are_refused(tmp_path):
    names = [f"j{k}" for k in range(8)]
    links = "".join(f'<link name="{name}_link"/>' for name in ["base", *names])
    inertial = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = links.replace("/>", f">{inertial}</link>")
    joints = "".join(
        f'<joint name="{name}" type="continuous"><parent link="{before}_link"/><child link="{name}_link"/></joint>'
        for before, name in zip(["base", *names], names, strict=False)
    )
    path = written(tmp_path, f'<robot name="snake">{links}{joints}</robot>', "snake.urdf")
    with pytest.raises(InputError, match=r"8 joints are to be compared.*at most 7"):
        load_simulator(path, None, names)


TOOL = """<link name="finger_a"/><link name="finger_b"/><link name="tcp"/>
<joint name="left" type="prismatic"><parent link="b"/><child link="finger_a"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.04" velocity="1" effort="9"/></joint>
<joint name="right" type="prismatic"><parent link="b"/><child link="finger_b"/><axis xyz="0 -1 0"/>
<limit lower="0" upper="0.04" velocity="1" effort="9"/><mimic joint="left"/></joint>
<joint name="tip" type="fixed"><parent link="b"/><child link="tcp"/><origin xyz="0 0 0.1"/></joint></robot>"""


def test_coupled_gripper_fingers_and_tip_belong_to_the_last_link(tmp_path, robot):
    path = written(tmp_path, URDF.replace("</robot>", TOOL), "held.urdf")
    found = load_simulator(path, robot, ())
    assert "left, right held at zero" in " ".join(found.notes)
    q, qd, qdd = states(2)
    same = load_simulator(tmp_path / "arm.urdf", robot, ()).model
    np.testing.assert_allclose(found.model.predict(q, qd, qdd), same.predict(q, qd, qdd))


def test_the_proposed_map_keeps_the_order_of_unrelated_names(tmp_path, robot):
    numbered = URDF.replace('"pan"', '"joint_1"').replace('"lift"', '"joint_2"')
    with pytest.raises(InputError, match=r"joints: \{joint_1: waist_joint, joint_2: elbow_joint\}"):
        load_simulator(written(tmp_path, numbered, "model.urdf"), None, ("waist_joint", "elbow_joint"))


def pasted(folder: Path, message: str) -> dict[str, str | None]:
    """The map that a message proposes, read from a file."""
    return load_joint_map(written(folder, re.search(r"joints: \{.*\}", message).group(), "pasted.yaml"))


SIDES = st.sampled_from(["left_", "right/", "l", "arm1.", "", "y", "on", "'"])
PARTS = st.lists(st.sampled_from(["pan", "lift", "no", "1", "a: b", "ü", "wrist_roll", "{x}"]), min_size=1, unique=True)


@given(st.lists(SIDES, min_size=1, max_size=2, unique=True), PARTS, PARTS, st.booleans())
def test_a_proposed_map_is_accepted_and_names_joints_of_one_arm(sides, own, wanted, known):
    arms = [[f"{side}{part}" for part in own] for side in sides]
    in_file = list(dict.fromkeys(itertools.chain(*arms)))

    def match(names=None):
        return matched(Path("arm.xml"), in_file, wanted, "the logs", names, (lambda: arms) if known else tuple)

    try:
        match()
    except InputError as refused:
        with tempfile.TemporaryDirectory() as folder:
            names = pasted(Path(folder), str(refused))
        assert names.items() <= match(names).items()
        assert not known or any({*names} <= {*arm} for arm in arms)


@pytest.mark.parametrize("what", ["two arms", "two arms in a URDF"])
def test_a_map_that_leaves_joints_out_is_accepted(tmp_path, what):
    pytest.importorskip("mujoco")
    apart = URDF.replace('<parent link="a"/>', '<parent link="base"/>')
    assert apart != URDF
    path = written(tmp_path, {**REFUSED, "two arms in a URDF": (apart, "")}[what][0], "model.xml")
    with pytest.raises(InputError, match="out with --map") as refused:
        load_simulator(path, None, ("pan", "lift"))
    names = pasted(tmp_path, str(refused.value))
    left = load_simulator(path, None, ("pan", "lift"), names).model.robot.joint_names
    assert len(left) == 1
    assert not {*left} & {*names}


def test_positions_in_degrees_are_refused(tmp_path, robot):
    right = load_simulator(tmp_path / "arm.urdf", None, ("pan", "lift")).model
    log = read_log(recorded(tmp_path / "1.mcap", right, 1), right.robot)
    file = LogFile(tmp_path / "deg.mcap", right.robot.joint_names, "bench", "x", RATE)
    file.write_states(STATES, 100 + log.t, np.degrees(log.position), np.degrees(log.velocity), log.effort)
    file.finish()
    file.close()
    with pytest.raises(RejectedError, match="look like degrees"):
        diagnose_files(None, [tmp_path / "deg.mcap"], GapQuestion(tmp_path / "arm.urdf"), Console(-1))


def test_mujoco_simulates_the_given_arm(tmp_path):
    pytest.importorskip("mujoco")
    path = written(tmp_path, MJCF, "arm.xml")
    model = load_simulator(path, None, NAMES).model
    time = np.arange(0, 0.5, 1e-3)
    w = np.array([2.0, 3.0, 2.5])
    q, qd, qdd = 0.3 - 0.2 * np.cos(np.outer(time, w)), 0.2 * w * np.sin(np.outer(time, w)), None
    qdd = 0.2 * w**2 * np.cos(np.outer(time, w))
    torque = model.predict(q, qd, qdd, time)
    engine = MujocoEngine(path, NAMES)
    at = np.array([0.2, 0.4])
    found, speed = engine.run(q[20], qd[20], lambda t, *_: torque[min(20 + round(t / 1e-3), 499)], at - 0.02)
    assert np.abs(found - q[[200, 400]]).max() < 2e-3  # of MuJoCo's steps of 2 ms, and friction at 0.2 % of top speed
    assert np.abs(speed - qd[[200, 400]]).max() < 2e-2


def test_refuses_a_joint_map_without_a_simulator_file(tmp_path, robot):
    with pytest.raises(InputError, match="--map"):
        diagnose_files("comau_ns16", [tmp_path / "a.mcap"], GapQuestion(joint_map=tmp_path / "map.yaml"), Console(-1))
