"""An arm behind its servos, step after step: rigid bodies, friction of the axles, cascaded servo.

Bodies and motions as in Featherstone (Rigid Body Dynamics Algorithms, 2008, chapters 5 and 6), but all in the base
frame and about its origin, so that nothing has to be carried from link to link.
"""

from __future__ import annotations

from math import exp, tanh

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8(f8[:,::1], f8[:,::1], i8, i8)")
def _turned(half: np.ndarray, rotation: np.ndarray, row: int, column: int) -> float:
    """An entry of half · turnᵀ."""
    x0, x1, x2 = rotation[column]
    return half[row, 0] * x0 + half[row, 1] * x1 + half[row, 2] * x2


@compiled("void(f8[:,:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,::1])")
def _forward_kinematics(
    rotations: np.ndarray,
    origins: np.ndarray,
    axes: np.ndarray,
    prismatic: np.ndarray,
    inertias: np.ndarray,
    q: np.ndarray,
    scratch: np.ndarray,
    screws: np.ndarray,
    bodies: np.ndarray,
) -> None:
    """Write the joints' `screws` (n, 6) and the links' `bodies` (n, 10) of the arm at q (n,).

    A screw is the angular velocity and the velocity of a point at the base's origin; bodies are about that origin.
    `scratch` (3, 3, 3) is overwritten.
    """
    rotation, fixed, half = scratch[0], scratch[1], scratch[2]
    for row in range(3):
        for k in range(3):
            rotation[row, k] = 1.0 if row == k else 0.0
    o0 = o1 = o2 = 0.0
    for link in range(len(q)):
        p0, p1, p2 = origins[link]
        o0 += rotation[0, 0] * p0 + rotation[0, 1] * p1 + rotation[0, 2] * p2
        o1 += rotation[1, 0] * p0 + rotation[1, 1] * p1 + rotation[1, 2] * p2
        o2 += rotation[2, 0] * p0 + rotation[2, 1] * p1 + rotation[2, 2] * p2
        for row in range(3):
            x0, x1, x2 = rotation[row]
            for k in range(3):
                fixed[row, k] = x0 * rotations[link, 0, k] + x1 * rotations[link, 1, k] + x2 * rotations[link, 2, k]
        s0, s1, s2 = axes[link]
        z0 = fixed[0, 0] * s0 + fixed[0, 1] * s1 + fixed[0, 2] * s2
        z1 = fixed[1, 0] * s0 + fixed[1, 1] * s1 + fixed[1, 2] * s2
        z2 = fixed[2, 0] * s0 + fixed[2, 1] * s1 + fixed[2, 2] * s2
        of = screws[link]
        if prismatic[link]:
            o0, o1, o2 = o0 + z0 * q[link], o1 + z1 * q[link], o2 + z2 * q[link]
            of[0], of[1], of[2], of[3], of[4], of[5] = 0.0, 0.0, 0.0, z0, z1, z2
            rotation[:] = fixed
        else:
            of[0], of[1], of[2] = z0, z1, z2
            of[3], of[4], of[5] = o1 * z2 - o2 * z1, o2 * z0 - o0 * z2, o0 * z1 - o1 * z0
            c, s = np.cos(q[link]), np.sin(q[link])
            v = 1.0 - c
            r00, r01, r02 = c + s0 * s0 * v, s0 * s1 * v - s2 * s, s0 * s2 * v + s1 * s
            r10, r11, r12 = s0 * s1 * v + s2 * s, c + s1 * s1 * v, s1 * s2 * v - s0 * s
            r20, r21, r22 = s0 * s2 * v - s1 * s, s1 * s2 * v + s0 * s, c + s2 * s2 * v
            for row in range(3):
                x0, x1, x2 = fixed[row]
                rotation[row, 0] = x0 * r00 + x1 * r10 + x2 * r20
                rotation[row, 1] = x0 * r01 + x1 * r11 + x2 * r21
                rotation[row, 2] = x0 * r02 + x1 * r12 + x2 * r22
        m, f0, f1, f2, xx, xy, yy, xz, yz, zz = inertias[link]
        c0 = rotation[0, 0] * f0 + rotation[0, 1] * f1 + rotation[0, 2] * f2
        c1 = rotation[1, 0] * f0 + rotation[1, 1] * f1 + rotation[1, 2] * f2
        c2 = rotation[2, 0] * f0 + rotation[2, 1] * f1 + rotation[2, 2] * f2
        for row in range(3):
            x0, x1, x2 = rotation[row]
            half[row, 0] = x0 * xx + x1 * xy + x2 * xz
            half[row, 1] = x0 * xy + x1 * yy + x2 * yz
            half[row, 2] = x0 * xz + x1 * yz + x2 * zz
        # Steiner, for a first moment m c that is not zero: J = R I Rᵀ + (2 o·mc + m o·o) 1 − o mcᵀ − mc oᵀ − m o oᵀ.
        h0, h1, h2 = c0 + m * o0, c1 + m * o1, c2 + m * o2
        around = o0 * (c0 + h0) + o1 * (c1 + h1) + o2 * (c2 + h2)
        body = bodies[link]
        body[0], body[1], body[2], body[3] = m, h0, h1, h2
        body[4] = _turned(half, rotation, 0, 0) + around - o0 * (c0 + h0)
        body[5] = _turned(half, rotation, 0, 1) - o0 * c1 - o1 * h0
        body[6] = _turned(half, rotation, 1, 1) + around - o1 * (c1 + h1)
        body[7] = _turned(half, rotation, 0, 2) - o0 * c2 - o2 * h0
        body[8] = _turned(half, rotation, 1, 2) - o1 * c2 - o2 * h1
        body[9] = _turned(half, rotation, 2, 2) + around - o2 * (c2 + h2)


