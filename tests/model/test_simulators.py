"""Simulators of others as models: the torque they give is that of their own engine, and what they cannot be is said."""

from __future__ import annotations

import html
import json
import re
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ruamel.yaml import YAML

from agent.core.console import Console
from agent.core.errors import InputError, RejectedError
from agent.diagnosis import diagnose, extended_model, forward_windows
from agent.diagnosis.dataset import assemble
from agent.diagnosis.randomisation import ranges, ranges_text
from agent.diagnosis.rollout import MujocoEngine
from agent.diagnosis.simulator import _possible, with_expected_error
from agent.model import CATALOGUE
from agent.model.identified import IdentifiedModel
from agent.model.simulators import load_joint_map, load_simulator
from agent.pipeline.corrected_simulator import write_simulator
from agent.pipeline.diagnose import GapQuestion, diagnose_again, diagnose_files
from agent.pipeline.printed_diagnosis import diagnosis_text
from agent.recording import read_log
from agent.recording.mcap.log_file import STATES, LogFile
from agent.report.diagnosis_page import diagnosis_report
from agent.robot import load_robot

NAMES = ("pan", "lift", "slide")
MJCF = """<mujoco model="bench">
  <compiler angle="degree"/>
  <option gravity="0.3 0 -9.7" density="1.2"/>
  <worldbody>
    <body name="table" pos="1 0 0"><geom type="box" size=".1 .1 .1"/></body>
    <body name="cup" pos="1 0 1"><freejoint/><inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/></body>
    <body name="stand" euler="0 10 0" pos="0 0 0.2">
      <body name="turret" pos="0 0 0.1">
        <joint name="pan" axis="0 0 1" range="-170 170" armature="0.4" damping="3" frictionloss="2"/>
        <inertial pos="0.02 0.01 0.1" mass="6" fullinertia="0.08 0.07 0.05 0.004 0.002 0.001"/>
        <body name="boom" pos="0.1 0 0.2" euler="0 0 30">
          <joint name="lift" axis="0 1 0" pos="0 0 0.05" ref="20" armature="0.2" damping="1.5" frictionloss="1"
                 stiffness="12" springref="-15"/>
          <inertial pos="0.2 0 0" mass="4" diaginertia="0.02 0.06 0.07"/>
          <body name="counterweight" pos="-0.1 0 0" euler="20 0 0">
            <inertial pos="0 0 0.03" mass="1.5" diaginertia="0.003 0.002 0.001"/>
          </body>
          <body name="ram" pos="0.4 0 0">
            <joint name="slide" type="slide" axis="1 0 0.2" damping="20" frictionloss="5" armature="1"/>
            <inertial pos="0.1 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
            <body name="finger" pos="0.2 0.02 0">
              <joint name="finger" type="slide" axis="0 1 0"/>
              <inertial pos="0 0.01 0" mass="0.3" diaginertia="1e-4 1e-4 1e-4"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality/>
  <actuator><position joint="pan" kp="100"/></actuator>
</mujoco>
"""
URDF = """<robot name="bench"><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 0 0"/><mass value="5"/>
<inertia ixx="0.05" iyy="0.06" izz="0.07" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pan" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="3" effort="100"/><dynamics damping="1.5" friction="0.5"/></joint>
<link name="b"><inertial><origin xyz="0.2 0 0"/><mass value="3"/>
<inertia ixx="0.03" iyy="0.04" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="lift" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="3" effort="100"/></joint></robot>
"""
ROBOT = """name: bench
urdf: arm.urdf
tip_frame: b
joints:
  - {name: pan, gear_ratio: 50, nominal_motor_torque: 0.5, max_velocity: 3, max_acceleration: 10}
  - {name: lift, gear_ratio: 80, nominal_motor_torque: 0.4, max_velocity: 3, max_acceleration: 10}
"""


