"""Samples of a path run through by a time law, and how far over their limits they are: the loops of `agent.motion.fly`.

Every number is worked out by the same operations in the same order as arrays would be, whatever the compiler.
"""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8[:,::1](f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8)")
def moving_average_law(
    t: np.ndarray,
    times: np.ndarray,
    s: np.ndarray,
    speed: np.ndarray,
    acceleration: np.ndarray,
    integral: np.ndarray,
    window: float,
    stretch: float,
) -> np.ndarray:
    """(3, S) s, ṡ and s̈ of a law of constant accelerations, averaged over a window.

    The law is stationary outside its times.

    Args:
        t: (S,) growing times.
        times: (K,) of the law.
        s: (K,) parameter at these times.
        speed: (K,) ṡ.
        acceleration: (K - 1,) s̈ of the cells between.
        integral: (K,) of s.
        window: [s].
        stretch: factor on the law's time.
    """
    means = np.empty((3, len(t)))
    last, end = len(times) - 1, times[-1]
    for part in range(2):
        cell = 0
        for k in range(len(t)):
            at = t[k] / stretch - part * window
            while cell < last - 1 and times[cell + 1] <= at:
                cell += 1
            dt = min(max(at, 0.0), end) - times[cell]
            v, a = speed[cell], acceleration[cell]
            area = integral[cell] + dt * (s[cell] + dt * (0.5 * v + a * dt / 6.0)) + max(at - end, 0.0) * s[-1]
            travelled, rate = s[cell] + dt * (v + 0.5 * a * dt), v + a * dt
            if part == 0:
                means[0, k], means[1, k], means[2, k] = area, travelled, rate
            else:
                means[0, k] = (means[0, k] - area) / window
                means[1, k] = (means[1, k] - travelled) / window / stretch
                means[2, k] = (means[2, k] - rate) / window / (stretch * stretch)
    return means


@compiled("f8[:,:,::1](f8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1], i8)")
def evaluate_spline(
    knots: np.ndarray,
    coefficients: np.ndarray,
    s: np.ndarray,
    speed: np.ndarray,
    acceleration: np.ndarray,
    joints: int,
) -> np.ndarray:
    """(3, n + 7, S) joints and TCP with first and second derivative by time. The quaternion's value is made a unit.

    Args:
        knots: (K,) parameters.
        coefficients: (4, n + 7, K - 1) of the cells from each knot on, highest power first; the last four rows are a
            quaternion.
        s: (S,) parameter since the first knot.
        speed: (S,) ṡ.
        acceleration: (S,) s̈.
        joints: n.
    """
    rows, count = coefficients.shape[1], len(s)
    samples = np.empty((3, rows, count))
    cells, x = np.empty(count, dtype=np.int64), np.empty(count)
    cell = 0
    for k in range(count):
        at = s[k] + knots[0]
        while cell < len(knots) - 2 and knots[cell + 1] <= at:
            cell += 1
        cells[k], x[k] = cell, at - knots[cell]
    for row in range(rows):
        cubic, square, linear, constant = (
            coefficients[0, row],
            coefficients[1, row],
            coefficients[2, row],
            coefficients[3, row],
        )
        for k in range(count):
            cell, along = cells[k], x[k]
            bent = cubic[cell] * along
            chord = square[cell] + bent
            rate = (chord * 2.0 + bent) * along + linear[cell]
            samples[0, row, k] = (chord * along + linear[cell]) * along + constant[cell]
            curved = (bent * 2.0 + chord) * (2.0 * speed[k] * speed[k])
            samples[2, row, k] = rate * acceleration[k] + curved
            samples[1, row, k] = rate * speed[k]
    quaternion = samples[0, joints + 3 :]
    for k in range(count):
        size = np.sqrt(
            quaternion[0, k] * quaternion[0, k]
            + quaternion[1, k] * quaternion[1, k]
            + quaternion[2, k] * quaternion[2, k]
            + quaternion[3, k] ** 2
        )
        for row in range(4):
            quaternion[row, k] /= size
    return samples


