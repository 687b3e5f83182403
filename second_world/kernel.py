"""One step of all joints, compiled: servo, current loop, friction, gears, and the laws of everything else.

A term is a row of numbers (kind, joint, size, p1 … p5) with four states; what each kind means stands where it is used.
Friction is elements that stretch and slip: one smooth bristle (LuGre, Canudas de Wit et al., IEEE TAC 40, 1995),
advanced exactly over a step of constant speed, or four that stick and slip (generalised Maxwell slip, Lampaert et al.,
2003, in the limit of a fast attraction). Terms below `TORQUE` add to the level at which the elements slip, the others
are torques of their own.
"""

from __future__ import annotations

from enum import IntEnum
from math import asinh, atan, cos, exp, floor, log1p, pi, sin, sqrt, tanh

import numba
import numpy as np

compiled = numba.njit(cache=True)

#: First kind that is an independent torque.
TORQUE = 40


class Kind(IntEnum):
    """Kinds of terms; tens are groups."""

    FADING = 0  # size · exp(−(|v| / p1)^p2)
    HYPERBOLIC = 1  # size / (1 + (v / p1)²)
    REMEMBERED = 2  # as FADING with the speed of p2 [s] ago
    ONE_WAY = 3  # ± size by the sign of v
    ONE_WAY_RISING = 4  # ± size · x / (1 + x), x = |v| / p1
    LOADED = 10  # size · |load| / p1
    LOADED_POWER = 11  # size · (|load| / p1)^p2
    DRIVING = 12  # as LOADED where the motor drives the load
    OVERLOADED = 13  # size · max(|load| / p1 − p2, 0)
    COLD_TIME = 20  # size · exp(−t / p1)
    COLD_DISTANCE = 21  # size · exp(−distance / p1)
    COLD_POWER = 22  # size · exp(−T), Ṫ = p1 · power − T / p2
    DRY = 23  # size · (1 − film), built by motion p1, lost at standstill p2
    CONSTANT = 30  # size
    STEPS = 31  # size or nothing, by turns of p1 [s]
    ROUGH = 32  # size · a drag that changes from patch to patch of p1 [rad]
    ASINH = 40  # size · asinh(v / p1)
    THINNING = 41  # size · x / (1 + x²)^p2, x = v / p1
    CHURNING = 42  # size · x |x|
    ROOT = 43  # size · x / (|x|^(2/3) + 0.05)
    ONE_WAY_VISCOUS = 44  # size · |x| · p2, p2 the sign of v that drags more
    COLD_VISCOUS = 45  # size · x · exp(−t / p2)
    VISCOUS = 46  # size · x
    TORSION = 50  # size · (q − p1)
    PIVOTS = 51  # a spring between two pivots, p2 the lever over the distance
    CYLINDER = 52  # a constant force instead
    CAM = 53  # size · atan((q − p1) / p2) bent once more
    SLACK = 54  # size · square of what x = q − p1 exceeds p2 by
    ONE_SIDED = 55  # size · p2 · log(1 + exp(p3 · x / p2))
    RELAXING = 56  # size · tanh((x − half of x as it was p3 ago) / p2)
    DAHL = 60  # size · z, a bristle of travel p1
    IWAN = 61  # size · mean of four elements that slip at up to p1
    BOUC_WEN = 62  # size · z, ż = v / p1 · (1 − z² (1 + sign(v z)) / 2)
    LOPSIDED_DAHL = 63  # as DAHL, travel p1 forward, p2 backward
    HOSE = 64  # size · ((q − p3) / p2 + z / 2), z of BOUC_WEN
    SINE = 70  # size · (sin x + p3 · sin 2x), x = p1 · q + p2
    TRIANGLE = 71
    CURRENT_SINE = 72  # SINE in proportion to |current| / p3
    TEETH = 73  # size · (|sin x| − 2 / π)
    BEATING = 74  # two lines, p3 apart
    VIBRATION = 80  # size · sin(2 π p1 t + p2)
    VALVE = 81  # size · (stuck − x), x = sin(q − p1), free where they are p2 apart
    CREEP = 82  # size · (q − rest), the rest creeping to q within p2 [s]
    LOOSE = 83  # size · position of a mass between two stops, sliding by gravity
    SLOSH = 84  # size · angle of a pendulum of p1 [rad/s], damped p2, shaken by the joint


@compiled
def _hash(x: float) -> float:
    """A number in [0, 1) that looks random."""
    y = sin(12.9898 * x + 4.1414) * 43758.5453
    return y - floor(y)


