"""When samples were taken that are neither even nor stamped well, by recorded positions and velocities.

From one sample to the next each joint moves by its mean velocity times the time between them, so joints that move
together tell that time, each as well as its step follows from its velocity otherwise. Where nothing moves the mean
interval stands in. What adds up over many intervals is held by the stamps:

    Σ ((t_i - stamp_i) / σ)² + Σ ((t_{i+1} - t_i - Δ_i) / σ_i)² is least.
"""

from __future__ import annotations

import numpy as np

_ROUNDS = 3  # of weights of the joints


def taken_at(stamps: np.ndarray, even: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray | None:
    """(S,) [s] rising, from stamps (S,), what they are on an even grid (S,), positions and velocities (S, n).

    None where fewer than two joints move, so that none bears out another, or where no times rise.
    """
    from scipy.linalg import solveh_banded

    usual = np.diff(even)
    moving = [j for j in range(position.shape[1]) if np.ptp(position[:, j]) > 0 and np.ptp(velocity[:, j]) > 0]
    if len(moving) < 2 or len(stamps) < 3:
        return None
    late = max(float(np.var(stamps - even)), 1e-18)
    interval, precision = usual, np.zeros_like(usual)
    for _ in range(_ROUNDS):
        precision = np.full_like(usual, 0.5 / late)
        total = usual * precision
        for j in moving:
            step, mean = np.diff(position[:, j]), (velocity[1:, j] + velocity[:-1, j]) / 2
            certain = 1 / max(float(np.mean((step - mean * interval) ** 2)), 1e-18)
            total += certain * mean * step
            precision += certain * mean**2
        interval = total / precision
    banded = np.zeros((2, len(stamps)))
    banded[0, 1:] = -precision
    banded[1] = 1 / late
    banded[1, :-1] += precision
    banded[1, 1:] += precision
    pull = stamps / late
    pull[:-1] -= precision * interval
    pull[1:] += precision * interval
    times = solveh_banded(banded, pull)
    return times if np.all(np.diff(times) > 0) else None
