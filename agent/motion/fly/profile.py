"""How fast along the path: the largest speed that keeps joint and Cartesian limits, without jerk limits.

With z = ṡ², every acceleration along the path is q̈ = q' z'/2 + q'' z, and d(q'² z)/ds = 2 q' q̈. So a joint's limit
|q̈| ≤ a says that y = q'² z, the square of its speed, changes by at most 2 a |Δq| from knot to knot. Given y at the
knots, the largest y that nowhere rises faster is a running minimum, min over i ≤ k of y_i + (C_k − C_i) with C the sum
of the allowed changes: one running minimum forwards and one backwards. Every pass only
lowers z, the constraints are monotone, and so passes over all joints converge to the largest feasible z from above.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.compiled import derivatives, fastest_profile, not_a_knot, speed_change_sums
from agent.motion.fly import rules
from agent.motion.fly.fly_parameters import FlyParameters
from agent.motion.fly.path import Path
from agent.robot import CartesianLimits, RobotDescription

_PASSES = 20
#: The planned part of every limit. The rest is a margin for what the repairs leave.
_KEPT = 0.998
#: [rad, m] of error between two knots of the path.
_TOLERATED = 3e-6
#: A joint slower than this part of its limit, or a TCP slower than this [m/s, rad/s], is stationary but for round-off.
_STILL = 1e-5


@dataclass(frozen=True, eq=False)
class ArmLimits:
    """What is planned for: joint speed, acceleration, jerk (n,) and the TCP's limits (inf where there are none)."""

    speed: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    cartesian: CartesianLimits

    @classmethod
    def of(cls, robot: RobotDescription, parameters: FlyParameters) -> ArmLimits:
        """Limits of a robot; a joint without jerk limit gets one from `parameters.jerk_time`."""
        jerk = [
            joint.max_acceleration / parameters.jerk_time if joint.max_jerk is None else joint.max_jerk
            for joint in robot.joints
        ]
        tcp = robot.cartesian_limits or CartesianLimits(np.inf, np.inf, np.inf, np.inf)
        share = 1.0 if parameters.ramps == "blocks" else _KEPT  # which keep their limits to the last digit
        part = share * parameters.acceleration
        cartesian = CartesianLimits(
            share * tcp.linear_speed,
            part * tcp.linear_acceleration,
            share * tcp.rotational_speed,
            part * tcp.rotational_acceleration,
        )
        return cls(share * robot.max_velocity, part * robot.max_acceleration, share * np.array(jerk), cartesian)


@dataclass(frozen=True, eq=False)
class PathShape:
    """A `path` as a cubic spline over s, and its derivatives at the knots.

    coefficients (4, n + 7, K - 1): of the cell from each knot on, highest power first, rows q, p and the quaternion.
    Knots last: q1, q2, q3 (n, K); `travel` (K,) = |dp/ds| and `bend` (K,), the part of d²p/ds² across the path; `turn`
    and `turn_bend` (K,) the same for the rotation. Where it is not `smooth`, curvature jumps from block to block.
    """

    path: Path
    coefficients: np.ndarray
    q1: np.ndarray
    q2: np.ndarray
    q3: np.ndarray
    travel: np.ndarray
    bend: np.ndarray
    turn: np.ndarray
    turn_bend: np.ndarray
    smooth: bool

    def roughness(self) -> tuple[float, int]:
        """Largest error of joints and TCP between knots, in units of the tolerated one, and the knot where it is.

        A cubic spline errs by h⁴/384 times the fourth derivative, which is the change of the third over h.
        """
        cubic = self.coefficients[0]
        change = 6.0 * np.abs(cubic[:, 1:] - cubic[:, :-1]).max(axis=0)
        step = np.diff(self.path.s)
        errors = change * np.maximum(step[1:], step[:-1]) ** 3 / 384.0
        # At its ends the spline has one cubic for two cells, and errs about ten times as much.
        errors[[0, 1, -2, -1]] *= 10.0
        if not self.smooth:
            errors[self.path.borders[1:-1] - 1] = 0.0
        worst = int(np.argmax(errors))
        return float(errors[worst]) / _TOLERATED, 1 + worst


def shape_of(path: Path, smooth: bool = True) -> PathShape:
    """The spline of a path and its derivatives at the knots; one for each block where the path is not `smooth`."""
    n = path.q.shape[1]
    rows = np.concatenate((path.q.T, path.position.T, path.orientation.T))
    if smooth:
        coefficients = not_a_knot(path.s, rows)
    else:
        pieces = [_piece(path.s[a : b + 1], rows[:, a : b + 1]) for a, b in pairwise(path.borders)]
        coefficients = np.concatenate(pieces, axis=2)
    (first, second, third), (travel, rotation) = derivatives(coefficients, path.s[-1] - path.s[-2], path.orientation)
    return PathShape(
        path,
        coefficients,
        first[:n],
        second[:n],
        third[:n],
        *_along_and_across(*travel),
        *_along_and_across(*rotation),
        smooth,
    )


