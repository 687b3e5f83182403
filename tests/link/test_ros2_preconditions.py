"""What is refused before a trajectory is sent, by what a link sees of controller, manager, arm and other commanders."""

from types import SimpleNamespace

import numpy as np
import pytest

from drivers.errors import RefusedError
from drivers.transports.ros2.preconditions import check_active, check_alone, check_arm, check_controller
from drivers.wire.ros2 import JointSample, RosAddress

JOINTS = ("a", "b")
JTC = "joint_trajectory_controller/JointTrajectoryController"
PARAMETERS = {
    "interpolation_method": "splines",
    "command_interfaces": ["position"],
    "constraints.a.trajectory": 0.2,
    "constraints.b.trajectory": 0.2,
}


class Link:
    """What a link has seen; an answer of the manager is None where it cannot be asked."""

    joints, watchdog = JOINTS, 0.5

    def __init__(self, address="ros2://0/arm", controllers=None, hardware=None, others=(), names_come_after=0):
        self.target = RosAddress.of(address)
        self._answers = {"list_controllers": controllers, "list_hardware_components": hardware}
        self._others, self._unnamed = others, names_come_after
        self.latest = JointSample(1.0, np.zeros(2), np.zeros(2), np.ones(2))
        self.velocity, self.scaling, self.age, self.listened = np.zeros(2), None, 0.01, True

    def call(self, package, kind, service):
        return self._answers[service.rpartition("/")[2]]

    def others(self):
        self._unnamed -= 1
        return ("/_NODE_NAME_UNKNOWN_",) if self._unnamed >= 0 else self._others

    def wait(self, reached, timeout):
        return any(reached() for _ in range(100))

    def heard(self):
        return self.listened

    def pace(self):
        return 500.0, self.age


def controllers(*listed):
    """Name, state and claimed interfaces of each."""
    found = [SimpleNamespace(name=name, state=state, claimed_interfaces=claims) for name, state, claims in listed]
    return SimpleNamespace(controller=found)


def hardware(**states):
    found = [SimpleNamespace(name=name, state=SimpleNamespace(label=label)) for name, label in states.items()]
    return SimpleNamespace(component=found)


OURS = ("arm", "active", ["a/position", "b/position"])
BROADCASTER = ("joint_state_broadcaster", "active", [])


@pytest.mark.parametrize(
    ("link", "why"),
    [
        (Link(controllers=controllers(OURS, BROADCASTER), hardware=hardware(robot="active")), ""),
        (Link(), ""),  # types of controller_manager_msgs are not here
        (Link(controllers=controllers(OURS, ("gripper", "active", ["finger/position"]))), ""),
        (Link(controllers=controllers(OURS, ("spare", "inactive", ["a/position"]))), ""),
        (Link(controllers=controllers(("arm", "inactive", []))), "/arm is inactive; activate it"),
        (Link(controllers=controllers(OURS, ("other_arm", "active", ["left_a/position", "b_2/position"]))), ""),
        (Link(controllers=controllers(OURS, ("servo", "active", ["b/velocity"]))), "servo is active and commands"),
        (Link(controllers=controllers(OURS), hardware=hardware(robot="inactive")), "hardware robot is inactive"),
    ],
)
def test_exactly_one_controller_and_its_hardware_are_active(link, why):
    if not why:
        return check_active(link)
    with pytest.raises(RefusedError, match=why):
        check_active(link)


@pytest.mark.parametrize(
    ("changes", "kind", "by_goal", "why"),
    [
        ({}, JTC, False, ""),
        ({}, None, False, ""),
        ({}, "ur_controllers/ScaledJointTrajectoryController", True, ""),
        ({}, "diff_drive_controller/DiffDriveController", True, "activate a JointTrajectoryController"),
        ({"interpolation_method": "none"}, JTC, True, "interpolation_method 'none'; set it to splines"),
        ({"command_interfaces": ["acceleration"]}, JTC, True, "commands acceleration"),
        ({"constraints.b.trajectory": 0.0}, JTC, True, ""),
        ({"constraints.b.trajectory": 0.0}, JTC, False, "constraints.b.trajectory is 0"),
    ],
)
def test_the_controller_joins_points_by_splines_and_stops_an_arm_off_its_path(changes, kind, by_goal, why):
    manager = {} if kind is None else {"arm.type": kind}
    if not why:
        return check_controller(Link(), PARAMETERS | changes, manager, by_goal)
    with pytest.raises(RefusedError, match=why):
        check_controller(Link(), PARAMETERS | changes, manager, by_goal)


@pytest.mark.parametrize(
    ("address", "others", "why"),
    [
        ("ros2://0/arm", (), ""),
        ("ros2://0/arm", ("/ns/move_group",), "/ns/move_group can command /arm too.*beside=move_group"),
        ("ros2://0/arm,beside=move_group", ("/ns/move_group",), ""),
        ("ros2://0/arm,beside=move_group", ("/move_group", "/teleop"), "/teleop can command"),
        ("ros2://0/arm,beside=move_group,beside=teleop", ("/move_group", "/teleop"), ""),
    ],
)
def test_whoever_else_may_command_the_arm_is_named(address, others, why):
    link = Link(address, others=others, names_come_after=3)
    if not why:
        return check_alone(link)
    with pytest.raises(RefusedError, match=why):
        check_alone(link)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"scaling": 1.0}, ""),
        ({"scaling": 0.5}, "scaled to 50 %"),
        ({"scaling": np.nan}, "scaled to nan %"),
        ({"latest": JointSample(1.0, np.zeros(2), np.array([0.0, 0.02]), np.ones(2))}, "the arm moves already"),
        ({"age": 0.31}, "0.31 s late, 0.3 s are allowed"),
        ({"listened": False}, "does not listen to its topic joint_trajectory"),
        ({"latest": JointSample(1.0, np.array([0.0, np.nan]), np.zeros(2), np.ones(2))}, "no numbers"),
        ({"latest": JointSample(1.0, np.zeros(2), np.zeros(2), np.full(2, np.nan))}, "no effort"),
        ({"joints": ("b", "a")}, "the program is for a, b, /arm has b, a"),
    ],
)
def test_the_arm_rests_unscaled_and_its_samples_are_fresh(changes, why):
    link = Link()
    vars(link).update(changes)
    if not why:
        return check_arm(link, JOINTS, True)
    with pytest.raises(RefusedError, match=why):
        check_arm(link, JOINTS, True)
