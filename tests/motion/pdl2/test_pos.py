import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.motion import pose_to_pos
from agent.motion.pdl2.variables import pos_to_pose

ANGLE = st.floats(-400, 400) | st.sampled_from([0.0, 90.0, 180.0, -180.0, 1e-7, 180.0 - 1e-7, 1e-12])
POS = st.tuples(*[st.floats(-5000, 5000)] * 3, ANGLE, ANGLE, ANGLE)


@given(POS)
def test_pose_and_coordinates_are_inverse_to_each_other(pos):
    pose = pos_to_pose(np.array(pos))
    again = pose_to_pos(pose)
    np.testing.assert_allclose(pos_to_pose(again), pose, atol=1e-12)
    assert 0 <= again[4] <= 180
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


@given(st.lists(st.tuples(st.floats(-179, 179), st.floats(1, 179), st.floats(-179, 179)), min_size=1))
def test_angles_follow_the_zyz_formulas(angles):
    pos = np.hstack([np.zeros((len(angles), 3)), np.array(angles)])
    rotation = pos_to_pose(pos)[:, :3, :3]
    np.testing.assert_allclose(np.degrees(np.arctan2(rotation[:, 1, 2], rotation[:, 0, 2])), pos[:, 3], atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.arccos(rotation[:, 2, 2])), pos[:, 4], atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.arctan2(rotation[:, 2, 1], -rotation[:, 2, 0])), pos[:, 5], atol=1e-9)
    np.testing.assert_allclose(pose_to_pos(pos_to_pose(pos)), pos, atol=1e-9)


def test_units_and_order():
    pose = pos_to_pose(np.array([1000, -250, 3, 0, 90, 0]))
    np.testing.assert_allclose(pose[:3, 3], [1.0, -0.25, 0.003])
    np.testing.assert_allclose(pose[:3, 0], [0, 0, -1], atol=1e-15)  # the tool's x axis points down


@pytest.mark.parametrize("e", [0.0, 180.0])
def test_a_is_zero_at_the_euler_singularity(e):
    again = pose_to_pos(pos_to_pose(np.array([0, 0, 0, 25, e, 10])))
    assert again[3] == 0
    assert again[5] == pytest.approx(35 if e == 0 else -15)
