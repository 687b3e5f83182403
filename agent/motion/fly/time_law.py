"""From speed along the path to set-points in time, with jerk-limited ramps.

The speed profile of `profile` changes its acceleration in steps. Averaged over a window of T seconds,

    s_T(t) = 1/T ∫ s from t − T to t,

position, speed and acceleration along the path are averages of allowed ones, and the jerk is at most the step of the
acceleration over T. The path itself is untouched: only the way it is run through is smoothed. Because the window also
moves along the path, limits can be broken a little; then the ceiling is lowered where that happens, and at last the
time of the run is stretched by what is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from agent.compiled import averaged, law_at
from agent.motion.path.geometry import Path


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """s over time. Knots: t, s, speed (K,), acceleration per cell (K - 1,), integral of s (K,); window and stretch."""

    t: np.ndarray
    s: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    integral: np.ndarray
    window: float
    stretch: float = 1.0

    @property
    def duration(self) -> float:
        """[s]"""
        return float((self.t[-1] + self.window) * self.stretch)

    def sample(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """s, ṡ, s̈ (S,) at times t (S,) [s] since the start of the run, in growing order; at rest outside of it."""
        s, speed, acceleration = averaged(
            t, self.t, self.s, self.speed, self.acceleration, self.integral, self.window, self.stretch
        )
        return s, speed, acceleration


def time_law(path: Path, z: np.ndarray, window: float) -> TimeLaw:
    """The run through `path` with z = ṡ² (K,) at the knots, linear in between, averaged over `window` [s]."""
    time, speed, acceleration, integral = law_at(path.s, z)
    return TimeLaw(time, path.s - path.s[0], speed, acceleration[:-1], integral, window)


def samples_in(edges: np.ndarray, samples: np.ndarray, side: Literal["left", "right"]) -> np.ndarray:
    """(E + 1,) how many of the samples (S,) lie before, between and after the edges (E,), both in growing order.

    A sample on an edge counts after it (`left`) or before it (`right`), as in `np.searchsorted`.
    """
    ends = np.empty(len(edges) + 2, dtype=np.intp)
    ends[0], ends[-1] = 0, len(samples)
    ends[1:-1] = np.searchsorted(samples, edges, side=side)
    return ends[1:] - ends[:-1]
