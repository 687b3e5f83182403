"""Logs of another robot whose joints have the same names, and faults that are none."""

import pytest

from agent.core import Console, RejectedError
from agent.pipeline.checked_logs import check_plausible
from agent.robot import load_robot
from agent.validation import is_of_another_robot
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

JOINTS = ["joint_1", "joint_2", "joint_3", "joint_4"]
FAULTS = {
    "none": (),
    "payload": ({"effect": "payload", "joints": [], "parameters": {"mass": 15.0, "centre": [0.1, 0.1, 0.2]}},),
    "grease": ({"effect": "friction_change", "joints": JOINTS, "parameters": {"coulomb": 3.0, "viscous": 3.0}},),
    "spring": ({"effect": "gravity_spring", "joints": ["joint_2"], "parameters": {"preload": 2000.0}},),
    "hoses": ({"effect": "dress_pack", "joints": JOINTS, "parameters": {"stiffness": 100.0, "centre": 0.3}},),
    "lean": ({"effect": "base_tilt", "joints": [], "parameters": {"roll": 0.4, "pitch": 0.3}},),
}


@pytest.fixture(scope="module")
def arm():
    robot = make_arm("RRRR")
    return robot, learn(robot)


@pytest.mark.parametrize("fault", FAULTS)
def test_an_arm_with_a_fault_is_the_same_robot(arm, fault):
    robot, model = arm
    logs = [record(Plant(robot, seed=3, effects=FAULTS[fault]), "log", seed) for seed in (21, 22)]
    assert not is_of_another_robot(model, logs)


def test_an_arm_of_the_same_family_is_refused_and_named():
    small, large = load_robot("ur5e"), load_robot("ur10e")
    assert small.joint_names == large.joint_names
    model = learn(small)
    own, others = ([record(Plant(robot, seed=3), "log", seed) for seed in (21, 22)] for robot in (small, large))
    with pytest.raises(RejectedError, match="another inertia on most joints"):
        check_plausible(small, others, False, Console(-1), model=model)
    check_plausible(small, others, True, Console(-1), model=model)
    check_plausible(small, own, False, Console(-1), model=model)
