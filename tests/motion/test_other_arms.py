"""Any serial arm of one to seven joints, with or without a spherical wrist, Cartesian limits or jerk limits."""

from dataclasses import replace

import numpy as np
import pytest

from agent.motion import CartesianTarget, FlyInterpolator, JointTarget, Move, MoveType, Pdl2Settings
from agent.robot import RobotDescription, kinematics_for
from tests.robot.conftest import build

#: Kind, origin and axis of each joint; and a second posture to go to from the first.
ARMS = {
    "1 axis": ([("R", "0 0 0.2", "0 0 1")], [0.2], [1.4]),
    "2 axes": ([("R", "0 0 0", "0 0 1"), ("R", "0.4 0 0", "0 0 1")], [0.2, 0.9], [1.0, 0.4]),
    "gantry": (
        [("P", "0 0 1", "1 0 0"), ("P", "0 0 0", "0 1 0"), ("P", "0 0 0", "0 0 -1")],
        [0.1, 0.2, 0.0],
        [0.6, -0.2, 0.3],
    ),
    "scara": (
        [("R", "0 0 0.4", "0 0 1"), ("R", "0.4 0 0", "0 0 1"), ("P", "0.3 0 0", "0 0 -1"), ("R", "0 0 0", "0 0 1")],
        [0.2, 0.8, 0.1, 0.0],
        [0.7, 1.1, 0.2, 0.5],
    ),
    "5 axes": (
        [("R", "0 0 0.4", "0 0 1"), *[("R", "0 0 0.3", "0 1 0")] * 3, ("R", "0 0 0.1", "0 0 1")],
        [0.1, 0.4, 0.8, 0.5, 0.0],
        [0.6, 0.6, 0.5, 0.6, 0.4],
    ),
    "7 axes": (
        [("R", "0 0 0.2", axis) for axis in ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")],
        [0.1, 0.5, 0.2, 1.2, 0.1, 0.6, 0.0],
        [0.5, 0.6, 0.1, 1.0, 0.2, 0.8, 0.3],
    ),
}


def arm(name: str) -> tuple[RobotDescription, np.ndarray, np.ndarray]:
    specs, start, end = ARMS[name]
    joints = [
        (kind, [float(x) for x in xyz.split()], (0, 0, 0), [float(x) for x in axis.split()])
        for kind, xyz, axis in specs
    ]
    robot = build(joints, tip=((0.15, 0, 0.05), (0, 0, 0)), limit=3.0)
    slower = tuple(replace(joint, max_velocity=2.0, max_acceleration=8.0) for joint in robot.joints)
    return replace(robot, joints=slower), np.array(start), np.array(end)


def check_limits(robot, interpolator, trajectory):
    speed, acceleration, jerk = (np.diff(trajectory.q, k, axis=0) / 0.002**k for k in (1, 2, 3))
    assert np.max(np.abs(speed)) < 2.0
    assert np.max(np.abs(acceleration)) < 8.0
    assert np.max(np.abs(jerk)) < 8.0 / interpolator.parameters.jerk_time
    assert np.max(np.abs(kinematics_for(robot).forward(trajectory.q) - trajectory.tcp)) < 1e-5


@pytest.mark.parametrize("name", ARMS)
def test_joint_moves_keep_the_limits_of_other_arms(name):
    robot, start, end = arm(name)
    interpolator = FlyInterpolator(robot)
    middle = JointTarget(0.5 * (start + end) + 0.1)
    flying = Pdl2Settings(fly_distance=0.05)
    trajectory = interpolator.plan(
        [Move(MoveType.JOINT, middle, flying, fly=True), Move(MoveType.JOINT, JointTarget(end), flying)], start
    )
    check_limits(robot, interpolator, trajectory)
    assert np.allclose(trajectory.q[-1], end, atol=1e-9)


@pytest.mark.parametrize("name", ["gantry", "scara", "7 axes"])
def test_linear_moves_keep_the_limits_of_other_arms(name):
    robot, start, end = arm(name)
    kinematics, interpolator = kinematics_for(robot), FlyInterpolator(robot)
    target = kinematics.forward(end[None])[0]
    trajectory = interpolator.plan(
        [Move(MoveType.LINEAR, CartesianTarget(target), Pdl2Settings(linear_speed=0.3))], start
    )
    check_limits(robot, interpolator, trajectory)
    position = trajectory.tcp[:, :3, 3]
    chord = (target[:3, 3] - position[0]) / np.linalg.norm(target[:3, 3] - position[0])
    along = (position - position[0]) @ chord
    assert np.max(np.linalg.norm(position - position[0] - along[:, None] * chord, axis=1)) < 1e-5
    assert np.max(np.abs(trajectory.tcp[-1] - target)) < 1e-6
    assert trajectory.path_speed.max() == pytest.approx(0.3, rel=1e-3)
