"""A motion on an even grid, as it is weighed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class GridMotion:
    """A motion on an even grid: time (S,) [s], q, qd, qdd (S, n)."""

    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
