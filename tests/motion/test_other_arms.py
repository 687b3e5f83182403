"""Any serial arm of one to seven joints, with or without a spherical wrist, Cartesian limits or jerk limits."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import FlyInterpolator
from agent.motion.program import CartesianTarget, JointTarget, MotionSettings, Move, MoveType, OrientationType
from agent.robot import Joint, RobotDescription, kinematics_for

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
    parts = ['<robot name="arm"><link name="l0"/>']
    for k, (kind, origin, axis) in enumerate(specs, start=1):
        parts.append(
            f'<joint name="j{k}" type="{"revolute" if kind == "R" else "prismatic"}"><parent link="l{k - 1}"/>'
            f'<child link="l{k}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>'
            f'<limit lower="-3" upper="3" velocity="1" effort="1"/></joint><link name="l{k}"/>'
        )
    n = len(specs)
    parts.append(
        f'<joint name="mount" type="fixed"><parent link="l{n}"/><child link="tip"/><origin xyz="0.15 0 0.05"/></joint>'
        '<link name="tip"/></robot>'
    )
    robot = RobotDescription(
        name="arm",
        urdf="".join(parts),
        tip_frame="tip",
        gravity=(0.0, 0.0, -9.81),
        cartesian_limits=None,
        joints=tuple(
            Joint(f"j{k}", spec[0] == "P", 100.0, None, 2.0, 8.0, None, None, None, None, -3.0, 3.0)
            for k, spec in enumerate(specs, start=1)
        ),
        motor_coupling=tuple(tuple(float(i == j) for j in range(n)) for i in range(n)),
    )
    return robot, np.array(start), np.array(end)


def check_limits(robot, interpolator, trajectory):
    speed, acceleration, jerk = (np.diff(trajectory.q, k, axis=0) / 0.002**k for k in (1, 2, 3))
    assert np.max(np.abs(speed)) < 2.0
    assert np.max(np.abs(acceleration)) < 8.0
    assert np.max(np.abs(jerk)) < 8.0 / interpolator.parameters.jerk_time
    assert np.max(np.abs(kinematics_for(robot).forward(trajectory.q) - trajectory.tcp)) < 1e-5


@pytest.mark.parametrize("name", ARMS)
def test_joint_moves(name):
    robot, start, end = arm(name)
    interpolator = FlyInterpolator(robot)
    middle = JointTarget(0.5 * (start + end) + 0.1)
    flying = MotionSettings(fly_distance=0.05)
    trajectory = interpolator.plan(
        [Move(MoveType.JOINT, middle, flying, fly=True), Move(MoveType.JOINT, JointTarget(end), flying)], start
    )
    check_limits(robot, interpolator, trajectory)
    assert np.allclose(trajectory.q[-1], end, atol=1e-9)


@pytest.mark.parametrize("name", ["gantry", "scara", "7 axes"])
def test_lines(name):
    robot, start, end = arm(name)
    kinematics, interpolator = kinematics_for(robot), FlyInterpolator(robot)
    target = kinematics.forward(end[None])[0]
    trajectory = interpolator.plan(
        [Move(MoveType.LINEAR, CartesianTarget(target), MotionSettings(linear_speed=0.3))], start
    )
    check_limits(robot, interpolator, trajectory)
    position = trajectory.tcp[:, :3, 3]
    chord = (target[:3, 3] - position[0]) / np.linalg.norm(target[:3, 3] - position[0])
    along = (position - position[0]) @ chord
    assert np.max(np.linalg.norm(position - position[0] - along[:, None] * chord, axis=1)) < 1e-5
    assert np.max(np.abs(trajectory.tcp[-1] - target)) < 1e-6
    assert trajectory.path_speed.max() == pytest.approx(0.3, rel=1e-3)


def test_wrist_jnt_is_for_six_joints():
    robot, start, end = arm("7 axes")
    target = CartesianTarget(kinematics_for(robot).forward(end[None])[0])
    settings = MotionSettings(orientation=OrientationType.WRIST_JNT)
    with pytest.raises(InputError, match="WRIST_JNT needs an arm of 6 joints"):
        FlyInterpolator(robot).plan([Move(MoveType.LINEAR, target, settings)], start)
