"""The regressor of a serial arm: recursive Newton-Euler, taken apart by inertial parameter."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8[:,:,::1](f8[:,:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[::1], f8[:,:], f8[:,:], f8[:,:])")
def regressor_columns(
    rotations: np.ndarray,
    origins: np.ndarray,
    axes: np.ndarray,
    prismatic: np.ndarray,
    gravity: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
) -> np.ndarray:
    """(n, 10 n, S) torque of each joint by each standard parameter: m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz of each link.

    A link with acceleration a of its origin, angular velocity w and acceleration α needs there the force
    m a + α × mc + w × (w × mc) and the moment mc × a + I α + w × I w, all in its frame; a joint that moves it at u
    about, and l along, gives l · force + u · moment (Siciliano et al., Robotics, 2009, 7.5).

    Args:
        rotations: (n, 3, 3) of each joint's frame in the one before, at q = 0.
        origins: (n, 3) of the frames.
        axes: (n, 3) of the joints, in their own frames.
        prismatic: (n,) bool.
        gravity: (3,) [m/s²].
        q: (S, n) positions.
        qd: (S, n) velocities.
        qdd: (S, n) accelerations.
    """
    samples, joints = q.shape
    columns = np.zeros((joints, 10 * joints, samples))
    to_base, about, along = np.empty((3, 3)), np.empty((joints, 3)), np.empty((joints, 3))
    for k in range(samples):
        w0 = w1 = w2 = 0.0
        d0 = d1 = d2 = 0.0  # α
        a0, a1, a2 = -gravity[0], -gravity[1], -gravity[2]
        for link in range(joints):
            s0, s1, s2 = axes[link]
            p0, p1, p2 = origins[link]
            at, rate, change = q[k, link], qd[k, link], qdd[k, link]
            slides = prismatic[link]
            if slides:
                # The sliding frame's origin moves along the axis by the joint position.
                x0, x1, x2 = at * s0, at * s1, at * s2
                p0 += rotations[link, 0, 0] * x0 + rotations[link, 0, 1] * x1 + rotations[link, 0, 2] * x2
                p1 += rotations[link, 1, 0] * x0 + rotations[link, 1, 1] * x1 + rotations[link, 1, 2] * x2
                p2 += rotations[link, 2, 0] * x0 + rotations[link, 2, 1] * x1 + rotations[link, 2, 2] * x2
                to_base[:] = rotations[link]
            else:
                c, s = np.cos(at), np.sin(at)
                v = 1.0 - c
                r00, r01, r02 = c + s0 * s0 * v, s0 * s1 * v - s2 * s, s0 * s2 * v + s1 * s
                r10, r11, r12 = s0 * s1 * v + s2 * s, c + s1 * s1 * v, s1 * s2 * v - s0 * s
                r20, r21, r22 = s0 * s2 * v - s1 * s, s1 * s2 * v + s0 * s, c + s2 * s2 * v
                for row in range(3):
                    x0, x1, x2 = rotations[link, row]
                    to_base[row, 0] = x0 * r00 + x1 * r10 + x2 * r20
                    to_base[row, 1] = x0 * r01 + x1 * r11 + x2 * r21
                    to_base[row, 2] = x0 * r02 + x1 * r12 + x2 * r22
            t00, t01, t02 = to_base[0]
            t10, t11, t12 = to_base[1]
            t20, t21, t22 = to_base[2]
            # The acceleration of the new origin as a point of the link before: a + α × p + w × (w × p).
            reach, size = w0 * p0 + w1 * p1 + w2 * p2, w0 * w0 + w1 * w1 + w2 * w2
            x0 = a0 + d1 * p2 - d2 * p1 + reach * w0 - size * p0
            x1 = a1 + d2 * p0 - d0 * p2 + reach * w1 - size * p1
            x2 = a2 + d0 * p1 - d1 * p0 + reach * w2 - size * p2
            a0 = t00 * x0 + t10 * x1 + t20 * x2
            a1 = t01 * x0 + t11 * x1 + t21 * x2
            a2 = t02 * x0 + t12 * x1 + t22 * x2
            w0, w1, w2 = (
                t00 * w0 + t10 * w1 + t20 * w2,
                t01 * w0 + t11 * w1 + t21 * w2,
                t02 * w0 + t12 * w1 + t22 * w2,
            )
            d0, d1, d2 = (
                t00 * d0 + t10 * d1 + t20 * d2,
                t01 * d0 + t11 * d1 + t21 * d2,
                t02 * d0 + t12 * d1 + t22 * d2,
            )
            x0, x1, x2 = (w1 * s2 - w2 * s1) * rate, (w2 * s0 - w0 * s2) * rate, (w0 * s1 - w1 * s0) * rate
            if slides:
                a0, a1, a2 = a0 + s0 * change + 2.0 * x0, a1 + s1 * change + 2.0 * x1, a2 + s2 * change + 2.0 * x2
            else:
                d0, d1, d2 = d0 + s0 * change + x0, d1 + s1 * change + x1, d2 + s2 * change + x2
                w0, w1, w2 = w0 + s0 * rate, w1 + s1 * rate, w2 + s2 * rate
            size = w0 * w0 + w1 * w1 + w2 * w2
            first = 10 * link
            for joint in range(link + 1):
                if joint == link:
                    u0, u1, u2 = (0.0, 0.0, 0.0) if slides else (s0, s1, s2)
                    l0, l1, l2 = (s0, s1, s2) if slides else (0.0, 0.0, 0.0)
                else:
                    y0, y1, y2 = about[joint]
                    x0 = along[joint, 0] + y1 * p2 - y2 * p1
                    x1 = along[joint, 1] + y2 * p0 - y0 * p2
                    x2 = along[joint, 2] + y0 * p1 - y1 * p0
                    u0 = t00 * y0 + t10 * y1 + t20 * y2
                    u1 = t01 * y0 + t11 * y1 + t21 * y2
                    u2 = t02 * y0 + t12 * y1 + t22 * y2
                    l0 = t00 * x0 + t10 * x1 + t20 * x2
                    l1 = t01 * x0 + t11 * x1 + t21 * x2
                    l2 = t02 * x0 + t12 * x1 + t22 * x2
                about[joint, 0], about[joint, 1], about[joint, 2] = u0, u1, u2
                along[joint, 0], along[joint, 1], along[joint, 2] = l0, l1, l2
                reach = w0 * l0 + w1 * l1 + w2 * l2
                x0, x1, x2 = u1 * w2 - u2 * w1, u2 * w0 - u0 * w2, u0 * w1 - u1 * w0
                of = columns[joint]
                of[first, k] = l0 * a0 + l1 * a1 + l2 * a2
                of[first + 1, k] = l1 * d2 - l2 * d1 + reach * w0 - size * l0 + a1 * u2 - a2 * u1
                of[first + 2, k] = l2 * d0 - l0 * d2 + reach * w1 - size * l1 + a2 * u0 - a0 * u2
                of[first + 3, k] = l0 * d1 - l1 * d0 + reach * w2 - size * l2 + a0 * u1 - a1 * u0
                of[first + 4, k] = u0 * d0 + x0 * w0
                of[first + 5, k] = u0 * d1 + u1 * d0 + x0 * w1 + x1 * w0
                of[first + 6, k] = u1 * d1 + x1 * w1
                of[first + 7, k] = u0 * d2 + u2 * d0 + x0 * w2 + x2 * w0
                of[first + 8, k] = u1 * d2 + u2 * d1 + x1 * w2 + x2 * w1
                of[first + 9, k] = u2 * d2 + x2 * w2
    return columns
