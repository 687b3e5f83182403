"""Velocity of positions that are rounded, as many recorders leave them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.estimation.filtering import FilterSettings, motions

_RATE = 500.0


def _move_and_creep(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, position and velocity (S, 1): moves of up to 1 rad/s, between which the joint creeps."""
    from scipy.integrate import cumulative_trapezoid
    from scipy.ndimage import gaussian_filter1d

    rng = np.random.default_rng(seed)
    t = np.arange(int(20 * _RATE)) / _RATE
    steps = np.repeat(rng.uniform(-1, 1, 20) * (np.arange(20) % 2 == 0), int(_RATE))
    speed = gaussian_filter1d(steps, 0.05 * _RATE) + 5e-4 * np.sin(2 * np.pi * 0.2 * t)
    return t, cumulative_trapezoid(speed, t, initial=0.0)[:, None], speed[:, None]


def _error(log, speed: np.ndarray, settings: FilterSettings) -> tuple[np.ndarray, np.ndarray]:
    """Error of the velocity where the joint creeps, and where it moves."""
    (motion,) = motions(log, settings, reduce=False)
    inside = slice(2 * motion.edge, -2 * motion.edge)
    at = np.searchsorted(log.t, motion.time[inside] - 1e-9)
    error, moves = (motion.qd[inside] - speed[at])[:, 0], np.abs(speed[at, 0]) > 0.05
    return error[~moves], error[moves]


def test_rounded_positions_creep_where_the_joint_creeps(arm, make_log, monkeypatch):
    robot = arm(1)
    t, position, speed = _move_and_creep()
    log = make_log(robot, t, np.round(position, 4), None)
    quiet, moving = _error(log, speed, FilterSettings(10.0))
    monkeypatch.setattr("agent.estimation.filtering._AUDIBLE", np.inf)
    plain, moving_plain = _error(log, speed, FilterSettings(10.0))
    assert np.std(quiet) < 0.65 * np.std(plain)
    assert np.std(moving) < 1.1 * np.std(moving_plain)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), cutoff=st.sampled_from([10.0, 20.0, 30.0]))
def test_exact_positions_keep_their_velocity(arm, make_log, seed, cutoff):
    t, position, speed = _move_and_creep(seed)
    error = np.concatenate(_error(make_log(arm(1), t, position, None), speed, FilterSettings(cutoff)))
    assert np.abs(error).max() < 2e-4  # of 1 rad/s: what the trapezoids leave


@pytest.mark.parametrize("digits", [3, 4, 5])
def test_rounding_never_makes_a_velocity_worse_than_its_noise(arm, make_log, digits):
    t, position, speed = _move_and_creep(1)
    creeping, moving = _error(make_log(arm(1), t, np.round(position, digits), None), speed, FilterSettings(10.0))
    noise = 10.0**-digits / np.sqrt(12) * np.sqrt(8 * np.pi**2 / 3 * 45.0**3 / _RATE)
    assert np.std(np.concatenate([creeping, moving])) < 1.2 * noise + 1e-3