@compiled("UniTuple(f8, 6)(f8[::1], f8, f8, f8, f8, f8, f8)")
def _momentum(
    body: np.ndarray, w0: float, w1: float, w2: float, v0: float, v1: float, v2: float
) -> tuple[float, float, float, float, float, float]:
    """Moment J w + m c × v and force m v + w × m c of a body at a motion."""
    m, h0, h1, h2, xx, xy, yy, xz, yz, zz = body
    return (
        xx * w0 + xy * w1 + xz * w2 + h1 * v2 - h2 * v1,
        xy * w0 + yy * w1 + yz * w2 + h2 * v0 - h0 * v2,
        xz * w0 + yz * w1 + zz * w2 + h0 * v1 - h1 * v0,
        m * v0 + w1 * h2 - w2 * h1,
        m * v1 + w2 * h0 - w0 * h2,
        m * v2 + w0 * h1 - w1 * h0,
    )


@compiled("void(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1])")
def _mass_matrix_and_bias(
    screws: np.ndarray,
    bodies: np.ndarray,
    gravity: np.ndarray,
    qd: np.ndarray,
    forces: np.ndarray,
    matrix: np.ndarray,
    bias: np.ndarray,
) -> None:
    """Mass matrix (n, n), its lower triangle, and `bias` (n,), the torque at q̇ (n,) without acceleration.

    Makes of `bodies` what each joint carries.
    """
    n = len(qd)
    w0 = w1 = w2 = v0 = v1 = v2 = 0.0
    d0 = d1 = d2 = 0.0
    a0, a1, a2 = -gravity[0], -gravity[1], -gravity[2]
    for k in range(n):
        s0, s1, s2, s3, s4, s5 = screws[k]
        rate = qd[k]
        d0, d1, d2 = d0 + (w1 * s2 - w2 * s1) * rate, d1 + (w2 * s0 - w0 * s2) * rate, d2 + (w0 * s1 - w1 * s0) * rate
        a0 += (w1 * s5 - w2 * s4 + v1 * s2 - v2 * s1) * rate
        a1 += (w2 * s3 - w0 * s5 + v2 * s0 - v0 * s2) * rate
        a2 += (w0 * s4 - w1 * s3 + v0 * s1 - v1 * s0) * rate
        w0, w1, w2, v0, v1, v2 = (
            w0 + s0 * rate,
            w1 + s1 * rate,
            w2 + s2 * rate,
            v0 + s3 * rate,
            v1 + s4 * rate,
            v2 + s5 * rate,
        )
        h0, h1, h2, h3, h4, h5 = _momentum(bodies[k], w0, w1, w2, v0, v1, v2)
        g0, g1, g2, g3, g4, g5 = _momentum(bodies[k], d0, d1, d2, a0, a1, a2)
        of = forces[k]
        of[0] = g0 + w1 * h2 - w2 * h1 + v1 * h5 - v2 * h4
        of[1] = g1 + w2 * h0 - w0 * h2 + v2 * h3 - v0 * h5
        of[2] = g2 + w0 * h1 - w1 * h0 + v0 * h4 - v1 * h3
        of[3] = g3 + w1 * h5 - w2 * h4
        of[4] = g4 + w2 * h3 - w0 * h5
        of[5] = g5 + w0 * h4 - w1 * h3
    for k in range(n - 1, -1, -1):
        if k < n - 1:
            for i in range(10):
                bodies[k, i] += bodies[k + 1, i]
            for i in range(6):
                forces[k, i] += forces[k + 1, i]
        s0, s1, s2, s3, s4, s5 = screws[k]
        f0, f1, f2, f3, f4, f5 = forces[k]
        bias[k] = s0 * f0 + s1 * f1 + s2 * f2 + s3 * f3 + s4 * f4 + s5 * f5
        f0, f1, f2, f3, f4, f5 = _momentum(bodies[k], s0, s1, s2, s3, s4, s5)
        for j in range(k + 1):
            s0, s1, s2, s3, s4, s5 = screws[j]
            matrix[k, j] = s0 * f0 + s1 * f1 + s2 * f2 + s3 * f3 + s4 * f4 + s5 * f5


