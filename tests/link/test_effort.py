"""Effort is recognised against the gravity of the description."""

import numpy as np
import pytest

from agent.core.errors import ControllerError
from agent.link.effort import check_effort
from agent.robot import Dynamics, load_robot
from fake_controller.build import build_ros2_cell
from fake_controller.ros2.cell import EFFORTS

ROBOT = load_robot("ur5e")
STRETCHED = np.array([0.0, -0.3, 0.2, 0.1, 0.0, 0.0])


class Resting:
    """A driver whose arm rests with this torque."""

    def __init__(self, torque, effort="torque", position=STRETCHED):
        self.torque, self.effort, self.position = torque, effort, position

    def resting(self):
        return self.position, self.torque


def gravity(position=STRETCHED):
    nothing = np.zeros((1, 6))
    return Dynamics(ROBOT).inverse_dynamics(position[None], nothing, nothing)[0]


@pytest.mark.parametrize("share", [0.6, 1.0, 1.8])
def test_gravity_torque_is_accepted(share):
    friction = np.random.default_rng(0).normal(0, 2.0, 6)
    assert check_effort(Resting(share * gravity() + friction), ROBOT, None, "here") == ""


@pytest.mark.parametrize(
    ("share", "why"),
    [
        (0.0, "gravity has been taken out"),
        (0.05, "gravity has been taken out"),
        (0.3, "another unit"),
        (11.0, "another unit"),
        (-1, "unit"),
    ],
)
def test_what_is_no_gravity_torque_is_refused(share, why):
    with pytest.raises(ControllerError, match=why):
        check_effort(Resting(share * gravity()), ROBOT, None, "here")


def test_nothing_is_said_of_a_recipe_without_effort_or_of_other_drivers():
    assert check_effort(Resting(np.full(6, np.nan), effort="none"), ROBOT, None, "here") == ""
    assert check_effort(object(), ROBOT, None, "here") == ""


def test_a_pose_without_load_tells_nothing():
    upright = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
    assert "cannot be recognised in this pose" in check_effort(Resting(np.zeros(6), position=upright), ROBOT, None, "x")


@pytest.mark.parametrize("effort", EFFORTS)
def test_the_emulated_arm_is_recognised(effort):
    now = [1000.0]
    cell = build_ros2_cell("ur5e", 3, effort=effort, clock=lambda: now[0])
    now[0] += 0.05
    cycles = cell.run()
    driver = Resting(cycles.effort[-1], position=cycles.position[-1])
    if effort == "torque":
        assert check_effort(driver, ROBOT, None, "here") == ""
    else:
        with pytest.raises(ControllerError, match="effort"):
            check_effort(driver, ROBOT, None, "here")
