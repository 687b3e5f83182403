"""Result of an interpolator."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class BindingLimit:
    """A limit that slows the motion down: which (`joint_3 speed`, `linear acceleration`, …), and where [s]."""

    limit: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Set-points at the controller's period. S samples, n joints, SI.

    t (S,); q, qd, qdd (S, n); tcp (S, 4, 4); path_speed (S,) of the TCP [m/s];
    move (S,) index of the statement that a sample belongs to; binding: the limits that slowed it down.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tcp: np.ndarray
    path_speed: np.ndarray
    move: np.ndarray
    binding: tuple[BindingLimit, ...] = field(default=())

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.t[-1] - self.t[0])
