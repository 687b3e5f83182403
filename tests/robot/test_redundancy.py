"""Arms with a joint to spare: they come back to the joints that they left, and keep off their limits."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.excitation.candidates import posture
from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, Pdl2Settings, ViaRegions, loop_moves, rotation
from agent.motion.program import CartesianTarget, JointTarget, Move, MoveType
from agent.robot import RobotDescription, kinematics_for

MIDDLE = np.array([0.1, 0.5, 0.2, 1.2, 0.1, 0.9, 0.0])
FLY = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02, linear_speed=0.5)


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**31))
def test_a_loop_of_the_tool_is_a_loop_of_the_joints(arms: dict[str, RobotDescription], seed: int) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    interpolator = FlyInterpolator(arms["seven axes"])
    spread = np.random.default_rng(seed).uniform(-0.1, 0.1, (3, 7))
    joints, found = kinematics.nearest(kinematics.forward(MIDDLE + spread), np.tile(MIDDLE, (3, 1)))
    assert found.all()
    trajectory = interpolator.plan(loop_moves(kinematics.forward(joints), FLY, joints), joints[0])
    np.testing.assert_allclose(trajectory.q[-1], joints[0], atol=1e-9)
    assert np.abs(kinematics.forward(trajectory.q) - trajectory.tcp).max() < 1e-5


def test_a_line_to_joints_ends_at_those_joints_and_is_straight(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    end = kinematics.nearest(kinematics.forward((MIDDLE + 0.2)[None]), (MIDDLE + 0.4)[None])[0][0]
    move = Move(MoveType.LINEAR, JointTarget(end), Pdl2Settings(linear_speed=0.3))
    trajectory = FlyInterpolator(arms["seven axes"]).plan([move], MIDDLE)
    np.testing.assert_allclose(trajectory.q[-1], end, atol=1e-9)
    way = trajectory.tcp[:, :3, 3] - trajectory.tcp[0, :3, 3]
    chord = way[-1] / np.linalg.norm(way[-1])
    assert np.linalg.norm(way - (way @ chord)[:, None] * chord, axis=1).max() < 1e-5


def test_a_line_to_a_pose_takes_the_least_motion(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    pose = kinematics.forward((MIDDLE + 0.2)[None])[0]
    move = Move(MoveType.LINEAR, CartesianTarget(pose), Pdl2Settings(linear_speed=0.3))
    trajectory = FlyInterpolator(arms["seven axes"]).plan([move], MIDDLE)
    assert np.abs(trajectory.tcp[-1] - pose).max() < 1e-6
    assert np.abs(trajectory.q[-1] - MIDDLE).max() < 0.6


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**31))
def test_nearest_joints_are_a_minimum(arms: dict[str, RobotDescription], seed: int) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    rng = np.random.default_rng(seed)
    near = MIDDLE + rng.uniform(-0.2, 0.2, (3, 7))
    poses = kinematics.forward(MIDDLE + rng.uniform(-0.2, 0.2, (3, 7)))
    q, found = kinematics.nearest(poses, near)
    assert found.all()
    np.testing.assert_allclose(kinematics.forward(q), poses, atol=1e-9)
    for here, wanted, jacobian in zip(q, near, kinematics.jacobian(q), strict=True):
        (null,) = np.linalg.svd(jacobian)[2][6:]
        assert abs(null @ (here - wanted)) < 1e-8


def test_the_posture_keeps_a_margin_to_the_limits(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    middle = kinematics.forward(MIDDLE[None])[0]
    regions = ViaRegions.from_box(3, middle[:3, 3], [0.1, 0.1, 0.1], rotation.to_euler(middle[:3, :3]), 0.2)
    chosen = posture(kinematics, regions)
    pose = regions.poses(np.full(18, 0.5))[0]
    np.testing.assert_allclose(kinematics.forward(chosen[None])[0], pose, atol=1e-9)
    around = np.array([regions.poses(np.tile(genes, 3))[0] for genes in np.random.default_rng(0).uniform(size=(20, 6))])
    q, found = kinematics.nearest(around, np.tile(chosen, (20, 1)))
    assert found.all()
    assert kinematics.within_limits(q).all()


def test_what_is_out_of_reach_is_refused(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    poses = kinematics.forward(np.tile(MIDDLE, (3, 1)))
    poses[1, 0, 3] += 3.0
    with pytest.raises(Exception, match="cannot be reached"):
        kinematics.follow(poses, MIDDLE, np.tile(MIDDLE, (3, 1)))