@compiled
def _level(  # noqa: C901
    p: np.ndarray, s: np.ndarray, q: float, v: float, load: float, power: float, t: float, dt: float
) -> float:
    """Contribution of a term to the level [N·m]."""
    kind, size, speed = int(p[0]), p[2], abs(v)
    if kind == 0:
        return size * exp(-min((speed / p[3]) ** p[4], 700.0))
    if kind == 1:
        return size / (1 + (v / p[3]) ** 2)
    if kind == 2:
        s[0] += (speed - s[0]) * min(dt / p[4], 1.0)
        return size * exp(-s[0] / p[3])
    if kind < 10:
        sign = (1.0 if v > 0 else -1.0) if v != 0 else 0.0
        return size * sign if kind == 3 else size * sign * (speed / p[3]) / (1 + speed / p[3])
    if kind < 20:
        share = abs(load) / p[3]
        if kind == 12:
            return size * share if load * v > 0 else 0.0
        if kind == 13:
            return size * max(share - p[4], 0.0)
        return size * (share if kind == 10 else share ** p[4])
    if kind == 20:
        return size * exp(-t / p[3])
    if kind == 21:
        s[0] += speed * dt
        return size * exp(-s[0] / p[3])
    if kind == 22:
        s[0] += (p[3] * abs(power) - s[0] / p[4]) * dt
        return size * exp(-s[0])
    if kind == 23:
        s[0] += (speed / p[3] * (1 - s[0]) - s[0] / p[4]) * dt
        return size * (1 - s[0])
    if kind == 30:
        return size
    if kind == 31:
        return size if _hash(floor(t / p[3]) + p[4]) < 0.4 else 0.0
    x = q / p[3] + p[4]
    at = floor(x)
    return size * ((1 - x + at) * _hash(at) ** 2 + (x - at) * _hash(at + 1) ** 2)


@compiled
def _place_torque(kind: int, p: np.ndarray, s: np.ndarray, q: float, t: float, dt: float) -> float:
    x = q - p[3]
    if kind == 50:
        return p[2] * x
    if kind == 51 or kind == 52:
        length = sqrt(1 + p[4] ** 2 - 2 * p[4] * cos(x))
        force = 1.0 if kind == 52 else (length - 0.75 + p[4]) / (p[4] + 0.25)
        return p[2] * force * sin(x) / length
    if kind == 53:
        return p[2] * (atan(x / p[4]) + 0.5 * atan((x - 0.6) / (0.3 * p[4])))
    if kind == 54:
        over = max(abs(x) - p[4], 0.0)
        return p[2] * over * over * (1.0 if x > 0 else -1.0)
    if kind == 55:
        bent = p[5] * x / p[4]
        return p[2] * p[4] * p[5] * (max(bent, 0.0) + log1p(exp(-abs(bent))))
    if s[1] == 0.0:
        s[0], s[1] = x, 1.0
    s[0] += (x - s[0]) * dt / p[5]
    return p[2] * tanh((x - 0.5 * s[0]) / p[4])


@compiled
def _hysteresis(kind: int, p: np.ndarray, s: np.ndarray, q: float, v: float, dt: float) -> float:
    if kind == 61:
        total = 0.0
        for i in range(4):
            limit = p[3] * (i + 0.5) / 4
            s[i] = min(max(s[i] + v * dt, -limit), limit)
            total += s[i] / limit
        return 0.25 * p[2] * total
    travel = p[4] if kind == 63 and v < 0 else p[3]
    step = v * dt / travel
    if kind == 60 or kind == 63:
        s[0] = (s[0] + step) / (1 + abs(step))
        return p[2] * s[0]
    s[0] += step * (1 - s[0] * s[0] * (0.5 + (0.5 if v * s[0] > 0 else -0.5)))
    s[0] = min(max(s[0], -1.0), 1.0)
    return p[2] * s[0] if kind == 62 else p[2] * ((q - p[5]) / p[4] + 0.5 * s[0])


