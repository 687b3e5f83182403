"""One meaning of standstill, and one map of regimes, for estimation, diagnosis, drift and pages."""

import numpy as np
from hypothesis import given, strategies as st

from agent.model.regimes import REGIMES, regime_masks, standstill_speed

ABLE = np.array([2.0, 4.0, 4.0])  # rad/s


def test_a_parked_joint_takes_its_regime_from_the_arms_speed():
    time = np.linspace(0, 10, 500)[:, None]
    speed = np.hstack([np.sin(time), 2 * np.cos(3 * time), 1e-4 * np.cos(time)])
    slowest = standstill_speed([speed], ABLE)
    assert np.allclose(slowest[:2], 0.004 * np.abs(speed).max(axis=0)[:2])
    assert slowest[2] > 1e-4, "what trembles while the others move stands"
    assert np.all(standstill_speed([0 * speed], ABLE) > 0), "round-off is no motion"


@given(st.floats(0.1, 10), st.integers(0, 100))
def test_regimes_do_not_depend_on_units_and_thirds_cover_the_range(scale, seed):
    rng = np.random.default_rng(seed)
    q, speed, acceleration, load = rng.normal(size=(4, 300)).cumsum(axis=1)
    found = regime_masks(q, speed, acceleration, load, 0.01, 100.0)
    scaled = regime_masks(scale * q, scale * speed, scale * acceleration, load, scale * 0.01, 100.0)
    assert tuple(found) == REGIMES
    for name in set(REGIMES) - {"position_low", "position_middle", "position_high"}:
        assert np.array_equal(found[name], scaled[name])
    thirds = [found[f"position_{part}"] for part in ("low", "middle", "high")]
    assert np.all(np.sum(thirds, axis=0) == 1)
    assert not np.any(found["standstill"] & (found["low_speed"] | found["reversal"] | found["high_speed"]))
