"""The law by which a JointTrajectoryController joins points that have positions, velocities and accelerations.

Between two points a and b, with d = t_b − t_a, s = t − t_a and e = p_b − p_a, each joint follows the quintic

    p(s) = p_a + v_a s + a_a/2 s² + c₃ s³ + c₄ s⁴ + c₅ s⁵
    c₃ = ( 20 e − (8 v_b + 12 v_a) d − (3 a_a − a_b) d²) / (2 d³)
    c₄ = (−30 e + (14 v_b + 16 v_a) d + (3 a_a − 2 a_b) d²) / (2 d⁴)
    c₅ = ( 12 e − 6 (v_a + v_b) d − (a_a − a_b) d²) / (2 d⁵)

as in joint_trajectory_controller of ros2_controllers (trajectory.cpp, Humble to Kilted).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

#: A quintic from rest to rest over e in T seconds: peak speed 15/8 e/T, peak acceleration 10/√3 e/T².
PEAK_SPEED, PEAK_ACCELERATION = 15 / 8, 10 / np.sqrt(3)


@dataclass(frozen=True, eq=False)
class JointSpline:
    """Points at times t (K,) [s], the first at 0: q, qd and qdd (K, n)."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.t[-1])

    def stretched(self, factor: float) -> JointSpline:
        """The same path, slower by the factor."""
        return JointSpline(self.t * factor, self.q, self.qd / factor, self.qdd / factor**2)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, qd, qdd (S, n) at times t (S,); stationary before and after."""
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = (np.clip(t, 0.0, self.t[-1]) - self.t[k])[:, None]
        c0, c1, c2, c3, c4, c5 = (c[k] for c in self._coefficients)
        q = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
        q[t >= self.t[-1]] = self.q[-1]  # to the last digit: a motion that begins there has no way to go
        qd = c1 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))
        return q, qd, 2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))

    @cached_property
    def _coefficients(self) -> tuple[np.ndarray, ...]:
        d, e = np.diff(self.t)[:, None], np.diff(self.q, axis=0)
        (va, vb), (aa, ab) = ((rows[:-1], rows[1:]) for rows in (self.qd, self.qdd))
        c3 = (20 * e - (8 * vb + 12 * va) * d - (3 * aa - ab) * d**2) / (2 * d**3)
        c4 = (-30 * e + (14 * vb + 16 * va) * d + (3 * aa - 2 * ab) * d**2) / (2 * d**4)
        c5 = (12 * e - 6 * (va + vb) * d - (aa - ab) * d**2) / (2 * d**5)
        return self.q[:-1], va, aa / 2, c3, c4, c5


def rest_to_rest(start: np.ndarray, end: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> JointSpline:
    """One quintic from rest to rest (n,) that keeps these limits (n,) [rad/s, rad/s²]; at least half a second."""
    way = np.abs(end - start)
    seconds = max(0.5, np.max(PEAK_SPEED * way / velocity), np.sqrt(np.max(PEAK_ACCELERATION * way / acceleration)))
    nothing = np.zeros((2, len(start)))
    return JointSpline(np.array([0.0, seconds]), np.array([start, end]), nothing, nothing)