@compiled
def _outside(kind: int, p: np.ndarray, s: np.ndarray, q: float, v: float, t: float, dt: float) -> float:
    if kind == 80:
        return p[2] * sin(2 * pi * p[3] * t + p[4])
    if kind == 81:
        x = sin(q - p[3])
        if s[1] == 0.0 or abs(x - s[0]) > p[4]:
            s[0], s[1] = x, 1.0
        return p[2] * (s[0] - x)
    if kind == 82:
        if s[1] == 0.0:
            s[0], s[1] = q, 1.0
        s[0] += (q - s[0]) * dt / p[4]
        return p[2] * (q - s[0])
    if kind == 83:
        s[1] += (9.8 / p[4] * sin(q - p[3]) - 4 * s[1]) * dt
        s[0] += s[1] * dt
        if abs(s[0]) > 1:
            s[0], s[1] = min(max(s[0], -1.0), 1.0), -0.2 * s[1]
        return p[2] * (s[0] + 0.01 * s[1])
    shaken = (v - s[2]) / dt if t > dt else 0.0
    s[2] = v
    s[1] += (-(p[3] ** 2) * s[0] - 2 * p[4] * p[3] * s[1] - shaken) * dt
    s[0] += s[1] * dt
    return p[2] * s[0]


@compiled
def _torque(  # noqa: C901
    p: np.ndarray, s: np.ndarray, q: float, v: float, current: float, t: float, dt: float
) -> float:
    """Part of the motor's torque [N·m] that a term takes."""
    kind = int(p[0])
    if kind < 50:
        x = v / p[3]
        if kind == 40:
            return p[2] * asinh(x)
        if kind == 41:
            return p[2] * x / (1 + x * x) ** p[4]
        if kind == 42:
            return p[2] * x * abs(x)
        if kind == 43:
            return p[2] * x / (abs(x) ** (2 / 3) + 0.05)
        if kind == 44:
            return p[2] * abs(x) * p[4]
        return p[2] * x * exp(-t / p[4]) if kind == 45 else p[2] * x
    if kind < 60:
        return _place_torque(kind, p, s, q, t, dt)
    if kind < 70:
        return _hysteresis(kind, p, s, q, v, dt)
    if kind >= 80:
        return _outside(kind, p, s, q, v, t, dt)
    x = p[3] * q + p[4]
    if kind == 70:
        return p[2] * (sin(x) + p[5] * sin(2 * x))
    if kind == 71:
        turns = x / (2 * pi)
        return p[2] * (4 * abs(turns - floor(turns) - 0.5) - 1)
    if kind == 72:
        return p[2] * sin(x) * abs(current) / p[5]
    if kind == 73:
        return p[2] * (abs(sin(x)) - 2 / pi)
    return p[2] * (sin(x) + sin(p[5] * x))


@compiled
def _slipping(maxwell: bool, stiffness: float, level: float, v: float, dt: float, z: np.ndarray) -> float:
    """Torque of the friction elements z (4,), one step on."""
    if not maxwell:
        if v != 0.0:
            z[0] -= (exp(-stiffness * abs(v) * dt / level) - 1) * ((level if v > 0 else -level) - z[0])
        return z[0]
    total = 0.0
    for i in range(4):
        limit = 0.25 * level
        rate = stiffness * v * (0.04 + 0.14 * i)
        z[i] = min(max(z[i] + rate * dt, -limit), limit)
        total += min(max(z[i] + 0.002 * rate, -limit), limit)  # damped by 2 ms while it sticks
    return total


@compiled
def _gear(g: np.ndarray, x: np.ndarray, twist: float, rate: float, dt: float) -> float:
    """Torque [N·m] that a gear g = (kind, stiffness, damping, gap, shape) transmits.

    1 linear, 2 hardening, 3 with a Maxwell branch, 4 softening, 5 teeth with play, 6 with play and Hertz's contact,
    7 with more play on one side, a stiffness for each and a hysteresis, 8 with a play whose edges are round.
    """
    kind, stiffness, damping, gap, shape = int(g[0]), g[1], g[2], g[3], g[4]
    if kind == 2:
        return stiffness * twist * (1 + (twist / shape) ** 2) + damping * rate
    if kind == 3:
        x[0] += (twist - x[0]) * dt / 0.05
        return stiffness * twist + stiffness * shape * (twist - x[0]) + damping * rate
    if kind == 4:
        return stiffness * shape * tanh(twist / shape) + damping * rate
    if kind == 8:
        return stiffness * (sqrt(twist * twist + gap * gap) - gap) * (1.0 if twist > 0 else -1.0) + damping * rate
    if kind == 1:
        return stiffness * twist + damping * rate
    upper, lower = 0.5 * gap, -0.5 * gap
    if kind == 7:
        x[0] = min(max(x[0], twist - 0.3 * gap), twist + 0.3 * gap)
        twist, upper, lower = 0.5 * (twist + x[0]), 0.8 * gap, -0.2 * gap
    over = twist - upper if twist > upper else min(twist - lower, 0.0)
    if kind == 6:
        over *= sqrt(abs(over) / shape)
    if kind == 7 and over < 0:
        over *= shape
    push = stiffness * over + (damping * rate if over != 0.0 else 0.0)
    return max(push, 0.0) if over > 0 else min(push, 0.0) if over < 0 else 0.0


