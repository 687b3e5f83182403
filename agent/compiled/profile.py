"""Speed along a path, limits as they are: the loops of `agent.motion.fly.profile`."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8[::1](f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], i8)")
def fastest(
    ceiling: np.ndarray,
    weight: np.ndarray,
    rising: np.ndarray,
    falling: np.ndarray,
    least: np.ndarray,
    passes: int,
) -> np.ndarray:
    """(K,) the largest z under `ceiling` (K,), zero at its ends, for which y = weight z (m, K) rises and falls no more.

    rising, falling (m, K): sums of what y may change by from knot to knot. A y up to `least` (m,) is not limited.
    Passes are made until none changes z by more than 1e-4 of its largest, `passes` at most.
    """
    rows, knots = weight.shape
    inverse, unused = np.empty((rows, knots)), np.empty((rows, knots))
    for row in range(rows):
        for k in range(knots):
            used = weight[row, k] * ceiling[k] > least[row]
            inverse[row, k] = 1.0 / (weight[row, k] if used else 1.0)
            unused[row, k] = 0.0 if used else np.inf
    z = ceiling.copy()
    z[0] = z[-1] = 0.0
    y, before = np.empty(knots), np.empty(knots)
    for _ in range(passes):
        before[:] = z
        lowered = z.copy()
        for row in range(rows):
            for k in range(knots):
                y[k] = weight[row, k] * z[k] - rising[row, k]
            lowest = 0.0
            for k in range(1, knots):
                lowest = y[k] if y[k] < lowest else lowest
                y[k] = lowest
            y[0] = 0.0
            for k in range(knots):
                allowed = max(y[k] + rising[row, k], 0.0) * inverse[row, k] + unused[row, k]
                lowered[k] = allowed if allowed < lowered[k] else lowered[k]
        z[:] = lowered
        for row in range(rows):
            for k in range(knots):
                y[k] = weight[row, k] * z[k] + falling[row, k]
            lowest = np.inf
            for k in range(knots - 1, -1, -1):
                lowest = y[k] if y[k] < lowest else lowest
                y[k] = lowest
            for k in range(knots):
                allowed = max(y[k] - falling[row, k], 0.0) * inverse[row, k] + unused[row, k]
                lowered[k] = allowed if allowed < lowered[k] else lowered[k]
        z[:] = lowered
        change = largest = 0.0
        for k in range(knots):
            change = max(change, before[k] - z[k])
            largest = max(largest, z[k])
        if change <= 1e-4 * largest:
            break
    return z


@compiled("f8[::1](f8[::1], f8[::1], f8)")
def held(s: np.ndarray, ceiling: np.ndarray, window: float) -> np.ndarray:
    """(K,) the ceiling of ṡ² at places s (K,), with every dip held as far as half a window's way around it."""
    wide = ceiling.copy()
    for k in range(1, len(s) - 1):
        if ceiling[k] <= ceiling[k - 1] and ceiling[k] < ceiling[k + 1]:
            half = 0.5 * window * np.sqrt(ceiling[k])
            first, last = np.searchsorted(s, s[k] - half), np.searchsorted(s, s[k] + half)
            for other in range(first, last):
                wide[other] = min(wide[other], ceiling[k])
    return wide
