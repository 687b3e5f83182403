"""Splines of our own against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.interpolate import CubicSpline

from agent.core import cubic_spline


@pytest.mark.parametrize("natural", [False, True])
@given(seed=st.integers(0, 2**32 - 1), knots=st.integers(4, 40))
def test_a_spline_is_scipys(natural, seed, knots):
    rng = np.random.default_rng(seed)
    at = np.cumsum(rng.uniform(0.1, 1.0, knots))
    values = rng.standard_normal((knots, 3))
    places = rng.uniform(at[0] - 0.5, at[-1] + 0.5, 50)
    spline = CubicSpline(at, values, bc_type="natural" if natural else "not-a-knot")
    inside = np.clip(places, at[0], at[-1]) if natural else places
    expected = spline(inside) + (places - inside)[:, None] * spline(inside, 1)
    found = cubic_spline(at, values, places, natural)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