@compiled
def step(
    t: float,
    dt: float,
    index: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    bias: np.ndarray,
    applied: np.ndarray,
    target: np.ndarray,
    servo: np.ndarray,
    friction: np.ndarray,
    gears: np.ndarray,
    terms: np.ndarray,
    pairs: np.ndarray,
    x: np.ndarray,
    states: np.ndarray,
    out: np.ndarray,
) -> None:
    """Set `applied` (nv,) and `out` (3, n): position, velocity and current as the servo sees them.

    `target` (3, n): set-point and its derivatives. Rows of `servo` (n, 14): gravity known, acceleration ahead, Kp, Kd,
    Ki, torque count, share of the current loop's step, zero of the encoder, torque and offset per current, the inertia
    of the rotor, whether the torque that is seen is the command, its count, the limit of the current.
    Rows of `friction` (n, 13): Maxwell slip, Coulomb, rise, its speed, viscous, stiffness, change of Coulomb and
    viscous with temperature, K per power, time constant, per load, per posture, its angle. `pairs` (K, 5): a drag at
    the speed v[second] + ratio · v[first]: first, second, ratio, Coulomb, viscous. States `x` (n, 16), `states` of
    the terms (T, 4) and after them of the pairs.
    """
    n = len(index)
    for j in range(n):
        s, f, r = servo[j], friction[j], x[j]
        q, v = qpos[index[j]], qvel[index[j]]
        link_q, link_v = q, v
        soft = gears[j, 0] > 0
        if soft:
            if r[9] == 0.0:
                r[7], r[8], r[9] = q, v, 1.0
            q, v = r[7], r[8]
        seen = q + s[7]
        error = target[0, j] - seen
        r[0] = min(max(r[0] + s[4] * error * dt, -s[13]), s[13])
        want = s[0] * bias[index[j]] + s[1] * target[2, j] + s[2] * error + s[3] * (target[1, j] - v) + r[0]
        want = min(max(want, -s[13]), s[13])
        want = floor(want / s[5] + 0.5) * s[5]
        r[1] += s[6] * (want - r[1])
        out[0, j], out[1, j] = seen, v
        out[2, j] = want if s[11] > 0 else r[1]
        drive = r[1] * s[8] + s[9]
        power = r[2] * v
        level = f[1] * max(1 - f[6] * r[3], 0.1) * (1 + f[11] * cos(q - f[12]))
        level += f[2] * exp(-min((v / f[3]) ** 2, 700.0)) + f[10] * abs(r[4])
        taken = f[4] * v * exp(-f[7] * r[3])
        for i in range(len(terms)):
            if int(terms[i, 1]) == j:
                if terms[i, 0] < TORQUE:
                    level += _level(terms[i], states[i], q, v, r[4], power, t, dt)
                else:
                    taken += _torque(terms[i], states[i], q, v, r[1], t, dt)
        rubbing = _slipping(f[0] > 0, f[5], max(level, 0.05 * f[1]), v, dt, r[10:14])
        r[2] = rubbing + f[4] * v
        r[3] += (f[8] * abs(r[2] * v) - r[3] / f[9]) * dt
        passed = drive - rubbing - taken
        r[4] += dt / 0.005 * (passed - s[10] * target[2, j] - r[4])
        if soft:
            force = _gear(gears[j], r[14:], q - link_q, v - link_v, dt)
            r[8] += dt * (passed - force) / s[10]
            r[7] += dt * r[8]
            passed = force
        applied[index[j]] = passed
    for i in range(len(pairs)):
        first, second, ratio = index[int(pairs[i, 0])], index[int(pairs[i, 1])], pairs[i, 2]
        speed = qvel[second] + ratio * qvel[first]
        z = states[len(terms) + i]
        drag = pairs[i, 4] * speed
        if pairs[i, 3] > 0:
            drag += _slipping(False, pairs[i, 3] / 5e-4, pairs[i, 3], speed, dt, z)
        applied[second] -= drag
        applied[first] -= ratio * drag
