"""The law of motion of the emulated UR, from its own kinematics up; what the moves look like from outside."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from agent.robot import kinematics_for, load_robot
from fake_controller.ur.arm import (
    MODELS,
    DenavitHartenberg,
    Unreachable,
    matrices_of,
    matrix_of,
    poses_of,
    twist_between,
)
from fake_controller.ur.law import CB3, E_SERIES, UrInterpolator, UrMove, trapezoid

ARM = DenavitHartenberg.nominal("ur5e")
HOME = np.radians([0.0, -100, -120, -50, 90, 0])
PERIOD = 0.002
joints = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)
LAWS = pytest.mark.parametrize("law", [E_SERIES, CB3])


def moved(*offsets, turn=(0, 0, 0)):
    """TCP pose (4, 4) at an offset [m] from HOME."""
    goal = ARM.forward(HOME[None])[0].copy()
    goal[:3, 3] += offsets
    goal[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ goal[:3, :3]
    return goal


def move(goal, kind="line", speed=0.5, acceleration=1.2, radius=0.0, via=None, q=None):
    goal = ARM.forward(q[None])[0] if q is not None else goal
    return UrMove(kind, goal, np.eye(4), speed, acceleration, radius, 1, q, via)


def plan(law, *moves):
    """Set-points (K, 6) and velocities of moves from HOME."""
    interpolator = UrInterpolator(ARM, law, PERIOD, HOME)
    parts = [interpolator.plan(*pair) for pair in zip(moves, [*moves[1:], None], strict=True)]
    q, qd = (np.vstack([getattr(part, name) for part in parts]) for name in ("position", "velocity"))
    return np.vstack([HOME, q]), np.vstack([0 * HOME, qd])


def speeds(q):
    return np.linalg.norm(np.diff(ARM.forward(q)[:, :3, 3], axis=0), axis=1) / PERIOD


@given(joints)
def test_kinematics_are_those_of_the_description(q):
    for model in MODELS:
        expected = kinematics_for(load_robot(model)).forward(q[None])
        np.testing.assert_allclose(DenavitHartenberg.nominal(model).forward(q[None]), expected, atol=1e-9)


@given(joints)
def test_the_jacobian_is_the_derivative_and_the_inverse_leads_back(q):
    step = 1e-6 * np.eye(6)
    differences = twist_between(np.repeat(ARM.forward(q[None]), 6, 0), ARM.forward(q + step)) / 1e-6
    np.testing.assert_allclose(differences.T, ARM.jacobian(q[None])[0], atol=1e-4)
    if abs(np.linalg.det(ARM.jacobian(q[None])[0])) > 1e-3:
        np.testing.assert_allclose(ARM.inverse(ARM.forward(q[None]), q + 1e-3)[0], q, atol=1e-8)


@given(joints, joints)
def test_twists_and_poses_invert_each_other(first, second):
    a, b = ARM.forward(np.array([first, second]))[:, None]
    twist = twist_between(a, b)[0]
    np.testing.assert_allclose(matrix_of([0, 0, 0, *twist[3:]])[:3, :3] @ a[0, :3, :3], b[0, :3, :3], atol=1e-7)
    np.testing.assert_allclose(matrices_of(poses_of(a)), a, atol=1e-9)


@given(st.floats(0.01, 2), st.floats(0, 1), st.floats(0.05, 2), st.floats(0, 1), st.floats(0.2, 5))
def test_a_trapezoid_covers_its_length(length, v0, speed, v1, acceleration):
    times, corners = trapezoid(length, v0, speed, v1, acceleration)
    covered = np.sum(np.diff(times) * (corners[1:] + corners[:-1]) / 2)
    np.testing.assert_allclose(covered, length, rtol=1e-7)
    assert (corners[0], corners[-1]) == (v0, v1)
    assert corners.max() <= max(v0, speed, v1) + 1e-12
    slopes = np.abs(np.diff(corners)) / np.maximum(np.diff(times), 1e-12)
    least = abs(v1**2 - v0**2) / (2 * length)
    assert slopes.max() <= max(acceleration, least) * (1 + 1e-6) + 1e-9 or len(times) == 2


@LAWS
def test_a_joint_move_is_a_trapezoid_of_its_leading_joint(law):
    goal = HOME + [0.8, 0.2, -0.4, 0, 0, 0.1]
    q, qd = plan(law, move(None, "joint", 1.05, 1.4, q=goal))
    np.testing.assert_allclose(q[-1], goal)
    np.testing.assert_array_equal(qd[-1], 0)
    assert np.abs(qd).max() == pytest.approx(1.05)
    np.testing.assert_allclose(len(q) * PERIOD, 0.8 / 1.05 + 1.05 / 1.4, atol=2 * PERIOD)
    np.testing.assert_allclose(np.outer(q[:, 0] - HOME[0], (goal - HOME) / 0.8), q - HOME, atol=1e-9)


@LAWS
def test_a_straight_move_is_straight_and_as_fast_as_it_says(law):
    goal = moved(0.2, 0.1, -0.1, turn=(0.2, 0, 0.3))
    q, qd = plan(law, move(goal))
    places = ARM.forward(q)
    way = goal[:3, 3] - places[0, :3, 3]
    share = (places[:, :3, 3] - places[0, :3, 3]) @ way / (way @ way)
    np.testing.assert_allclose(places[:, :3, 3], places[0, :3, 3] + np.outer(share, way), atol=1e-7)
    turned = Rotation.from_matrix(places[0, :3, :3].T @ places[:, :3, :3]).magnitude()
    np.testing.assert_allclose(turned, share * turned[-1], atol=1e-6)  # orientation along the same law
    assert speeds(q).max() == pytest.approx(0.5, abs=1e-3)
    assert np.abs(np.diff(speeds(q))).max() / PERIOD < 1.25
    np.testing.assert_allclose(np.diff(q, axis=0) / PERIOD, (qd[1:] + qd[:-1]) / 2, atol=6e-3)


CORNER = (0.2, 0.0, 0.0)


def rounded(law, first_speed=0.4, second_speed=0.2, radius=0.05):
    """Places (K, 3) relative to a right corner, of two blended moves."""
    first = move(moved(*CORNER), speed=first_speed, radius=radius)
    q, qd = plan(law, first, move(moved(0.2, 0.3, 0.0), speed=second_speed))
    np.testing.assert_allclose(np.diff(q, axis=0) / PERIOD, (qd[1:] + qd[:-1]) / 2, atol=2e-2)
    return q, ARM.forward(q)[:, :3, 3] - moved(*CORNER)[:3, 3]


@LAWS
def test_a_blend_begins_at_its_share_of_the_radius(law):
    _, places = rounded(law)
    left = np.abs(places[:, 1]) > 1e-6
    begin = -places[np.argmax(left), 0]
    reach = law.begin * 0.05
    assert begin == pytest.approx(reach, abs=2e-3)
    assert np.linalg.norm(places, axis=1).min() > 0.2 * reach


def test_an_e_series_keeps_its_speed_in_a_blend():
    q, places = rounded(E_SERIES)
    inside = np.linalg.norm(places[1:], axis=1) < 0.9 * 0.9 * 0.05
    np.testing.assert_allclose(speeds(q)[inside], 0.4, rtol=2e-3)
    assert speeds(q)[-1] < 0.01


def test_a_cb3_mixes_velocities_in_a_blend():
    _, places = rounded(CB3)
    velocity = np.diff(places, axis=0) / PERIOD
    inside = (np.abs(velocity[:, 0]) > 1e-4) & (np.abs(velocity[:, 1]) > 1e-4)
    mixed = np.diff(velocity[inside], axis=0)[2:-2]
    np.testing.assert_allclose(mixed, np.broadcast_to(mixed.mean(axis=0), mixed.shape), atol=2e-5)  # linear in time
    np.testing.assert_allclose(velocity[inside][:, 0] / 0.4 + velocity[inside][:, 1] / 0.2, 1.0, atol=2e-2)


@LAWS
@pytest.mark.parametrize("kinds", ["jj", "jl", "lj", "ll", "la", "pp"])
def test_all_kinds_of_moves_blend_into_each_other_without_a_jump(law, kinds):
    middle, end = moved(0.1, 0.05, 0.0), moved(0.1, 0.2, -0.05)
    moves = []
    for kind, goal, radius in zip(kinds, (middle, end), (0.03, 0.0), strict=True):
        if kind == "j":
            moves.append(move(None, "joint", 1.0, 2.0, radius, q=ARM.nearest(goal, HOME)))
        else:
            name = {"l": "line", "a": "arc", "p": "process"}[kind]
            moves.append(move(goal, name, 0.25, 1.2, radius, moved(0.13, 0.12, 0) if kind == "a" else None))
    q, qd = plan(law, *moves)
    np.testing.assert_allclose(ARM.forward(q[-1:])[0], end, atol=1e-7)
    assert np.abs(np.diff(qd, axis=0)).max() / PERIOD < 60
    np.testing.assert_allclose(np.diff(q, axis=0) / PERIOD, (qd[1:] + qd[:-1]) / 2, atol=2e-2)
    assert np.linalg.norm(ARM.forward(q)[:, :3, 3] - middle[:3, 3], axis=1).min() < 0.03


def test_a_circle_goes_through_its_points():
    via, end = moved(0.1, 0.1, 0.0), moved(0.2, 0.0, 0.0)
    q, _ = plan(E_SERIES, move(end, "arc", 0.25, via=via))
    places = ARM.forward(q)[:, :3, 3] - moved(0.1, 0.0, 0.0)[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 0.1, atol=1e-7)
    assert np.linalg.norm(places - [0, 0.1, 0], axis=1).min() < 1e-3
    assert speeds(q).max() == pytest.approx(0.25, abs=1e-3)


def test_a_blend_is_as_slow_as_the_next_move_needs_to_stop():
    fast = move(moved(0.3, 0, 0), speed=1.0, acceleration=2.0, radius=0.01)
    q, _ = plan(E_SERIES, fast, move(moved(0.3, 0.03, 0), acceleration=1.0))
    assert speeds(q).max() > 0.5
    assert np.abs(np.diff(speeds(q)))[-20:].max() / PERIOD < 1.05
    np.testing.assert_allclose(ARM.forward(q[-1:])[0], moved(0.3, 0.03, 0), atol=1e-7)


def test_an_unreachable_pose_is_refused():
    with pytest.raises(Unreachable):
        plan(E_SERIES, move(moved(2.0, 0, 0)))
    with pytest.raises(Unreachable):
        ARM.nearest(moved(0, 0, 2.0), HOME)
