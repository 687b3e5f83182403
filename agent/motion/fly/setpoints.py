"""From the path of one run to its set-points: profile, time law, limits checked at every sample.

The speed profile of `profile` changes its acceleration in steps. Averaged over a window of T seconds,

    s_T(t) = 1/T ∫ s from t − T to t,

position, speed and acceleration along the path are averages of allowed ones, and the jerk is at most the step of the
acceleration over T. The path itself does not change. Because the window moves along the path, samples may break a
limit a little. The speed ceiling is then lowered around them, a bounded number of times. Stretching the time of the run
removes the rest: it divides speed, acceleration and jerk by the factor, its square and its cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.compiled import (
    evaluate_spline,
    lower_ceiling,
    moving_average_law,
    time_law,
    time_stretch_factors,
    widen_dips,
)
from agent.motion.fly import rules
from agent.motion.fly.fly_parameters import LONGEST, FlyParameters
from agent.motion.fly.move_geometry import Segment, label_of
from agent.motion.fly.path import Path
from agent.motion.fly.profile import ArmLimits, PathShape, Ramps, speed_ceiling
from agent.motion.interpolator import MotionError

_REPAIRS, _STRETCHES = 7, 6
#: Repairs examine one sample in this many until those are within limits, then all of them.
_COARSE = 4
#: A path is refused where joint speed limits leave less than this part of the programmed speed.
_CRAWLING = 0.01
#: [rad/s] fastest turn of a tool where the robot has no limit: distinguishes a singularity from a quick turn.
_TURNING = 6.0
#: Tolerated stretch: speed 0.05 %, acceleration 0.1 %, jerk 0.15 % above the planned limits, which are 0.2 % below the
#: arm's.
_TOLERANCE = 5e-4


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
        """s, ṡ, s̈ (S,) at times t (S,) [s] since the start of the run, in ascending order; stationary outside it."""
        s, speed, acceleration = moving_average_law(
            t, self.t, self.s, self.speed, self.acceleration, self.integral, self.window, self.stretch
        )
        return s, speed, acceleration


@dataclass(frozen=True, eq=False)
class BlockLaw:
    """s over time: phases that begin at t (P,) with s, speed and acceleration (P,), each of constant jerk (P,)."""

    t: np.ndarray
    s: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    raw_duration: float
    stretch: float = 1.0

    @property
    def duration(self) -> float:
        """[s]"""
        return self.raw_duration * self.stretch

    def sample(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """s, ṡ, s̈ (S,) at times t (S,) [s] since the start of the run; stationary outside it."""
        t = np.clip(t / self.stretch, 0.0, self.raw_duration)
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 1)
        dt, a, jerk = t - self.t[k], self.acceleration[k], self.jerk[k]
        speed = self.speed[k] + dt * (a + 0.5 * jerk * dt)
        s = self.s[k] + dt * (self.speed[k] + dt * (0.5 * a + jerk * dt / 6.0))
        at_rest = (t <= 0.0) | (t >= self.raw_duration)
        acceleration = np.where(at_rest, 0.0, (a + jerk * dt) / self.stretch**2)
        return s, np.where(at_rest, 0.0, speed / self.stretch), acceleration


@dataclass(frozen=True, eq=False)
class SetPoints:
    """Samples of one run from a standstill: the path parameter s and its speed (S,).

    rows (3, n + 7, S): values, derivatives and second derivatives by time of the joints and of the TCP's pose, which is
    position [m] and orientation (unit quaternion). Samples are the last axis: every operation runs along them. Parts of
    the rows are q, qd, qdd (n, S), pose and pose_rate (7, S).
    """

    s: np.ndarray
    speed: np.ndarray
    rows: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    pose: np.ndarray
    pose_rate: np.ndarray


@dataclass(frozen=True, eq=False)
class Run:
    """The plan between two standstills: the path with its spline, and the samples."""

    shape: PathShape
    samples: SetPoints


def plan_run(
    shape: PathShape, segments: Sequence[Segment], limits: ArmLimits, period: float, parameters: FlyParameters
) -> Run:
    """The fastest samples along a path that its rules and the arm's limits allow, from rest to rest.

    Raises:
        MotionError: it would take too long, or the arm would all but stop near a singularity; names one of `segments`.
    """
    refuse_crawling(shape, segments, limits)
    path = shape.path
    ramp = parameters.ramp * float(np.max(limits.acceleration / limits.jerk))
    window = max(round(ramp / period), 1) * period
    # Every dip is widened by the window, so that the average over the window reaches its bottom.
    ceiling = widen_dips(path.s, speed_ceiling(shape, limits, parameters), window)
    ramps = Ramps(shape, limits)
    step = _COARSE * period
    for _ in range(_REPAIRS):
        # z = ṡ² is linear between the knots
        time, speed, acceleration, integral = time_law(path.s, ramps.fastest(ceiling))
        law = TimeLaw(time, path.s - path.s[0], speed, acceleration[:-1], integral, window)
        refuse_long(path, law, segments)
        samples = sampled(shape, law, step)
        stretch = stretch_needed(path, samples, limits, step)
        if step > period and stretch.max() <= 1.0 + _TOLERANCE:
            step = period
            samples = sampled(shape, law, step)
            stretch = stretch_needed(path, samples, limits, step)
        if stretch.max() <= 1.0 + _TOLERANCE:
            return Run(shape, samples)
        half = round(window / step) // 2
        ceiling = lower_ceiling(ceiling, path.s, samples.s, samples.speed, stretch, 1.0 + _TOLERANCE, half)
    for _ in range(_STRETCHES):
        samples = sampled(shape, law, period)
        stretch = stretch_needed(path, samples, limits, period)
        if stretch.max() <= 1.0 + _TOLERANCE:
            break
        law = replace(law, stretch=law.stretch * float(stretch.max()))
    return Run(shape, samples)


def refuse_crawling(shape: PathShape, segments: Sequence[Segment], limits: ArmLimits) -> None:
    """Refuse a path on which the arm would all but stop near a singularity (MotionError)."""
    path = shape.path
    linear = np.minimum(path.rules[:, rules.LINEAR], limits.cartesian.linear_speed)
    turning = min(limits.cartesian.rotational_speed, _TURNING)
    with np.errstate(divide="ignore"):
        programmed = np.minimum(linear / shape.travel, turning / shape.turn)
    programmed[~np.isfinite(path.rules[:, rules.CARTESIAN]) | ~np.isfinite(programmed)] = 0.0
    turns = np.abs(shape.q1) / limits.speed[:, None] * programmed
    joint, knot = np.unravel_index(int(np.argmax(turns)), turns.shape)
    slowdown = float(turns[joint, knot]) * _CRAWLING
    if slowdown <= 1.0:
        return
    move = int(path.move[knot])
    x, y, z = 1e3 * path.position[knot]
    raise MotionError(
        f"{label_of(segments, move)}: joint {joint + 1} would have to turn {turns[joint, knot]:.0f} times faster than "
        f"it can at x {x:.0f}, y {y:.0f}, z {z:.0f} mm: the path passes a singularity; move the point or turn the tool",
        move,
        "singularity",
        float(np.log10(slowdown)),
    )


def refuse_long(path: Path, law: TimeLaw | BlockLaw, segments: Sequence[Segment]) -> None:
    """Refuse a motion that takes too long (MotionError); names the move on which the longest of it is spent."""
    if law.duration <= LONGEST:
        return
    slowest = int(np.argmax(np.diff(law.t, append=law.duration)))
    move = int(path.move[np.searchsorted(path.s[:-1], path.s[0] + law.s[slowest])])
    raise MotionError(
        f"{label_of(segments, move)}: the motion would take {law.duration:.3g} s, and {LONGEST:g} s are "
        "allowed; raise the speed or the overrides",
        move,
        "duration",
        float(np.log10(law.duration / LONGEST)),
    )


def sampled(shape: PathShape, law: TimeLaw | BlockLaw, period: float) -> SetPoints:
    """Samples of a path run through by a time law."""
    n = shape.path.q.shape[1]
    t = np.arange(int(np.ceil(law.duration / period - 1e-9)) + 1) * period
    s, speed, acceleration = law.sample(t)
    rows = evaluate_spline(shape.path.s, shape.coefficients, s, speed, acceleration, n)
    return SetPoints(s, speed, rows, *rows[:, :n], *rows[:2, n:])


def stretch_needed(path: Path, samples: SetPoints, limits: ArmLimits, period: float) -> np.ndarray:
    """(S,) the factor by which time would have to be stretched at each sample for every limit to hold there.

    Where all hold it is 1 or less. Programmed speeds of the TCP count as limits: a change of speed from move to move
    may not come late.
    """
    rule, cartesian = path.rules, limits.cartesian
    limited = rule[:, rules.CARTESIAN]
    ceilings = np.array(
        (
            np.minimum(cartesian.linear_speed * limited, rule[:, rules.LINEAR]),
            np.minimum(cartesian.rotational_speed * limited, rule[:, rules.ROTATIONAL]),
            cartesian.linear_acceleration * limited,
            cartesian.rotational_acceleration * limited,
        )
    )
    # The mean over three periods is another mean of the jerk than that over one: servos may see either.
    jerks, over_three = limits.jerk * period, limits.jerk * period**3
    stretch, jerk = time_stretch_factors(
        path.s, ceilings, samples.s, samples.rows, limits.speed, limits.acceleration, jerks, over_three
    )
    over = jerk > 1.0
    stretch[over] = np.maximum(stretch[over], np.cbrt(jerk[over]))
    return stretch
