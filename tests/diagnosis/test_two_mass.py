"""Rotor and link on a spring stay finite in every posture."""

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
        time=time,
        q=time[:, None],
        link_load=100 * np.sin(9 * time)[:, None],
        link_slope=200 * np.cos(9 * time)[:, None, None],
        mass=inertia[:, None, None],
    )
    stiffness, damping = np.array([5.0 * (2 * np.pi * 36) ** 2] * 2), np.array([0.04, 0.12])
    with np.errstate(all="raise", under="ignore"):
        (found,) = leads([motion], np.array([0, 0]), stiffness, np.array([gap, gap]), damping)
    assert np.abs(found[0]).max() < 1e4, "the spring carries the load, and rings at most"


def plainly(impulse, slope, mobility, column, followed, spring, loss, half, twist, step, substeps, period):
    """The definition, link by link."""
    torque, second, twisted = np.empty((3, len(column), len(impulse)), dtype=np.float32)
    for k, place in enumerate(column):
        momentum = speed = 0.0
        angle = twist[k]
        for s, (pushes, falls, moves) in enumerate(
            zip(impulse[:, place], slope[:, place], mobility[:, place], strict=True)
        ):
            before, inverse = momentum, min(moves, followed[k])
            falls = np.clip(falls, -0.5 * spring[k], 0.5 * spring[k])
            critical = 2 * np.sqrt(step * spring[k] * inverse)
            forgetting = min(critical, 8 * step / ((s + 1) * period))
            taken = min(max(loss[k] * inverse, forgetting), 1)
            for _ in range(substeps):
                beyond = angle - np.clip(angle, -half[k], half[k]) if half.any() else angle
                if beyond != 0:  # the teeth touch
                    momentum *= 1 - taken
                if half.any():
                    momentum = momentum + pushes - angle * falls - beyond * spring[k]
                else:
                    momentum = momentum + pushes - angle * (falls + spring[k])
                angle += step * inverse * momentum
            torque[k, s] = (momentum - before) / period + angle * falls / step
            fast = momentum * inverse
            second[k, s] = (fast - speed) / period
            speed, twisted[k, s] = fast, angle
    return torque, second, twisted


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 70), st.booleans())
def test_links_integrated_together_move_as_each_alone(seed, links, play):
    rng = np.random.default_rng(seed)
    column, period, substeps = rng.integers(0, 2, links), 0.002, int(rng.integers(2, 5))
    step = period / substeps
    impulse, slope = step * rng.normal(0, 50, (30, 2)), step * rng.normal(0, 300, (30, 2))
    mobility = 1 / rng.uniform(0.1, 9, (30, 2))
    k, c = rng.uniform(1e3, 1e5, links), rng.uniform(1, 40, links)
    half, twist = play * rng.uniform(0, 1e-3, links), rng.normal(0, 1e-3, links)
    followed = 1 / np.maximum(step**2 * k, step * c)
    arguments = impulse, slope, mobility, column, followed, step * k, step * c, half, twist, step, substeps, period
    for found, wanted in zip(driven_through_play(*arguments), plainly(*arguments), strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("slope", [-1500.0, 0.0, 800.0])
def test_a_link_starts_in_equilibrium_and_forgets_a_wrong_start(slope):
    """k d = L − s d at standstill. The first sample's load is an edge, and nothing damps the ringing it would start."""
    stiffness, load, time = 4000.0, np.full(1000, 20.0), np.arange(1000) / 500
    load[0] = 90.0
    motion = SimpleNamespace(
        time=time,
        q=time[:, None],
        link_load=load[:, None],
        link_slope=np.full((1000, 1, 1), slope),
        mass=np.full((1000, 1, 1), 5.0),
    )
    ((felt, _, lead),) = leads([motion], np.array([0]), np.array([stiffness]), np.zeros(1), np.array([1e-6]))
    assert lead[-100:, 0] == pytest.approx(20.0 / (stiffness + slope), rel=5e-3)
    assert felt[-100:, 0] == pytest.approx(20.0 * slope / (stiffness + slope), abs=0.2)