def written(folder: Path, text: str, name: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def robot(tmp_path):
    written(tmp_path, URDF, "arm.urdf")
    return load_robot(written(tmp_path, ROBOT, "robot.yaml"))


def states(n: int, samples: int = 25) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return tuple(np.random.default_rng(1).uniform(-1, 1, (3, samples, n)))


def mujoco_torque(path: Path, names, q, qd, qdd) -> np.ndarray:
    """Of MuJoCo's inverse dynamics, joints found by name; friction is the sign of speed, the other joints stand."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.density = 0
    data = mujoco.MjData(model)
    at = [model.joint(name).qposadr[0] for name in names]
    dof = [model.joint(name).dofadr[0] for name in names]
    torque = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = model.qpos0, 0, 0
        data.qpos[at], data.qvel[dof], data.qacc[dof] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[dof]
    return torque + np.sign(qd) * model.dof_frictionloss[dof]


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


BODY = '<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
BRANCHES = f'<body><joint name="pan" axis="0 0 1"/>{BODY}</body><body><joint name="lift" axis="0 1 0"/>{BODY}</body>'
CHAIN = (
    f'<body name="a"><joint name="pan" axis="0 0 1"/>{BODY}<body name="b" pos="0.3 0 0">'
    f'<joint name="lift" axis="0 1 0"/>{BODY}</body></body>'
)


def scene(bodies: str, more: str = "") -> str:
    return f"<mujoco><worldbody>{bodies}</worldbody>{more}</mujoco>"


REFUSED = {
    "not XML": ("<mujoco", "not valid XML"),
    "something else": ("<sdf/>", "neither an MJCF"),
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
    "a loop": (
        scene(CHAIN, '<equality><connect body1="b" anchor="0 0 0"/></equality>'),
        "closes a loop",
    ),
    "a joint that follows": (scene(CHAIN, '<equality><joint joint1="lift" joint2="pan"/></equality>'), "follows"),
    "a tendon": (
        scene(CHAIN, '<tendon><fixed damping="3"><joint joint="pan" coef="1"/></fixed></tendon>'),
        "tendon",
    ),
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
def test_what_cannot_be_used_is_refused_with_one_message(what, tmp_path, robot):
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


def test_a_gripper_whose_fingers_follow_one_another_and_a_tip_are_part_of_the_last_link(tmp_path, robot):
    path = written(tmp_path, URDF.replace("</robot>", TOOL), "held.urdf")
    found = load_simulator(path, robot, ())
    assert "left, right held at zero" in " ".join(found.notes)
    q, qd, qdd = states(2)
    same = load_simulator(tmp_path / "arm.urdf", robot, ()).model
    np.testing.assert_allclose(found.model.predict(q, qd, qdd), same.predict(q, qd, qdd))


def test_the_map_that_is_offered_keeps_the_order_where_names_say_nothing(tmp_path, robot):
    numbered = URDF.replace('"pan"', '"joint_1"').replace('"lift"', '"joint_2"')
    with pytest.raises(InputError, match=r"joints: \{joint_1: waist_joint, joint_2: elbow_joint\}"):
        load_simulator(written(tmp_path, numbered, "model.urdf"), None, ("waist_joint", "elbow_joint"))


def test_positions_in_degrees_are_refused(tmp_path, robot):
    right = load_simulator(tmp_path / "arm.urdf", None, ("pan", "lift")).model
    log = read_log(recorded(tmp_path / "1.mcap", right, 1), right.robot)
    file = LogFile(tmp_path / "deg.mcap", right.robot.joint_names, "bench", "x", RATE)
    file.write_states(STATES, 100 + log.t, np.degrees(log.position), np.degrees(log.velocity), log.effort)
    file.finish()
    file.close()
    with pytest.raises(RejectedError, match="look like degrees"):
        diagnose_files(None, [tmp_path / "deg.mcap"], GapQuestion(tmp_path / "arm.urdf"), Console(-1))


RATE = 125.0


def recorded(path: Path, model: IdentifiedModel, phase: float, added=lambda qd: 0 * qd) -> Path:
    """A log of what a model predicts, and something more, on 16 s of sines."""
    time = np.arange(int(16 * RATE)) / RATE
    n = model.robot.dof
    rates = np.array([[0.9, 2.3], [1.3, 2.9], [1.1, 3.1]])[:n]
    q, qd, qdd = np.zeros((3, len(time), n))
    for part, size in enumerate((0.6, 0.25)):
        w = rates[:, part]
        angle = np.outer(time, w) + phase * (1 + part) + np.arange(n)
        q, qd, qdd = q + size * np.sin(angle), qd + size * w * np.cos(angle), qdd - size * w**2 * np.sin(angle)
    torque = model.predict(q, qd, qdd, time) + added(qd)
    torque = torque + 0.005 * np.std(torque, axis=0) * np.random.default_rng(3).normal(size=torque.shape)
    file = LogFile(path, model.robot.joint_names, model.robot.name, "x", RATE)
    file.write_states(STATES, 100 + time, q, qd, torque)
    file.finish()
    file.close()
    return path


def test_a_right_simulator_has_no_gap_and_needs_no_description(tmp_path, robot, monkeypatch):
    monkeypatch.setattr(forward_windows, "_WINDOWS", 2)
    right = load_simulator(tmp_path / "arm.urdf", None, ("pan", "lift")).model
    logs = [recorded(tmp_path / f"{k}.mcap", right, k) for k in (1, 2)]
    result = diagnose_files(None, logs, GapQuestion(tmp_path / "arm.urdf", out=tmp_path / "same.urdf"), Console(-1))
    assert result["verdict"] == "no_gap"
    assert result["forward"]["before"] == result["forward"]["after"]
    assert (tmp_path / "same.urdf").read_text() == URDF
    assert json.loads((tmp_path / "same.changes.json").read_text())["changes"] == []
    assert result["gap"]["joints"] == ["pan", "lift"]
    json.dumps(result, allow_nan=False)


def wrong(model: IdentifiedModel) -> IdentifiedModel:
    """The robot that a model is a poor simulator of: it has rotors, more friction on both joints, and lighter links."""
    standard = np.append(model.standard[:20] * 0.8, [0.5, 0.4])
    friction = model.values[len(model.independent) :] + [1.5, 1.0, 1.5, 2.0]
    return replace(model, values=np.append(model.projection @ standard, friction))


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    """A URDF that is wrong in friction, rotors and links: model, robot, diagnosis."""
    folder = tmp_path_factory.mktemp("nominal")
    model = load_simulator(written(folder, URDF, "arm.urdf"), None, ("pan", "lift")).model
    robot = wrong(model)
    logs = [read_log(recorded(folder / f"{k}.mcap", robot, k), model.robot) for k in (1, 2)]
    return model, robot, diagnose(model.robot, logs, model)


def test_a_simulator_that_is_wrong_in_many_ways_is_corrected_step_by_step(nominal):
    result = nominal[2].result
    steps = {entry["step"]: entry for entry in result["waterfall"]}
    assert sum(entry["closes"] for entry in steps.values()) == pytest.approx(1)
    assert list(steps)[-1] == "remainder"
    assert steps["remainder"]["closes"] < 0.03
    assert steps["remainder"]["alone"] is None
    assert {"friction of pan", "friction of lift"} <= set(steps)
    for entry in steps.values():
        low, high = entry["interval"]
        assert low <= entry["closes"] <= high
    assert result["verdict"] in ("explained", "ambiguous")
    assert {cause["effect"] for cause in result["causes"]} <= {"inertial_mismatch", "friction_change", "payload"}
    assert result["closure"] > 0.97
    json.dumps(result, allow_nan=False)


def weighing(*masses: float) -> str:
    """A URDF of three links, of which the last turns with a hundredth of the first one's torque."""
    shape = ((0.3, 0.8, "0 0 0", "0 1 0"), (0.2, 0.08, "0.6 0 0", "0 1 0"), (0.06, 0.002, "0.4 0 0", "0 0 1"))
    parts, parent = ['<robot name="uneven"><link name="base"/>'], "base"
    limit = '<limit lower="-2" upper="2" velocity="3" effort="100"/>'
    for name, mass, (centre, inertia, origin, axis) in zip(("pan", "lift", "tip"), masses, shape, strict=True):
        moments = f'ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"'
        parts.append(
            f'<link name="{name}_link"><inertial><origin xyz="{centre} 0 0"/><mass value="{mass}"/><inertia {moments}/>'
            f'</inertial></link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{name}_link"/><origin xyz="{origin}"/><axis xyz="{axis}"/>{limit}</joint>'
        )
        parent = f"{name}_link"
    return "".join([*parts, "</robot>"])


FORMS = {
    "stribeck": lambda w: 0.6 * np.tanh(w / 0.01) / (1 + (w / 0.15) ** 2),
    "asymmetric_friction": lambda w: 0.5 * (np.abs(np.tanh(w / 0.01)) + 0.5 * np.abs(w)),
}


def uneven(folder: Path, form=lambda w: 0 * w, joint: int = 0, scale: float = 1.0, beside=lambda qd: 0 * qd):
    """Diagnosis of an arm that weighs otherwise than its file, which has no friction, with one effect on a joint.

    `beside` (S, 3) of speeds is added to what the friction levels are multiplied with.
    """
    names = ("pan", "lift", "tip")
    model = load_simulator(written(folder, weighing(20, 6, 0.8), "given.urdf"), None, names).model
    right = load_simulator(written(folder, weighing(22, 5.2, 0.7), "right.urdf"), None, names).model
    levels, there = np.array([10.5, 1.8, 0.22]), np.arange(3) == joint
    values = right.values.copy()
    values[len(right.independent) :: 2] += levels
    values[len(right.independent) + 1 :: 2] += 0.7 * levels
    robot = replace(right, values=values)

    def added(qd):
        return (form(qd) * there + beside(qd)) * levels

    paths = [recorded(folder / f"{k}.mcap", robot, k, added) for k in (1, 2)]
    logs = [read_log(path, model.robot) for path in paths]
    return diagnose(model.robot, [replace(log, effort=log.effort * np.where(there, scale, 1)) for log in logs], model)


@pytest.mark.verify
@pytest.mark.parametrize(("effect", "joint"), [("stribeck", 2), ("asymmetric_friction", 1)])
def test_friction_is_named_beside_wrong_numbers_of_larger_joints_though_the_file_has_none(tmp_path, effect, joint):
    found = uneven(tmp_path, FORMS[effect], joint)
    named = [(cause["effect"], cause["joints"]) for cause in found.result["causes"]]
    assert named == [(effect, [("pan", "lift", "tip")[joint]])]
    if joint == 2:
        assert found.result["causes"][0]["closure"] < 0.005, "of all joints' gap in N·m"
        assert "closes less than 1 % of the gap" in diagnosis_report(found)


@pytest.mark.verify
def test_a_small_effect_is_named_beside_a_large_one_and_numbers_moved_in_their_stead_move_no_more(tmp_path):
    def beside(qd):
        return np.array([0, 0, 0.3]) * FORMS["stribeck"](qd)

    found = uneven(tmp_path, FORMS["asymmetric_friction"], 1, beside=beside)
    named = {(cause["effect"], *cause["joints"]) for cause in found.result["causes"]}
    assert named == {("asymmetric_friction", "lift"), ("stribeck", "tip")}
    assert ("rotor inertia", 1) not in found.calibrated.released
    units = {entry.parameter: entry.unit for entry in ranges(found)}
    assert (units["rise"], units["frictionloss"]) == ("N·m", "N·m")


@pytest.mark.verify
def test_where_links_may_weigh_anything_a_scale_of_torque_may_be_that_of_the_joint_next_to_it(tmp_path):
    result = uneven(tmp_path, joint=1, scale=1.1).result
    cause = result["causes"][0]
    members = {(one["effect"], *one["joints"]) for one in (cause, *cause["equivalent_to"])}
    assert result["verdict"] == "ambiguous"
    assert ("torque_constant", "lift") in members


def test_sharp_friction_of_a_simulator_has_no_part_that_a_delay_would_sharpen(tmp_path, robot):
    """An effects file could not say it: there torque is late, friction and all."""
    model = load_simulator(tmp_path / "arm.urdf", None, ("pan", "lift")).model
    log = read_log(recorded(tmp_path / "1.mcap", model, 1), model.robot)
    late = replace(log, effort=np.roll(log.effort, 1, axis=0))
    fit = assemble(model.robot, with_expected_error(model, [late]), [late], None).fit
    (found,) = CATALOGUE["time_delay"].settings(fit, ())
    assert found == {"delay": pytest.approx(1 / RATE, rel=0.2)}


def test_an_effect_that_needs_friction_below_zero_or_has_an_impossible_size_is_none(nominal):
    model, change = nominal[0], np.zeros(len(nominal[0].values))
    level = len(model.independent)

    def possible(scale: float) -> bool:
        chosen = SimpleNamespace(effect=CATALOGUE["torque_constant"], joints=(0,), names=("scale_error",), settings={})
        reference = SimpleNamespace(model=model)
        fit = SimpleNamespace(chosen=[chosen], fitted=lambda: (change, [[scale]]), reference=reference)
        return _possible(model, fit, 0)

    assert possible(0.1)
    assert not possible(2.4)
    change[level] = -1.2 * model.values[level]
    assert not possible(0.1)


def test_the_corrected_simulator_predicts_the_robot(nominal):
    model, robot, found = nominal
    corrected = extended_model(found)
    q, qd, qdd = states(2, 200)
    expected = robot.predict(q, qd, qdd)
    left, before = (np.std(m.predict(q, qd, qdd, np.arange(200.0)) - expected) for m in (corrected, model))
    assert left < 0.15 * before


def test_the_corrected_urdf_is_a_right_simulator_of_the_robot(nominal, tmp_path):
    model, robot, found = nominal
    simulator = load_simulator(written(tmp_path, URDF, "arm.urdf"), None, ("pan", "lift"))
    write_simulator(found, simulator, tmp_path / "fixed.urdf", Console(-1))
    fixed = load_simulator(tmp_path / "fixed.urdf", None, ("pan", "lift")).model
    document = json.loads((tmp_path / "fixed.changes.json").read_text())
    assert document["changes"][0]["reason"].endswith("of the held-out gap")
    armature = np.zeros(2)
    if document["effects_file"]:  # rotors, which a URDF cannot say
        armature = np.array(runpy.run_path(str(tmp_path / document["effects_file"]))["ARMATURE"])
    q, qd, qdd = states(2, 200)
    expected = robot.predict(q, qd, qdd)
    left = fixed.predict(q, qd, qdd) + armature * qdd - expected
    assert np.std(left) < 0.15 * np.std(model.predict(q, qd, qdd) - expected)


@pytest.mark.parametrize("set_points", [False, True])
def test_the_corrected_simulator_follows_the_robot_for_longer(nominal, tmp_path, monkeypatch, set_points):
    monkeypatch.setattr(forward_windows, "_WINDOWS", 4)
    found = nominal[2]
    simulator = load_simulator(written(tmp_path, URDF, "arm.urdf"), None, ("pan", "lift"))
    if set_points:  # of a servo that is soft enough for the model to show: 100 N·m/rad, 3 N·m·s/rad
        logs = tuple(replace(log, reference_position=behind(log)) for log in found.dataset.logs)
        found = replace(found, dataset=replace(found.dataset, logs=logs))
    result = forward_windows.forward(found, simulator)
    assert result["driven_by"] == ("set_points" if set_points else "torque")
    assert result["horizon_s"] == [0.2, 0.5, 1.0, 2.0]
    for prefix in ("", "velocity_"):
        before, after, high = (np.array(result[f"{prefix}{key}"]) for key in ("before", "after", "after_interval"))
        assert np.all(after < 0.2 * before)
        assert np.all((high[..., 0] <= after) & (after <= high[..., 1]))
    assert "pinocchio" in diagnosis_text({**found.result, "simulation": None, "forward": result})
    json.dumps(result, allow_nan=False)


def behind(log):
    """Set-points (S, 2) whose servo gives the torque of a log."""
    period, kp, kd = 1 / RATE, 100.0, 3.0
    error = np.zeros(log.effort.shape)
    for k in range(1, len(error)):  # kp e + kd ė = τ
        error[k] = (log.effort[k] + kd / period * error[k - 1]) / (kp + kd / period)
    return log.position + error


def test_ranges_hold_what_is_true_and_stand_on_the_page(nominal, tmp_path):
    model, robot, found = nominal
    by_name = {(entry.of, entry.parameter): entry for entry in ranges(found)}
    true = robot.values[len(model.independent) :]
    for k, joint in enumerate(("pan", "lift")):
        for entry, value in zip(("frictionloss", "damping"), true[2 * k : 2 * k + 2], strict=True):
            found_range = by_name[f"joint {joint}", entry]
            assert found_range.low - 0.02 <= value <= found_range.high + 0.02
            assert 0 < found_range.high - found_range.low < 0.5
    text = ranges_text(ranges(found))
    assert YAML(typ="safe").load(text)["ranges"][0]["of"].startswith("joint ")
    page = diagnosis_report(found)
    steps = sorted(found.result["waterfall"][:-1], key=lambda step: -step["closes"])
    assert f"Most of the gap closes with: {steps[0]['step']} ({100 * steps[0]['closes']:.0f} %)" in page
    for title in ("What the simulator gets wrong", "For training policies"):
        assert title in page
    assert html.escape(text, quote=True).replace("&quot;", "&#34;") in page  # the YAML, to be copied
    assert page.count("<svg") > 3


def test_the_page_of_a_recorded_run_has_drift_and_ranges(nominal, tmp_path, monkeypatch):
    names, error = ["pan", "lift"], [[0.3, 0.2]]
    sides = ("before", "after", "velocity_before", "velocity_after")
    forward = {"horizon_s": [0.2], "joints": names, "engine": "mujoco", "driven_by": "torque", "windows": 8}
    forward |= {side: error for side in sides} | {f"{side}_interval": [[[0.1, 0.4], [0.1, 0.4]]] for side in sides}
    (tmp_path / "state.json").write_text(json.dumps({"question": {"cutoff": None, "without": []}}))
    (tmp_path / "result.json").write_text(json.dumps({**nominal[2].result, "forward": forward}))
    monkeypatch.setattr("agent.pipeline.diagnose._find", lambda *_: (nominal[2], [], None))
    page = diagnose_again(tmp_path, nominal[0].robot, "bench", Console(-1))
    for text in ("How far it drifts", "0.3 (0.1 to 0.4)", "For training policies", "schema: randomisation/1"):
        assert text in page
    assert "drifts further than the one given" not in page
    forward["after"] = [[0.5, 0.4]]
    assert "further than the one given after 0.2 s" in diagnosis_report(nominal[2], (), forward)


def test_mujoco_runs_the_arm_that_it_is_given(tmp_path):
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


def test_the_waterfall_is_a_table_for_people(nominal):
    text = diagnosis_text({**nominal[2].result, "simulation": None})
    assert re.search(r"friction of pan +[0-9.]+ % .*#", text)
    assert re.search(r"remainder +-?[0-9.]+ %", text)


def test_what_an_mjcf_lacks_is_named(tmp_path):
    pytest.importorskip("mujoco")
    arm = load_simulator(written(tmp_path, scene(CHAIN), "arm.xml"), None, ("pan", "lift")).model
    bent = [recorded(tmp_path / f"{k}.mcap", arm, k, lambda qd: np.sign(qd) * [0, 0.3]) for k in (1, 2)]
    found = diagnose(arm.robot, [read_log(path, arm.robot) for path in bent], replace(arm))
    cause = found.result["causes"][0]
    assert (cause["effect"], cause["joints"]) == ("friction_change", ["lift"])
    assert cause["closure"] > 0.8


def test_a_map_without_such_a_file_is_refused(tmp_path, robot):
    with pytest.raises(InputError, match="--map"):
        diagnose_files("comau_ns16", [tmp_path / "a.mcap"], GapQuestion(joint_map=tmp_path / "map.yaml"), Console(-1))
