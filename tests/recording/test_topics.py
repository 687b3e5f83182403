"""Several topics of joint states in a log, an arm over several messages, and joints without torque."""

from pathlib import Path

import numpy as np
import pytest

from agent.core import InputError
from agent.estimation import estimate
from agent.recording import read_log
from agent.robot import RobotDescription, load_robot
from tests.recording.conftest import write_foreign

NAMES = ("base_turn", "arm_lift", "hand_turn")
T = np.arange(600) / 200
Q = np.column_stack([np.sin((k + 1) * T) for k in range(3)])
DQ = np.column_stack([(k + 1) * np.cos((k + 1) * T) for k in range(3)])
TAU = np.column_stack([(k + 3) * np.cos((k + 2) * T) for k in range(3)])


@pytest.fixture
def arm(tmp_path: Path) -> RobotDescription:
    links = "".join(f'<link name="l{k}"/>' for k in range(4))
    joints = "".join(
        f'<joint name="{name}" type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0 0 0.2"/><axis xyz="{k % 2} 0 {(k + 1) % 2}"/></joint>'
        for k, name in enumerate(NAMES)
    )
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    entries = "".join(f"  - {{name: {name}, max_velocity: 9, max_acceleration: 9}}\n" for name in NAMES)
    (tmp_path / "robot.yaml").write_text(f"name: arm\nurdf: arm.urdf\ntip_frame: l3\njoints:\n{entries}")
    return load_robot(tmp_path / "robot.yaml")


def _states(topic="/joint_states", joints=slice(None), late=0.0, prefix="", effort=True, scale=1.0, order=1):
    names = [prefix + name for name in NAMES[joints]]
    pull = -np.square(np.arange(1, 4)) * Q
    shift = late * DQ + 0.5 * late**2 * pull
    return [
        {
            "topic": topic,
            "time": 50 + t + late,
            "names": names[::order],
            "position": (scale * (q + d))[joints][::order],
            "velocity": (scale * (v + late * a))[joints][::order],
            "effort": tau[joints][::order] if effort else (),
        }
        for t, q, d, v, a, tau in zip(T, Q, shift, DQ, pull, TAU, strict=True)
    ]


def _write(path: Path, *groups) -> Path:
    return write_foreign(path, sorted((m for group in groups for m in group), key=lambda message: message["time"]))


def test_lists_several_topics_and_takes_the_named_one(arm, tmp_path):
    path = _write(tmp_path / "two.mcap", _states("/a/joint_states"), _states("/b/joint_states", scale=0.5, late=1e-3))
    with pytest.raises(InputError, match=r"/a/joint_states \(base_turn, .*; /b/joint_states \(base_turn.*--topic"):
        read_log(path, arm)
    with pytest.raises(InputError, match=r"several topics of joint states: /a/joint_states.*--topic"):
        read_log(path)
    np.testing.assert_array_equal(read_log(path, arm, "/a/joint_states").position, Q)
    np.testing.assert_allclose(read_log(path, arm, "b/joint_states").velocity, 0.5 * DQ, atol=5e-3)
    with pytest.raises(InputError, match=r"no joint states on the topic /c; it has /a/joint_states"):
        read_log(path, arm, "/c")


def test_the_default_topic_does_not_hide_another_of_the_same_joints(arm, tmp_path):
    path = _write(tmp_path / "two.mcap", _states(), _states("/left/joint_states", scale=0.5, late=1e-3))
    with pytest.raises(InputError, match="several topics hold the joints of the robot"):
        read_log(path, arm)


def test_the_only_topic_of_these_joints_is_taken_and_the_others_are_named(arm, tmp_path):
    other = _states("/gripper/joint_states", slice(0, 1), prefix="g_")
    log = read_log(_write(tmp_path / "two.mcap", _states("/arm/joint_states"), other), arm)
    np.testing.assert_array_equal(log.position, Q)
    assert [r.kind for r in log.repairs] == ["messages of another topic, left out: /gripper/joint_states (g_base_turn)"]


def test_of_topics_of_the_same_joints_the_one_with_torque_is_taken(arm, tmp_path):
    desired = _states("/desired_joint_states", effort=False, scale=0.9, late=1e-3)
    log = read_log(_write(tmp_path / "two.mcap", desired, _states()), arm)
    np.testing.assert_array_equal(log.position, Q)
    np.testing.assert_array_equal(log.effort, TAU)


def test_a_topic_of_another_name_is_taken_by_name(arm, tmp_path):
    path = _write(tmp_path / "odd.mcap", _states("/drives", effort=False))
    with pytest.raises(InputError, match=r"no readable /joint_states.*name it with --topic: /drives \(base_turn"):
        read_log(path, arm)
    np.testing.assert_array_equal(read_log(path, arm, "/drives").position, Q)


@pytest.mark.parametrize("late", [0.0, 0.0012, 0.0025])
@pytest.mark.parametrize("topics", [("/joint_states", "/joint_states"), ("/base/joint_states", "/hand/joint_states")])
def test_an_arm_over_several_messages_is_joined_by_stamp(arm, tmp_path, late, topics):
    first, second = _states(topics[0], slice(0, 1)), _states(topics[1], slice(1, 3), late=late, order=-1)
    log = read_log(_write(tmp_path / "parts.mcap", first, second), arm)
    kept = np.rint(200 * log.t).astype(int) + (0 if late == 0 else 1)
    assert len(kept) >= 598
    # a straight line between samples 5 ms apart is off by no more than that
    np.testing.assert_allclose(log.position, Q[kept], atol=0 if late == 0 else 9 * 0.005**2 / 8)
    np.testing.assert_allclose(log.velocity, DQ[kept], atol=0 if late == 0 else 54 * 0.005**2 / 8)
    assert any("joints in several messages" in repair.kind for repair in log.repairs)


def test_samples_missing_in_one_topic_are_not_invented(arm, tmp_path):
    first = _states(joints=slice(0, 2))
    second = [message for k, message in enumerate(_states(joints=slice(2, 3))) if not 200 <= k < 300]
    log = read_log(_write(tmp_path / "gap.mcap", first, second), arm)
    assert len(log.t) == 500
    assert len(log.segments) == 2


@pytest.mark.parametrize("bare", [0, 2])
def test_the_joint_without_torque_is_named(arm, tmp_path, bare):
    messages = _states()
    for message in messages:
        message["effort"] = np.where(np.arange(3) == bare, np.nan, message["effort"])
    log = read_log(_write(tmp_path / "nan.mcap", messages), arm)
    assert log.without_effort == (NAMES[bare],)
    assert f"samples without a finite effort of {NAMES[bare]}, so all effort left out" in str(log.repairs[0])
    with pytest.raises(InputError, match=rf"no torque \(effort\) of {NAMES[bare]} was recorded"):
        estimate(arm, [log])


def test_the_part_without_torque_is_named(arm, tmp_path):
    first, second = _states(joints=slice(0, 2)), _states(joints=slice(2, 3), effort=False)
    log = read_log(_write(tmp_path / "parts.mcap", first, second), arm)
    assert log.without_effort == ("hand_turn",)
    with pytest.raises(InputError, match=r"no torque \(effort\) of hand_turn was recorded"):
        estimate(arm, [log])


def test_all_joints_of_a_topic_are_listed_and_prefixes_named(arm, tmp_path):
    both = _write(tmp_path / "two.mcap", _states(prefix="l/"), _states(prefix="r/", late=1e-3))
    with pytest.raises(InputError, match=r"its joints are l/base_turn.*r/hand_turn\. Its names begin with l/ or r/"):
        read_log(both, arm)
