"""Closed form of arms whose axes 2, 3 and 4 are parallel, exactly or as calibrated."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.robot import KinematicsError, NumericalKinematics, RobotDescription, kinematics_for, load_robot
from agent.robot.kinematics.parallel_axes import ParallelAxesKinematics
from tests.robot.conftest import check_branches

POSTURE = np.array([0.3, -1.2, 1.4, -1.5, -1.2, 0.4])


def arm(make_arm: Callable, seed: int, off: float = 0.0) -> RobotDescription:
    """An arm of random lengths, offsets and senses; every frame has an error [m, rad] from a right angle."""
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1, 1], 6)
    a1, b, d4, d5, d6 = rng.uniform([0.0, -0.1, 0.05, -0.12, 0.02], [0.1, 0.1, 0.15, 0.12, 0.1])
    upper, forearm = rng.uniform(0.3, 0.7, 2)
    frames = [
        ((0.0, 0.0, 0.2), (0.0, 0.0, 0.4)),
        ((a1, 0.0, 0.1), (-np.pi / 2, 0.0, 0.0)),
        ((0.1, -upper, b), (0.0, 0.0, 0.3)),
        ((0.0, forearm, d4), (0.0, 0.0, -0.2)),
        ((0.0, 0.0, 0.02), (np.pi / 2, 0.0, 0.0)),
        ((0.0, 0.0, d5), (-np.pi / 2, 0.1, 0.0)),
    ]
    joints = [
        ("R", np.add(xyz, off * rng.uniform(-1, 1, 3)), np.add(rpy, off * rng.uniform(-1, 1, 3)), (0, 0, sign))
        for (xyz, rpy), sign in zip(frames, signs, strict=True)
    ]
    return make_arm(joints, tip=((0.01, 0.02, d6), (0.2, -0.1, 0.5)), limit=2 * np.pi)


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 1e-3]))
def test_inverse_kinematics_round_trip_on_every_branch(make_arm: Callable, seed: int, off: float) -> None:
    kinematics = kinematics_for(arm(make_arm, seed, off))
    assert isinstance(kinematics, ParallelAxesKinematics)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 6))
    check_branches(kinematics, q[kinematics.singularity(q).min(axis=1) > 0.1], 2e-9)


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 1e-3]))
def test_follow_keeps_branch_and_turns(make_arm: Callable, seed: int, off: float) -> None:
    kinematics = kinematics_for(arm(make_arm, seed, off))
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 200)[:, None]
    q = POSTURE + rng.uniform(0.1, 0.2, 6) * np.sin(2 * np.pi * (t * rng.integers(1, 3, 6) + rng.uniform(0, 1, 6)))
    q[:, [0, 5]] += 2 * np.pi * rng.integers(-1, 2, 2) + 9.0 * t
    if kinematics.singularity(q).min() > 0.05:
        np.testing.assert_allclose(kinematics.follow(kinematics.forward(q), q[0]), q, atol=1e-7)


@pytest.mark.parametrize(
    ("joint", "value", "message"), [(2, 0.0, "elbow is stretched or folded"), (4, 0.0, "axes 4 and 6 parallel")]
)
def test_singular_poses_are_refused(joint: int, value: float, message: str) -> None:
    kinematics = kinematics_for(load_robot("ur5e"))
    q = POSTURE.copy()
    q[joint] = value
    with pytest.raises(KinematicsError, match=message) as refused:
        kinematics.follow(kinematics.forward(q[None]), POSTURE)
    assert refused.value.reason == "singular"


@pytest.mark.parametrize(
    ("place", "message"), [((1.2, 0.0, 0.3), "m too far|the arm reaches from"), ((0.0, 0.0, 0.5), "comes no nearer")]
)
def test_poses_out_of_reach_are_refused_with_the_distance(place: tuple[float, ...], message: str) -> None:
    kinematics = kinematics_for(load_robot("ur5e"))
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = place
    with pytest.raises(KinematicsError, match=message) as refused:
        kinematics.solve(pose, POSTURE)
    assert refused.value.reason == "unreachable"


def test_non_parallel_axes_have_no_closed_form(make_arm: Callable) -> None:
    assert isinstance(kinematics_for(arm(make_arm, 1, off=0.05)), NumericalKinematics)
