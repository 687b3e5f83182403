import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from agent.motion.trajectory import Trajectory


@pytest.fixture(scope="session")
def trajectory_through():
    """A function (knots (K, n), duration [s]) → Trajectory at 2 ms through the knots, from rest to rest."""

    def build(knots, duration: float = 5.0) -> Trajectory:
        knots = np.asarray(knots, dtype=float)
        t = np.arange(0.0, duration + 1e-9, 0.002)
        spline = CubicSpline(np.linspace(0, t[-1], len(knots)), knots, bc_type="clamped")
        q, qd, qdd = spline(t), spline(t, 1), spline(t, 2)
        unknown = np.full(len(t), np.nan)
        return Trajectory(t, q, qd, qdd, np.full((len(t), 4, 4), np.nan), unknown, np.zeros(len(t), dtype=int))

    return build