@compiled("void(f8[:,::1], f8[::1])")
def _solve(matrix: np.ndarray, x: np.ndarray) -> None:
    """Overwrite x (n,) with the solution for the lower triangle of a symmetric matrix, overwritten by L D Lᵀ."""
    n = len(x)
    for k in range(n):
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k + 1, i + 1):
                matrix[i, j] -= factor * matrix[j, k]
            x[i] -= factor * x[k]
    for k in range(n - 1, -1, -1):
        remainder = x[k]
        for i in range(k + 1, n):
            remainder -= matrix[i, k] * x[i]
        x[k] = remainder / matrix[k, k]


@compiled("f8(f8[:], f8, f8, f8[:], f8[::1], f8)")
def _servo(
    reference: np.ndarray, position: float, velocity: float, gains: np.ndarray, integral: np.ndarray, dt: float
) -> float:
    """u = kv (kff ṙ + kp (r − θ) − θ̇) + ki ∫(…) dt, clamped; the integral holds while clamped."""
    kp, kv, ki, kff, limit = gains
    error = kff * reference[1] + kp * (reference[0] - position) - velocity
    command = kv * error + integral[0]
    if command > limit:
        return limit
    if command < -limit:
        return -limit
    integral[0] += ki * error * dt
    return command


@compiled("f8(f8[:], f8)")
def _damping(friction: np.ndarray, speed: float) -> float:
    """[N·m·s/rad] by which memoryless friction opposes a speed."""
    f0, f1, f2, transition = friction[:4]
    size = abs(speed)
    chord = tanh(size / transition) / size if size > 1e-9 * transition else 1.0 / transition
    return f0 * chord + f1 + f2 * size


@compiled("f8(f8[:], f8, f8[::1], f8)")
def _bristle_friction(friction: np.ndarray, speed: float, bristle: np.ndarray, dt: float) -> float:
    """Bristle torque [N·m] after one step, plus the viscous torque."""
    coulomb, rise, per_speed, viscous, per_knee, stiffness = friction[4:]
    ratio = speed * per_speed
    ratio *= ratio
    level = coulomb + rise * exp(-ratio) if ratio < 20.0 else coulomb
    drag = viscous * speed / (1.0 + abs(speed) * per_knee)
    # Implicit in the bristle, whose rate |v| k / g is far beyond the step's at full speed.
    stretch = stiffness * speed * dt
    if abs(stretch) > 0.0:  # no number where an arm without bristles runs away
        bristle[0] = (bristle[0] + stretch) / (1.0 + abs(stretch) / level)
    return bristle[0] + drag


