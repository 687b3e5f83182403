"""Errors of a simulation forward: what drives it, and the interval in which another motion lies nine times of ten."""

import numpy as np
import pytest

from agent.diagnosis.forward.interval import expected_range
from agent.diagnosis.forward.rollout import at_motors
from agent.model import ModelEffect

WINDOWS, HORIZONS, JOINTS = 8, 4, 6


def squares(rng, motions: int, between: float, within: float) -> np.ndarray:
    """(W, H, n) squared errors that differ by motion and by window."""
    motion = np.exp(between * rng.normal(size=(motions, 1, 1, JOINTS)))
    return (motion * np.exp(within * rng.normal(size=(motions, WINDOWS, HORIZONS, JOINTS)))).reshape(-1, 4, JOINTS)


@pytest.mark.parametrize("between", [0.0, 0.6, 1.2])
def test_the_interval_covers_nine_of_ten_unseen_motions(between):
    inside = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        low, high = expected_range(squares(rng, 3, between, 1.0), np.repeat(np.arange(3), WINDOWS), 1e9)
        other = np.sqrt(squares(rng, 1, between, 1.0).mean(axis=0))
        inside.append(np.mean((low <= other) & (other <= high)))
    assert 0.86 < np.mean(inside) < 0.97


def test_short_windows_and_a_single_motion_have_an_interval_too():
    found = squares(np.random.default_rng(1), 2, 0.5, 1.0)
    group = np.repeat([0, 1], WINDOWS)
    found[group == 1, -1] = np.nan  # no window of the second motion is as long
    low, high = expected_range(found, group, np.pi)
    middle = np.sqrt(np.nanmean(found, axis=0))
    assert np.all((low <= middle) & (middle <= high) & np.isfinite(high))
    low, high = expected_range(found[:WINDOWS], group[:WINDOWS], np.pi)
    assert np.all(low == 0)
    assert np.all(high >= np.pi)


def test_the_motors_torque_is_what_was_reported_without_what_measuring_made_of_it():
    motors = np.array([[3.0, -2.0], [1.0, 5.0]])
    reported = motors * [1.0, 1.1] + [0.0, 4.0]
    found = [
        ModelEffect("torque_constant", ("b",), {"scale_error": 0.1}),
        ModelEffect("payload", (), {"mass": 3.0}),
        ModelEffect("torque_offset", ("b",), {"offset": 4.0}),
    ]
    np.testing.assert_allclose(at_motors(found, ("a", "b"), reported), motors)
