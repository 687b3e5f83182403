"""Splines pass through their values, and natural ones go on straight."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core import CubicSplines


@pytest.mark.parametrize("natural", [False, True])
@given(seed=st.integers(0, 2**32 - 1), knots=st.integers(4, 40))
def test_a_spline_passes_through_its_values_and_goes_on_smoothly(natural, seed, knots):
    rng = np.random.default_rng(seed)
    at = np.cumsum(rng.uniform(0.1, 1.0, knots))
    values = rng.standard_normal((knots, 3))
    np.testing.assert_allclose(CubicSplines(at, values, natural)(at), values, atol=1e-9)
    steps = np.linspace(0.0, 0.5, 6)
    for end, beyond in ((at[0], at[0] - steps), (at[-1], at[-1] + steps)):
        found = CubicSplines(at, values, natural)(beyond)
        if natural:  # straight, with the slope at the end
            step = np.sign(beyond[1] - end) * 1e-6
            slope = (CubicSplines(at, values, True)(np.array([end, end - step])) * [[1], [-1]]).sum(axis=0) / step
            expected = found[0] + (beyond - end)[:, None] * slope
            np.testing.assert_allclose(found, expected, atol=1e-4 * max(1.0, np.abs(slope).max()))
