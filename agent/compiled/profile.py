"""Speed along a path, limits as they are: the loops of `agent.motion.fly.profile`."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8[:,::1](f8[::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1])")
def speed_change_sums(
    ceiling: np.ndarray, joints: np.ndarray, tool: np.ndarray, steps: np.ndarray, part: np.ndarray
) -> np.ndarray:
    """(n + t, K) sums of what the squares of speeds may change by from knot to knot.

    The curve takes its part of a limit; the sum of squares is the limit's.

    Args:
        ceiling: (K,) of ṡ².
        joints: (n, K - 1) changes that the joints' accelerations allow.
        tool: (3, t, K) of each limit of the TCP what the path bends, the limit, and what ramps may take of it on
            a straight.
        steps: (t, K - 1) along the path.
        part: (K - 1,) that overrides leave.
    """
    (count, cells), limits = joints.shape, len(steps)
    total, along = np.zeros((count + limits, cells + 1)), np.empty(cells + 1)
    for row in range(count):
        for k in range(cells):
            total[row, k + 1] = total[row, k] + joints[row, k] * part[k]
    for row in range(limits):
        for k in range(cells + 1):
            bent = tool[0, row, k] * ceiling[k] / tool[1, row, k]
            along[k] = np.sqrt(max(1.0 - bent * bent, 0.0)) * tool[2, row, k]
        for k in range(cells):
            change = 2.0 * min(along[k + 1], along[k]) * steps[row, k]
            total[count + row, k + 1] = total[count + row, k] + change * part[k]
    return total


@compiled("f8[::1](f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], i8)")
def fastest_profile(  # noqa: C901
    ceiling: np.ndarray,
    weight: np.ndarray,
    rising: np.ndarray,
    falling: np.ndarray,
    least: np.ndarray,
    passes: int,
) -> np.ndarray:
    """The largest z (K,), zero at its ends, for which y = weight z (m, K) respects the limits of its rise and fall.

    The passes end once one changes z by at most 1e-4 of its largest.

    Args:
        ceiling: (K,) of z.
        weight: (m, K).
        rising: (m, K) limits of the rise, see `speed_change_sums`.
        falling: (m, K) limits of the fall.
        least: (m,) a y up to this is not limited.
        passes: largest number of passes.
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
def widen_dips(s: np.ndarray, ceiling: np.ndarray, window: float) -> np.ndarray:
    """Ceiling of ṡ² (K,) in which each dip is extended by half a window's distance to either side.

    Args:
        s: (K,) parameters.
        ceiling: (K,) of ṡ² there.
        window: [s].
    """
    wide = ceiling.copy()
    for k in range(1, len(s) - 1):
        if ceiling[k] <= ceiling[k - 1] and ceiling[k] < ceiling[k + 1]:
            half = 0.5 * window * np.sqrt(ceiling[k])
            first, last = np.searchsorted(s, s[k] - half), np.searchsorted(s, s[k] + half)
            for other in range(first, last):
                wide[other] = min(wide[other], ceiling[k])
    return wide


@compiled("f8[:,::1](f8[::1], f8[::1])")
def time_law(s: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(4, K) time, speed, acceleration up to the next knot and integral of s - s₀, with z = ṡ² linear between knots."""
    law = np.zeros((4, len(s)))
    time, speed, acceleration, integral = law[0], law[1], law[2], law[3]
    for k in range(len(s)):
        speed[k] = np.sqrt(z[k])
    for k in range(len(s) - 1):
        travelled, v = s[k] - s[0], speed[k]
        dt = 2.0 * (s[k + 1] - s[k]) / (speed[k + 1] + v)
        a = (speed[k + 1] - v) / dt
        time[k + 1], acceleration[k] = time[k] + dt, a
        integral[k + 1] = integral[k] + dt * (travelled + dt * (0.5 * v + a * dt / 6.0))
    return law


@compiled("f8[::1](f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, i8)")
def lower_ceiling(
    ceiling: np.ndarray,
    knots: np.ndarray,
    s: np.ndarray,
    speed: np.ndarray,
    stretch: np.ndarray,
    allowed: float,
    half: int,
) -> np.ndarray:
    """(K,) the ceiling at the knots, lowered to what samples need that stretch time too much.

    Args:
        ceiling: (K,) of ṡ².
        knots: (K,) parameters.
        s: (S,) parameters of the samples.
        speed: (S,) ṡ.
        stretch: (S,) factor by which a sample stretches time.
        allowed: largest factor.
        half: samples before and after each that are lowered too.
    """
    lowest = np.full(len(s), np.inf)
    for k in range(len(s)):
        if stretch[k] > allowed:
            needed = speed[k] / (1.002 * max(stretch[k], 1.0))
            for other in range(max(k - half, 0), min(k + half + 1, len(s))):
                lowest[other] = min(lowest[other], needed * needed)
    # A sample that breaks a limit as the arm sets off says nothing about the speed; the minimum keeps the arm moving.
    floor = 1e-6 * np.max(ceiling)
    lower = ceiling.copy()
    for k in range(len(knots)):
        after = min(max(np.searchsorted(s, knots[k] - knots[0]), 1), len(s) - 1)
        lower[k] = min(ceiling[k], max(min(lowest[after], lowest[after - 1]), floor))
    return lower
