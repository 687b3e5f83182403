"""The curve of a hose passes through its torques, and goes on straight."""

import numpy as np
from hypothesis import given, strategies as st

from agent.model.effects.dress_pack import N_NODES, _curve


@given(st.floats(-3.0, 3.0), st.floats(0.1, 6.0), st.integers(0, 2**32 - 1))
def test_a_curve_passes_through_its_values_and_goes_on_smoothly(low, width, seed):
    high = low + width
    values = np.random.default_rng(seed).standard_normal((N_NODES, 3))

    def at(places: np.ndarray) -> np.ndarray:
        return np.transpose(_curve(places, low, high)) @ values

    np.testing.assert_allclose(at(np.linspace(low, high, N_NODES)), values, atol=1e-9)
    steps = np.linspace(0.0, 0.5, 6)
    for end, beyond in ((low, low - steps), (high, high + steps)):
        step = np.sign(beyond[1] - end) * 1e-6
        slope = (at(np.array([end, end - step])) * [[1], [-1]]).sum(axis=0) / step
        expected = at(beyond)[0] + (beyond - end)[:, None] * slope
        np.testing.assert_allclose(at(beyond), expected, atol=1e-4 * max(1.0, np.abs(slope).max()))
