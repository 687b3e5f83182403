"""Closed-form kinematics: laws over random arms, poses and paths."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.robot import Dynamics, KinematicsError, RobotDescription, Tool, kinematics_for, load_robot
from agent.robot.kinematics.base import SINGULAR_DISTANCE, pose_error
from agent.robot.kinematics.closed_form import SINGULARITIES
from agent.robot.kinematics.configuration import Configuration, parse_configuration
from agent.robot.kinematics.numerical import NumericalKinematics
from agent.robot.kinematics.spherical_wrist import SphericalWristKinematics
from tests.robot.conftest import check_branches

seeds = st.integers(0, 2**31)
signs = st.tuples(*[st.sampled_from((-1, 1))] * 6)
geometry = st.fixed_dictionaries(
    {
        "offset": st.sampled_from((-0.25, 0.0, 0.05, 0.4)),
        "lateral": st.sampled_from((0.0, 0.08, -0.15)),
        "upper": st.floats(0.3, 1.0),
        "forearm": st.tuples(st.floats(-0.3, 0.3), st.floats(0.2, 0.9)),
        "axis_signs": signs,
        "twist": st.sampled_from((0.0, np.pi / 2, -0.7, np.pi)),
        "base": st.tuples(*[st.floats(-3, 3)] * 3),
    }
)
TOOL = Tool(np.array([[0, 0, 1, 0.1], [1, 0, 0, -0.05], [0, 1, 0, 0.2], [0, 0, 0, 1.0]]), mass=2.0)
CALIBRATION = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])


def test_forward_kinematics_and_jacobian_agree_with_the_dynamics(arms: dict[str, RobotDescription]) -> None:
    for name, robot in arms.items():
        q = np.random.default_rng(0).uniform(-2, 2, (50, robot.dof))
        for tool in (None, TOOL):
            kinematics, dynamics = kinematics_for(robot, tool), Dynamics(robot, tool)
            np.testing.assert_allclose(kinematics.forward(q), dynamics.tcp_pose(q), atol=1e-12, err_msg=name)
            np.testing.assert_allclose(kinematics.jacobian(q), dynamics.tcp_jacobian(q), atol=1e-12, err_msg=name)


@settings(max_examples=40, deadline=None)
@given(geometry, seeds)
def test_inverse_kinematics_round_trip_on_every_branch(make_spherical: Callable, shape: dict, seed: int) -> None:
    kinematics = kinematics_for(make_spherical(**shape), TOOL)
    assert isinstance(kinematics, SphericalWristKinematics)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 6))
    check_branches(kinematics, q[kinematics.singularity(q).min(axis=1) > 0.01], 1e-8)


def test_finds_eight_solutions_in_the_working_range(ns16: RobotDescription) -> None:
    kinematics = kinematics_for(ns16)
    found = kinematics.inverse(kinematics.forward(np.array([[0.2, -0.3, -2.2, 0.4, 0.9, -0.3]])))
    assert found.valid.sum() == 8
    assert not found.within_limits.all()
    np.testing.assert_array_equal(found.within_limits, kinematics.within_limits(found.q) & found.valid)


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(-1, 1), st.integers(-1, 1))
def test_follow_keeps_branch_and_turns(ns16: RobotDescription, seed: int, turn_4: int, turn_6: int) -> None:
    """A smooth path that stays clear of singularities comes back as it was, many turns of axes 4 and 6 included."""
    kinematics = kinematics_for(ns16)
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 400)[:, None]
    middle = np.array([0.0, 0.2, -1.6, 2 * np.pi * turn_4, rng.choice([-0.9, 0.9]), 2 * np.pi * turn_6])
    q = middle + rng.uniform(0.1, 0.5, 6) * np.sin(2 * np.pi * (t * rng.integers(1, 3, 6) + rng.uniform(0, 1, 6)))
    q[:, [0, 3, 5]] += t * rng.uniform(-14, 14, 3)
    np.testing.assert_allclose(kinematics.follow(kinematics.forward(q), q[0]), q, atol=1e-9)


def test_follow_reports_where_a_path_leaves_the_reach(ns16: RobotDescription) -> None:
    kinematics = kinematics_for(ns16)
    start = np.array([0.1, 0.2, -1.6, 0.3, 0.9, 0.1])
    poses = np.repeat(kinematics.forward(start[None]), 100, axis=0)
    poses[:, 0, 3] += np.linspace(0, 1.5, 100)
    with pytest.raises(KinematicsError, match="out of reach") as far:
        kinematics.follow(poses, start)
    assert far.value.reason == "unreachable"
    assert re.search(
        r"the arm reaches from 0\.\d+ to 1\.351 m, [\d.e-]+ mm too far", str(far.value)
    )  # the first that is
    first = far.value.index
    assert kinematics.follow(poses[: first - 3], start).shape == (first - 3, 6)
    assert not kinematics.inverse(poses[:first]).unreachable.any()
    assert kinematics.inverse(poses[first + 1 :]).unreachable.all()
    with pytest.raises(KinematicsError) as near:
        kinematics.follow(poses[: first + 3], start)
    assert near.value.index == first
    assert 0 < near.value.excess < far.value.excess


def test_a_path_through_the_wrist_singularity_is_refused(ns16: RobotDescription) -> None:
    kinematics = kinematics_for(ns16)
    q = np.tile([0.1, 0.2, -1.6, 0.3, 0.0, 0.1], (101, 1))
    q[:, 4] = np.linspace(0.2, -0.3, 101)  # zero at 40
    poses = kinematics.forward(q)
    with pytest.raises(KinematicsError, match="axes 4 and 6 in line") as on_it:
        kinematics.follow(poses, q[0])
    assert (on_it.value.reason, on_it.value.index) == ("singular", 40)
    with pytest.raises(KinematicsError, match="between poses 39 and 40") as over_it:
        kinematics.follow(np.delete(poses, 40, axis=0), q[0])
    assert (over_it.value.reason, over_it.value.index) == ("branch", 40)
    with pytest.raises(KinematicsError, match="the start") as from_it:
        kinematics.follow(poses[50:], q[40])
    assert from_it.value.reason == "singular"


@pytest.mark.parametrize(
    ("kind", "q"),
    [
        ("wrist", [0.1, 0.2, -1.6, 0.3, 0.0, 0.1]),
        ("elbow", [0.1, 0.2, -np.arctan2(0.185, 0.624), 0.3, 0.7, 0.1]),
        ("shoulder", [0.1, None, -1.6, 0.3, 0.7, 0.1]),
    ],
)
@pytest.mark.parametrize("aside", [0.0, 3e-5])
def test_singular_poses_are_reported_not_returned(ns16: RobotDescription, kind: str, q: list, aside: float) -> None:
    kinematics = kinematics_for(ns16)
    if kind == "shoulder":  # lean back until the wrist centre is over axis 1
        low, high = -1.5, 0.5
        for _ in range(80):
            q[1] = (low + high) / 2
            behind = (
                0.3 + 0.7 * np.sin(q[1]) + np.hypot(0.185, 0.624) * np.sin(q[1] - q[2] - np.arctan2(0.185, 0.624)) < 0
            )
            low, high = (q[1], high) if behind else (low, q[1])
    q = np.array(q)
    q[{"wrist": 4, "elbow": 2, "shoulder": 1}[kind]] += aside
    distance = kinematics.singularity(q[None])
    assert SINGULARITIES[distance.argmin()] == kind
    assert distance.min() < SINGULAR_DISTANCE
    pose = kinematics.forward(q[None])
    found = kinematics.inverse(pose)
    assert found.singular.any()
    assert not found.unreachable.any()
    assert not (found.singular & found.valid).any()
    with pytest.raises(KinematicsError) as refused:
        kinematics.follow(pose, q + np.array([0.01, 0.05, 0.05, 0, 0.05, 0]))
    assert refused.value.reason == "singular"


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_singularity_distances_match_the_jacobian_determinant(ns16: RobotDescription, seed: int) -> None:
    """The determinant of the Jacobian of a spherical-wrist arm is, up to a constant, the product of the three."""
    kinematics = kinematics_for(ns16)
    q = np.random.default_rng(seed).uniform(-3, 3, (5, 6))
    product = kinematics.singularity(q).prod(axis=1)
    constant = 0.7 * np.hypot(0.185, 0.624) * (0.7 + np.hypot(0.185, 0.624))
    np.testing.assert_allclose(np.abs(np.linalg.det(kinematics.jacobian(q))), constant * product, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_solve_takes_the_nearest_solution_within_limits(ns16: RobotDescription, seed: int) -> None:
    kinematics = kinematics_for(ns16)
    rng = np.random.default_rng(seed)
    q = rng.uniform(kinematics.lower, kinematics.upper, 6)
    if kinematics.singularity(q[None]).min() < 0.01:
        return
    pose = kinematics.forward(q[None])[0]
    np.testing.assert_allclose(kinematics.solve(pose, q), q, atol=1e-8)
    near = rng.uniform(kinematics.lower, kinematics.upper, 6)
    solved = kinematics.solve(pose, near)
    assert kinematics.within_limits(solved)
    np.testing.assert_allclose(kinematics.forward(solved[None])[0], pose, atol=1e-8)
    assert np.linalg.norm(solved - near) <= np.linalg.norm(q - near) + 1e-8


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_solve_on_branch_changes_branch_only_for_limits(ns16: RobotDescription, seed: int) -> None:
    kinematics = kinematics_for(ns16)
    rng = np.random.default_rng(seed)
    near, q = rng.uniform(kinematics.lower, kinematics.upper, (2, 6))
    if kinematics.singularity(np.array([near, q])).min() < 0.01:
        return
    pose = kinematics.forward(q[None])[0]
    solved = kinematics.solve(pose, near, on_branch=True)
    assert kinematics.within_limits(solved)
    np.testing.assert_allclose(kinematics.forward(solved[None])[0], pose, atol=1e-8)
    found = kinematics.inverse(pose[None])
    branches = [kinematics.branch(option) for option in found.q[0, found.within_limits[0]]]
    if kinematics.branch(near) in branches:
        assert kinematics.branch(solved) == kinematics.branch(near)
    else:
        np.testing.assert_array_equal(solved, kinematics.solve(pose, near))


def test_solve_names_the_violated_limit(ns16: RobotDescription) -> None:
    kinematics = kinematics_for(ns16)
    behind = np.array([0.2, np.radians(-59), np.radians(108), 0.3, 0.8, 0.1])
    pose = kinematics.forward((behind - np.radians([0, 20, 0, 0, 0, 0]))[None])[0]
    assert kinematics.inverse(pose[None]).valid.any()
    with pytest.raises(KinematicsError, match=r"joint limit.*joint_\d by .* rad") as refused:
        kinematics.solve(pose, behind)
    assert refused.value.reason == "unreachable"
    assert refused.value.excess > 0


def test_an_arm_with_a_lateral_offset_cannot_reach_over_its_own_axis(make_spherical: Callable) -> None:
    kinematics = kinematics_for(make_spherical(lateral=0.3))
    start = np.array([0.1, 0.3, 0.9, 0.1, 0.5, 0.1])
    pose = kinematics.forward(start[None])
    pose[:, :2, 3] = 0.1, -0.2  # where axis 1 stands; the wrist centre is 0.1 m off at most
    assert kinematics.inverse(pose).unreachable.all()
    with pytest.raises(KinematicsError, match=r"comes no nearer than 0\.300 m") as refused:
        kinematics.follow(pose, start)
    assert refused.value.reason == "unreachable"


def test_poses_that_are_not_numbers_are_unreachable(ns16: RobotDescription) -> None:
    kinematics = kinematics_for(ns16)
    start = np.array([0.1, 0.2, -1.6, 0.3, 0.9, 0.1])
    poses = np.repeat(kinematics.forward(start[None]), 3, axis=0)
    poses[1, 0, 3] = np.nan
    assert kinematics.inverse(poses).unreachable.tolist() == [False, True, False]
    with pytest.raises(KinematicsError) as refused:
        kinematics.follow(poses, start)
    assert refused.value.index == 1


def test_solves_a_rounded_urdf_to_full_precision(make_spherical: Callable) -> None:
    """Four digits of pi are common in URDFs; the closed form alone would be off by 10 µm."""
    kinematics = kinematics_for(make_spherical(pi=3.1416))
    assert isinstance(kinematics, SphericalWristKinematics)
    t = np.linspace(0, 1, 50)[:, None]
    q = np.array([0.1, 0.3, 0.9, 0.1, 0.8, 0.1]) + 0.3 * np.sin(2 * np.pi * t * np.arange(1, 7))
    poses = kinematics.forward(q)
    np.testing.assert_allclose(kinematics.follow(poses, q[0]), q, atol=1e-9)
    found = kinematics.inverse(poses)
    sample, branch = np.nonzero(found.valid)
    assert np.abs(pose_error(poses[sample], kinematics.forward(found.q[sample, branch]))).max() < 1e-9


@pytest.mark.parametrize("change", ["no wrist centre", "bent elbow", "six slides"])
def test_recognises_arms_without_a_spherical_wrist(make_arm: Callable, make_spherical: Callable, change: str) -> None:
    joints = [
        ["R", (0, 0, 0.3), (0, 0, 0), (0, 0, 1)],
        ["R", (0.3, 0, 0.2), (0, 0, 0), (0, 1, 0)],
        ["R", (0, 0, 0.7), (0, 0, 0), (0, 1, 0)],
        ["R", (0, 0, 0.3), (0, 0, 0), (0, 0, 1)],
        ["R", (0, 0, 0.3), (0, 0, 0), (0, 1, 0)],
        ["R", (0, 0, 0), (0, 0, 0), (0, 0, 1)],
    ]
    assert isinstance(kinematics_for(make_arm(joints)), SphericalWristKinematics)
    if change == "no wrist centre":
        joints[5][1] = (0.05, 0, 0)
    elif change == "bent elbow":
        joints[2][3] = (0.1, 1, 0)
    else:
        joints[0][0] = "P"
    assert isinstance(kinematics_for(make_arm(joints)), NumericalKinematics)


def test_recognises_the_development_arm(shared_data: Path) -> None:
    kinematics = kinematics_for(load_robot(shared_data / "gap-dev" / "robot.yaml"))
    assert isinstance(kinematics, SphericalWristKinematics)
    q = np.array([[0.3, 0.2, 0.1, -0.4, 0.8, 0.2]])
    np.testing.assert_allclose(kinematics.follow(kinematics.forward(q), q[0]), q, atol=1e-12)


# Configuration flags and turns


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_configuration_flags_select_the_joint_solution(ns16: RobotDescription, seed: int) -> None:
    kinematics = kinematics_for(ns16, TOOL)
    q = np.random.default_rng(seed).uniform(kinematics.lower, kinematics.upper, 6)
    if kinematics.singularity(q[None]).min() < 0.01:
        return
    text = kinematics.configuration_text(q)
    np.testing.assert_allclose(kinematics.solve_configuration(kinematics.forward(q[None])[0], text), q, atol=1e-8)


@pytest.mark.parametrize(
    ("degrees", "text"),
    [
        ((0, 0, -90, 0, 30, 0), "T1:0 T2:0 T3:0"),
        ((0, 0, -90, 0, -30, 0), "W T1:0 T2:0 T3:0"),
        ((0, 30, 20, 0, 30, 0), "E T1:0 T2:0 T3:1"),
        ((0, -60, 0, 0, 30, 0), "S E T1:0 T2:0 T3:1"),
        ((40, 0, -90, 200, 30, -600), "T1:1 T2:-2 T3:0"),
        ((0, 0, -90, 180, -30, -180), "W T1:1 T2:0 T3:0"),
        ((0, -50, 0, 0, 30, 180), "S E T1:0 T2:1 T3:1"),
    ],
)
def test_flags_and_turns_of_known_postures(ns16: RobotDescription, degrees: tuple, text: str) -> None:
    kinematics = kinematics_for(ns16)
    q = np.radians(np.array(degrees, dtype=float))
    assert kinematics.configuration_text(q) == text
    # On the border of a turn, the pose's round-off must not add one.
    np.testing.assert_allclose(kinematics.solve_configuration(kinematics.forward(q[None])[0], text), q, atol=1e-8)


@given(st.booleans(), st.booleans(), st.booleans(), st.tuples(*[st.integers(-9, 9)] * 3))
def test_configuration_text_round_trips(shoulder: bool, elbow: bool, wrist: bool, turns: tuple) -> None:
    configuration = Configuration(shoulder, elbow, wrist, turns)
    assert parse_configuration(str(configuration)) == configuration
    assert parse_configuration("  ".join(reversed(str(configuration).lower().split()))) == configuration


@pytest.mark.parametrize("text", ["X", "S S", "T4:1", "T1:", "T1:1 T1:2", "SEW", "T1:0.5", "T1:99999"])
def test_refuses_an_invalid_configuration(text: str) -> None:
    with pytest.raises(InputError, match="allowed are S E W"):
        parse_configuration(text)


def test_a_configuration_out_of_reach_is_refused(ns16: RobotDescription) -> None:
    kinematics = kinematics_for(ns16)
    pose = kinematics.forward(np.radians([[0.0, 60.0, -60.0, 0.0, 30.0, 0.0]]))[0]
    with pytest.raises(KinematicsError, match="out of reach") as refused:
        kinematics.solve_configuration(pose, "S T1:0 T2:0 T3:0")
    assert refused.value.reason == "unreachable"


def test_a_tip_that_is_not_at_the_end_is_refused(ns16: RobotDescription) -> None:
    with pytest.raises(InputError, match="tip_frame link_5"):
        kinematics_for(replace(ns16, tip_frame="link_5"))