@compiled(
    "void(f8[:,:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1],"
    " f8[:,:,::1], f8[:,::1], i8, f8, f8[:,::1], f8[:,:,::1])"
)
def integrate(  # noqa: C901
    rotations: np.ndarray,
    origins: np.ndarray,
    axes: np.ndarray,
    prismatic: np.ndarray,
    gravity: np.ndarray,
    inertias: np.ndarray,
    coupling: np.ndarray,
    rotors: np.ndarray,
    gains: np.ndarray,
    friction: np.ndarray,
    references: np.ndarray,
    outside: np.ndarray,
    substeps: int,
    dt: float,
    state: np.ndarray,
    out: np.ndarray,
) -> None:
    """Steps of n joints: `agent.simulators.ForwardSimulation` says what they are.

    Args:
        rotations: of the arm, as of `regressor_columns`.
        origins: likewise.
        axes: likewise.
        prismatic: likewise.
        gravity: likewise.
        inertias: (n, 10) of the links, in that order.
        coupling: (n, n).
        rotors: (n,) on the axles.
        gains: (5, n) position, velocity and integral, part of the reference velocity, limit.
        friction: (10, n) f0, f1, f2 and transition of what has no memory; of bristles coulomb, rise, 1 / Stribeck
            speed, viscous, 1 / knee and stiffness.
        references: (S · substeps, 2, n) position, velocity.
        outside: (S, n) torque on the joints, the same during a sample.
        substeps: steps a sample.
        dt: of a step [s].
        state: (5, n) joints' position, velocity and acceleration; servos' integral, bristles' torque; goes on from
            here.
        out: (S, 5, n) joints' position and velocity, motors' position, velocity and torque; written.
    """
    n = len(rotors)
    q, v, a, bristle = state[0], state[1], state[2], state[4]
    scratch, screws, bodies, forces = np.empty((3, 3, 3)), np.empty((n, 6)), np.empty((n, 10)), np.empty((n, 6))
    matrix, bias, rotor_inertia, damping = np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n)
    predicted, load = np.empty(n), np.empty(n)
    for k in range(n):
        for j in range(k + 1):
            rotor_inertia[k, j] = 0.0
            for i in range(n):
                rotor_inertia[k, j] += coupling[i, k] * rotors[i] * coupling[i, j]
    for step in range(len(references)):
        sample, first = step // substeps, step % substeps == 0
        for k in range(n):
            predicted[k] = v[k] + 0.5 * dt * a[k]
        damped = False
        for k in range(n):
            axle = speed = late = 0.0
            for j in range(n):
                axle += coupling[k, j] * q[j]
                speed += coupling[k, j] * predicted[j]
                late += coupling[k, j] * v[j]
            torque = _servo(references[step, :, k], axle, speed, gains[:, k], state[3, k : k + 1], dt)
            if first:
                out[sample, 0, k], out[sample, 1, k] = q[k], predicted[k]
                out[sample, 2, k], out[sample, 3, k], out[sample, 4, k] = axle, speed, torque
            damping[k] = _damping(friction[:, k], speed)
            load[k] = torque - _bristle_friction(friction[:, k], speed, bristle[k : k + 1], dt) - damping[k] * late
            damped |= damping[k] != 0.0
        _forward_kinematics(rotations, origins, axes, prismatic, inertias, q, scratch, screws, bodies)
        _mass_matrix_and_bias(screws, bodies, gravity, predicted, forces, matrix, bias)
        for k in range(n):
            a[k] = outside[sample, k] - bias[k]
            for j in range(n):
                a[k] += load[j] * coupling[j, k]
            for j in range(k + 1):
                matrix[k, j] += rotor_inertia[k, j]
                if damped:
                    for i in range(n):
                        matrix[k, j] += coupling[i, k] * damping[i] * dt * coupling[i, j]
        _solve(matrix, a)
        for k in range(n):
            v[k] += dt * a[k]
            q[k] += dt * v[k]