def _piece(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """As `not_a_knot`; through two or three knots the line or the parabola."""
    if len(x) > 3:
        return not_a_knot(x, rows)
    from scipy.interpolate import CubicSpline

    return CubicSpline(x, rows.T).c.transpose(0, 2, 1)


def _along_and_across(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    size = np.sqrt(np.einsum("ki,ki->k", first, first))
    along = np.einsum("ki,ki->k", first, second) / np.maximum(size, 1e-9)
    return size, np.sqrt(np.maximum(np.einsum("ki,ki->k", second, second) - along**2, 0.0))


def allowed_speed(shape: PathShape, limits: ArmLimits) -> np.ndarray:
    """(K,) speed that program and speed limits allow at each knot."""
    rule, tcp = shape.path.rules, limits.cartesian
    linear = np.minimum(rule[:, rules.LINEAR], tcp.linear_speed * rule[:, rules.CARTESIAN])
    turning = np.minimum(rule[:, rules.ROTATIONAL], tcp.rotational_speed * rule[:, rules.CARTESIAN])
    joint = np.min(limits.speed[:, None] / np.maximum(np.abs(shape.q1), 1e-12), axis=0) * rule[:, rules.JOINT]
    tool = np.minimum(linear / np.maximum(shape.travel, 1e-12), turning / np.maximum(shape.turn, 1e-12))
    return np.minimum(tool, joint)


def speed_ceiling(shape: PathShape, limits: ArmLimits, parameters: FlyParameters) -> np.ndarray:
    """(K,) largest z = ṡ² that each knot allows by itself [1/s² times the square of s's unit]."""
    rule = shape.path.rules
    with np.errstate(divide="ignore"):
        speed = allowed_speed(shape, limits) * shape.path.overlap
        jerk = np.min(parameters.curve_share * limits.jerk[:, None] / np.maximum(np.abs(shape.q3), 1e-12), axis=0)
        ceiling = np.minimum(speed**2, jerk ** (2.0 / 3.0))
        bend = np.min(limits.acceleration[:, None] / np.maximum(np.abs(shape.q2), 1e-12), axis=0)
        ceiling = np.minimum(ceiling, bend * rule[:, rules.STRESS] * _override(rule))
        share = parameters.curve_share * rule[:, rules.CARTESIAN] * _override(rule)
        ceiling = np.minimum(ceiling, share * limits.cartesian.linear_acceleration / np.maximum(shape.bend, 1e-12))
        return np.minimum(
            ceiling, share * limits.cartesian.rotational_acceleration / np.maximum(shape.turn_bend, 1e-12)
        )


def _override(rule: np.ndarray) -> np.ndarray:
    return np.maximum(rule[:, rules.ACCELERATION], rule[:, rules.DECELERATION])


class Ramps:
    """Changes of speed that the acceleration limits allow along a path, for any ceiling of its speed."""

    def __init__(self, shape: PathShape, limits: ArmLimits):
        path, rule = shape.path, shape.path.rules
        self._rise = np.minimum(rule[:-1, rules.ACCELERATION], rule[1:, rules.ACCELERATION])
        self._fall = np.minimum(rule[:-1, rules.DECELERATION], rule[1:, rules.DECELERATION])
        self._alike = np.array_equal(self._rise, self._fall)
        stress = np.minimum(rule[:-1, rules.STRESS], rule[1:, rules.STRESS])
        # Weights w (m, K) in y = w z, and the y of standstill (m,): of the joints, and of the TCP's travel and turn.
        weights, least = [shape.q1**2], [(_STILL * limits.speed) ** 2]
        self._joints = 2.0 * limits.acceleration[:, None] * stress * np.abs(path.q[1:] - path.q[:-1]).T
        tool, steps = [], []
        part = rule[:, rules.CARTESIAN]
        for size, across, limit in (
            (shape.travel, shape.bend, limits.cartesian.linear_acceleration),
            (shape.turn, shape.turn_bend, limits.cartesian.rotational_acceleration),
        ):
            if np.isfinite(limit) and np.isfinite(part).any():
                tool.append((across, limit * part, limit * np.minimum(part, 1e3)))
                steps.append(0.5 * (size[1:] + size[:-1]) * (path.s[1:] - path.s[:-1]))
                weights.append(size[None] ** 2)
                least.append(np.array([_STILL**2]))
        knots = len(path.s)
        #: Of each limit of the TCP what bends, the limit, and the same for ramps (3, t, K); and the way (t, K - 1).
        self._tool = np.ascontiguousarray(np.reshape(tool, (-1, 3, knots)).swapaxes(0, 1))
        self._steps = np.reshape(steps, (-1, knots - 1))
        self._weight, self._least = np.concatenate(weights), np.concatenate(least)

    def fastest(self, ceiling: np.ndarray) -> np.ndarray:
        """(K,) the largest z = ṡ² under `ceiling` (K,) that keeps all acceleration limits, standstill to standstill."""
        rising = speed_change_sums(ceiling, self._joints, self._tool, self._steps, self._rise)
        falling = (
            rising if self._alike else speed_change_sums(ceiling, self._joints, self._tool, self._steps, self._fall)
        )
        z = fastest_profile(ceiling, self._weight, rising, falling, self._least, _PASSES)
        # Standstill belongs to the ends alone: a knot between them may not hold the arm for ever.
        z[1:-1] = np.maximum(z[1:-1], 1e-9 * np.max(ceiling[1:-1]))
        return z
