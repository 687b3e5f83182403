"""Rotor and link on a spring stay finite in every posture."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.compiled import driven_through_play
from agent.model.effects.two_mass import leads


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_a_link_that_is_light_in_some_posture_does_not_overflow(gap):
    time = np.arange(1500) / 500
    inertia = np.where(np.sin(2 * time) > 0, 10.0, 1e-4)
    motion = SimpleNamespace(
        time=time, q=time[:, None], link_load=100 * np.sin(9 * time)[:, None], mass=inertia[:, None, None]
    )
    stiffness, damping = np.array([5.0 * (2 * np.pi * 36) ** 2] * 2), np.array([0.04, 0.12])
    with np.errstate(all="raise", under="ignore"):
        (found,) = leads([motion], np.array([0, 0]), stiffness, np.array([gap, gap]), damping)
    assert np.abs(found[0]).max() < 1e4, "the spring carries the load, and rings at most"


def plainly(impulse, mobility, column, followed, spring, loss, half, twist, step, substeps, period):
    """The definition, link by link."""
    torque, second = np.empty((2, len(column), len(impulse)), dtype=np.float32)
    for k, place in enumerate(column):
        momentum = speed = 0.0
        angle = twist[k]
        for s, (pushes, moves) in enumerate(zip(impulse[:, place], mobility[:, place], strict=True)):
            before, inverse = momentum, min(moves, followed[k])
            for _ in range(substeps):
                beyond = angle - np.clip(angle, -half[k], half[k]) if half.any() else angle
                if beyond != 0:  # the teeth touch
                    momentum *= 1 - loss[k] * inverse
                momentum = momentum + pushes - beyond * spring[k]
                angle += step * inverse * momentum
            torque[k, s] = (momentum - before) / period
            fast = momentum * inverse
            second[k, s] = (fast - speed) / period
            speed = fast
    return torque, second


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 70), st.booleans())
def test_links_that_take_their_steps_together_move_as_each_alone(seed, links, play):
    rng = np.random.default_rng(seed)
    column, period, substeps = rng.integers(0, 2, links), 0.002, int(rng.integers(2, 5))
    step = period / substeps
    impulse, mobility = step * rng.normal(0, 50, (30, 2)), 1 / rng.uniform(0.1, 9, (30, 2))
    k, c = rng.uniform(1e3, 1e5, links), rng.uniform(1, 40, links)
    half, twist = play * rng.uniform(0, 1e-3, links), rng.normal(0, 1e-3, links)
    followed = 1 / np.maximum(step**2 * k, step * c)
    arguments = impulse, mobility, column, followed, step * k, step * c, half, twist, step, substeps, period
    for found, wanted in zip(driven_through_play(*arguments), plainly(*arguments), strict=True):
        np.testing.assert_array_equal(found, wanted)
