"""Numerical inverse kinematics: arms without closed form, and the closed form's own arm as a reference."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.robot import KinematicsError, NumericalKinematics, RobotDescription, chain_of, kinematics_for, load_robot
from agent.robot.kinematics.base import SINGULAR_DISTANCE
from agent.robot.kinematics.parallel_axes import ParallelAxesKinematics
from agent.robot.kinematics.spherical_wrist import SphericalWristKinematics

NUMERICAL = ("slide", "planar", "anthropomorphic", "gantry", "scara", "skew", "seven axes")


def swing(dof: int, rng: np.random.Generator, samples: int) -> np.ndarray:
    """A smooth path that stays away from stretched arms."""
    t = np.linspace(0.0, 1.0, samples)[:, None]
    middle = rng.uniform(0.6, 0.9, dof)
    return middle + rng.uniform(0.1, 0.25, dof) * np.sin(
        2 * np.pi * (t * rng.integers(1, 3, dof) + rng.uniform(0, 1, dof))
    )


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(NUMERICAL), st.integers(0, 2**31))
def test_follow_reaches_every_pose(arms: dict[str, RobotDescription], name: str, seed: int) -> None:
    kinematics = kinematics_for(arms[name])
    assert isinstance(kinematics, NumericalKinematics)
    q = swing(kinematics.dof, np.random.default_rng(seed), 150)
    poses = kinematics.forward(q)
    found = kinematics.follow(poses, q[0])
    np.testing.assert_allclose(kinematics.forward(found), poses, atol=1e-10)
    if kinematics.dof <= 6:
        np.testing.assert_allclose(found, q, atol=1e-7)


def test_a_redundant_arm_moves_as_smoothly_as_its_tool(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    q = swing(7, np.random.default_rng(0), 400)
    found = kinematics.follow(kinematics.forward(q), q[0])
    jerkiness = np.abs(np.diff(found, 2, axis=0)).max() / np.abs(np.diff(q, 2, axis=0)).max()
    assert jerkiness < 3


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(NUMERICAL), st.integers(0, 2**31))
def test_inverse_and_solve_find_the_pose(arms: dict[str, RobotDescription], name: str, seed: int) -> None:
    kinematics = kinematics_for(arms[name])
    q = np.random.default_rng(seed).uniform(0.4, 1.4, (3, kinematics.dof))
    poses = kinematics.forward(q)
    found = kinematics.inverse(poses)
    assert found.valid.any(axis=1).all()
    sample, branch = np.nonzero(found.valid)
    np.testing.assert_allclose(kinematics.forward(found.q[sample, branch]), poses[sample], atol=1e-9)
    solved = kinematics.solve(poses[0], q[0])
    assert kinematics.within_limits(solved)
    np.testing.assert_allclose(solved, q[0], atol=1e-6)


UR = (ParallelAxesKinematics, [0.3, -1.2, 1.4, -1.5, -1.2, 0.4], 0.3, 5, 40)


@pytest.mark.parametrize(
    ("name", "kind", "middle", "around", "count", "missed"),
    [("comau_ns16", SphericalWristKinematics, [0.0] * 6, 1.2, 10, 4), ("ur3e", *UR), ("ur5e", *UR), ("ur10e", *UR)],
)
def test_numerical_and_closed_form_solutions_agree(
    name: str, kind: type, middle: list[float], around: float, count: int, missed: int
) -> None:
    robot = load_robot(name)
    closed, numerical = kinematics_for(robot), NumericalKinematics(robot, chain_of(robot))
    assert isinstance(closed, kind)
    poses = closed.forward(middle + np.random.default_rng(3).uniform(-around, around, (count, 6)))
    exact, found = closed.inverse(poses), numerical.inverse(poses)
    for k in range(len(poses)):
        expected = exact.q[k, exact.valid[k]]
        for q in found.q[k, found.valid[k]]:
            assert np.abs(np.angle(np.exp(1j * (expected - q)))).max(axis=1).min() < 1e-7
    assert 0 <= exact.valid.sum() - found.valid.sum() <= missed


@pytest.mark.parametrize("name", NUMERICAL)
def test_a_pose_out_of_reach_is_reported(arms: dict[str, RobotDescription], name: str) -> None:
    kinematics = kinematics_for(arms[name])
    start = np.full(kinematics.dof, 0.7)
    poses = np.repeat(kinematics.forward(start[None]), 30, axis=0)
    poses[20:, :3, 3] += [0.1, 40.0, 0.3]
    if name == "gantry":
        poses[20:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    assert kinematics.inverse(poses[[0, 25]]).unreachable.tolist() == [False, True]
    with pytest.raises(KinematicsError, match="cannot be reached") as refused:
        kinematics.follow(poses, start)
    assert (refused.value.reason, refused.value.index) == ("unreachable", 20)
    assert refused.value.excess > 0
    with pytest.raises(KinematicsError, match="cannot be reached"):
        kinematics.solve(poses[25], start)


def test_a_singular_pose_is_reported(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["seven axes"])
    outstretched = kinematics.forward(np.zeros((1, 7)))
    found = kinematics.inverse(outstretched)
    assert found.singular.any()
    assert not found.valid.any()
    assert not found.unreachable.any()
    with pytest.raises(KinematicsError) as refused:
        kinematics.solve(outstretched[0], np.full(7, 0.2))
    assert refused.value.reason == "singular"


def test_solutions_are_unwrapped_into_the_limits(make_arm: Callable) -> None:
    robot = make_arm([("R", (0, 0, 0), (0, 0, 0), (0, 0, 1)), ("R", (0.5, 0, 0), (0, 0, 0), (0, 0, 1))], limit=2.0)
    kinematics = kinematics_for(robot)
    pose = kinematics.forward(np.array([[1.5, 0.3]]))[0]
    np.testing.assert_allclose(kinematics.solve(pose, np.array([1.5 + 2 * np.pi, 0.3])), [1.5, 0.3], atol=1e-9)
    outside = kinematics.forward(np.array([[2.5, 0.3]]))[0]
    with pytest.raises(KinematicsError, match="joint limit"):
        kinematics.solve(outside, np.array([1.5, 0.3]))


@pytest.mark.parametrize(("turn", "beyond"), [(2.1, 0.1), (-2.3, 0.3), (2.1 + 2 * np.pi, 0.1)])
def test_reports_the_limit_violation_of_the_nearest_turn(make_arm: Callable, turn: float, beyond: float) -> None:
    robot = make_arm([("R", (0, 0, 0), (0, 0, 0), (0, 0, 1)), ("P", (0.5, 0, 0), (0, 0, 0), (0, 0, 1))], limit=2.0)
    kinematics = kinematics_for(robot)
    pose = kinematics.forward(np.array([[turn, 0.1]]))[0]
    with pytest.raises(KinematicsError, match=rf"the best one that of j1 by {beyond:.3g} rad") as refused:
        kinematics.solve(pose, np.zeros(2))
    assert refused.value.excess == pytest.approx(beyond)


def test_an_arm_without_closed_form_has_no_configuration_flags(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["scara"])
    q = np.array([0.4, 0.5, 0.2, -0.3])
    assert kinematics.configuration_text(q) == ""
    pose = kinematics.forward(q[None])[0]
    solved = kinematics.solve_configuration(pose, "")
    np.testing.assert_allclose(kinematics.forward(solved[None])[0], pose, atol=1e-9)
    with pytest.raises(InputError, match="no spherical wrist"):
        kinematics.solve_configuration(pose, "S")


def test_an_empty_list_of_poses_gives_an_empty_path(arms: dict[str, RobotDescription]) -> None:
    for name in ("comau_ns16", "scara"):
        kinematics = kinematics_for(arms[name])
        nothing = np.empty((0, 4, 4))
        assert kinematics.follow(nothing, np.zeros(kinematics.dof)).shape == (0, kinematics.dof)
        assert kinematics.inverse(nothing).valid.shape == (0, 8)


@pytest.mark.parametrize("name", NUMERICAL)
def test_the_singularity_bound_never_misses_a_singular_pose(arms: dict[str, RobotDescription], name: str) -> None:
    """The bound may ask for more than is needed, never for less."""
    kinematics = kinematics_for(arms[name])
    assert isinstance(kinematics, NumericalKinematics)
    q = np.random.default_rng(2).uniform(-np.pi, np.pi, (600, kinematics.dof))
    q[::4] *= 1e-6
    singular = kinematics.singularity(q).min(axis=1) < SINGULAR_DISTANCE
    assert kinematics._suspects(q)[singular].all()


@settings(max_examples=10, deadline=None)
@given(st.sampled_from(("anthropomorphic", "skew", "scara", "seven axes")), st.integers(0, 2**31))
def test_batch_inverse_equals_single_solutions(arms: dict[str, RobotDescription], name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kinematics = kinematics_for(arms[name])
    q = swing(kinematics.dof, rng, 4)
    near = q + np.array([[0.02], [0.02], [0.02], [0.8]]) * rng.uniform(-1, 1, q.shape)  # the last one looks for it
    poses = kinematics.forward(q)
    one_by_one = [kinematics.solve(pose, there) for pose, there in zip(poses, near, strict=True)]
    np.testing.assert_allclose(kinematics.find(poses, near)[0], one_by_one, atol=1e-9)


def test_finds_the_unreachable_pose_among_many(arms: dict[str, RobotDescription]) -> None:
    kinematics = kinematics_for(arms["anthropomorphic"])
    q = swing(kinematics.dof, np.random.default_rng(0), 3)
    poses = kinematics.forward(q)
    poses[1, :3, 3] += 100.0
    assert kinematics.find(poses, q)[1].tolist() == [True, False, True]
    assert "cannot be reached" in str(kinematics.refusal(poses[1], q[1]))