@compiled("f8(f8, f8)")
def _larger(first: float, other: float) -> float:
    """Return the larger value; NaN if either is NaN."""
    return first if first >= other or first != first else other


@compiled("void(f8[::1], f8[::1], f8)")
def _raise_to(largest: np.ndarray, values: np.ndarray, limit: float) -> None:
    """Raise `largest` (S,) to the share of a limit that values (S,) use."""
    for k in range(len(values)):
        largest[k] = _larger(largest[k], np.abs(values[k]) / limit)


@compiled("f8[:,::1](f8[:,:,::1], i8)")
def tcp_rates(out: np.ndarray, joints: int) -> np.ndarray:
    """(4, S) linear [m/s] and rotational speed [rad/s], linear and rotational acceleration of the TCP.

    out (3, n + 7, S) as of `evaluate_spline`.
    """
    rates = np.empty((4, out.shape[2]))
    quaternion, rate, change = out[0, joints + 3 :], out[1, joints:], out[2, joints:]
    for k in range(out.shape[2]):
        rates[0, k] = np.sqrt(rate[0, k] * rate[0, k] + rate[1, k] * rate[1, k] + rate[2, k] * rate[2, k])
        rates[2, k] = np.sqrt(change[0, k] * change[0, k] + change[1, k] * change[1, k] + change[2, k] * change[2, k])
        turning = along = twisting = 0.0
        for row in range(4):
            turning += rate[row + 3, k] * rate[row + 3, k]
            along += quaternion[row, k] * change[row + 3, k]
            twisting += change[row + 3, k] * change[row + 3, k]
        rates[1, k] = np.sqrt(4.0 * turning)
        rates[3, k] = np.sqrt(4.0 * np.maximum(twisting - along * along, 0.0))
    return rates


@compiled("f8[:,::1](f8[::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def time_stretch_factors(
    knots: np.ndarray,
    ceilings: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    speeds: np.ndarray,
    accelerations: np.ndarray,
    jerks: np.ndarray,
    over_three: np.ndarray,
) -> np.ndarray:
    """(2, S) the factor by which time has to be stretched for speed and acceleration, and how full the jerk is.

    Args:
        knots: (K,) parameters.
        ceilings: (4, K) of the TCP's linear and rotational speed, then acceleration, each on the cell before its knot.
        s: (S,) parameter since the first knot.
        out: (3, n + 7, S) as of `evaluate_spline`.
        speeds: (n,) of the joints.
        accelerations: (n,).
        jerks: (n,) changes of acceleration a sample.
        over_three: (n,) third differences of position.
    """
    joints, count = len(speeds), len(s)
    full, rates = np.empty((2, count)), tcp_rates(out, joints)
    rule = 0
    for k in range(count):
        at = s[k] + knots[0]
        while rule < len(knots) - 1 and knots[rule] < at:
            rule += 1
        full[0, k] = _larger(rates[0, k] / ceilings[0, rule], rates[1, k] / ceilings[1, rule])
        full[1, k] = _larger(rates[2, k] / ceilings[2, rule], rates[3, k] / ceilings[3, rule])
    speed, change = full[0], full[1]
    for joint in range(joints):
        _raise_to(speed, out[1, joint], speeds[joint])
        _raise_to(change, out[2, joint], accelerations[joint])
    for k in range(count):
        speed[k] = _larger(speed[k], np.sqrt(change[k]))
    jerk, steps = full[1], np.empty(count)
    jerk[:] = 0.0
    for joint in range(joints):
        q, qdd = out[0, joint], out[2, joint]
        steps[0] = qdd[0]
        steps[1:] = qdd[1:] - qdd[:-1]
        _raise_to(jerk, steps, jerks[joint])
        if count > 3:
            first, second, third = q[1:] - q[:-1], steps[: count - 2], steps[: count - 3]
            second[:] = first[1:] - first[:-1]
            third[:] = second[1:] - second[:-1]
            _raise_to(jerk[2:-1], third, over_three[joint])
    return full
