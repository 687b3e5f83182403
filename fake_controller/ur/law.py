"""The law of motion of a UR controller: trapezoids of speed on joint, straight and circular stretches, blended.

Neither generation's blend is published. What is reported of them is imitated here: e-Series keep the speed with which
they enter a blend on a rounded corner, CB3 goes linearly from one velocity to the other. Blends begin at a share of
the radius.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fake_controller.ur.arm import DenavitHartenberg, matrices_of

_FINE = 401  # points of a curve that is measured by length
_NOTHING = 1e-9  # m, rad
_REMEMBERED = 100  # plans
#: Acceleration above which a rounded corner is run more slowly: 3 of the TCP [m/s²], 3 of rotation or joints [rad/s²].
_SHARPEST = np.repeat([15.0, 40.0], 3)


@dataclass(frozen=True, eq=False)
class UrMove:
    """One move: `goal` and `via` are TCP poses (4, 4), `joints` (6,) the goal of a joint move.

    `kind` is joint, line, arc or process (movep); speed and acceleration are m or rad a second, `radius` [m] of the
    blend, `line` of the script.
    """

    kind: str
    goal: np.ndarray
    tcp: np.ndarray
    speed: float
    acceleration: float
    radius: float
    line: int
    joints: np.ndarray | None = None
    via: np.ndarray | None = None
    duration: float = 0.0

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for equal moves."""
        return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in vars(self).values())


@dataclass(frozen=True)
class BlendLaw:
    """`begin`: share of the radius at which a blend begins; `keeps_speed`: as e-Series do, else as CB3."""

    begin: float
    keeps_speed: bool


E_SERIES, CB3 = BlendLaw(0.9, True), BlendLaw(1.0, False)


class Stretch:
    """The way of one move from joint positions (6,) to its goal, at `length` [m or rad of the leading joint].

    Offsets (K, 6) are relative to the goal: joint differences, or translation in the base frame and rotation vector in
    the goal's frame. On joint and straight stretches they shrink in proportion to the way that is left.
    """

    def __init__(self, arm: DenavitHartenberg, move: UrMove, start: np.ndarray) -> None:
        self.move, self._arm, self.start = move, arm, start
        self.in_joints = move.joints is not None
        self._circle: Callable[[np.ndarray], np.ndarray] | None = None
        if move.joints is not None:
            self.offset = start - move.joints
            self.length = float(np.abs(self.offset).max())
        else:
            begin = (arm.forward(start[None]) @ move.tcp)[0]
            rotation = Rotation.from_matrix(move.goal[:3, :3].T @ begin[:3, :3]).as_rotvec()
            self.offset = np.concatenate([begin[:3, 3] - move.goal[:3, 3], rotation])
            length = float(np.linalg.norm(self.offset[:3]))
            self.length = length if length > _NOTHING else float(np.linalg.norm(rotation))
            if move.via is not None:
                self.length, self._circle = _circle(begin[:3, 3], move.via[:3, 3], move.goal[:3, 3])
        self.speed, self.acceleration = move.speed, move.acceleration
        if move.duration > 0:
            self.speed, self.acceleration = 1.5 * self.length / move.duration, 4.5 * self.length / move.duration**2

    @property
    def straight(self) -> bool:
        """Offsets are proportional to the way that is left."""
        return self._circle is None

    def offsets(self, s: np.ndarray) -> np.ndarray:
        """(K, 6) at s (K,) from the start."""
        remaining = 1.0 - s / max(self.length, _NOTHING)
        offsets = remaining[:, None] * self.offset
        if self._circle is not None:
            offsets[:, :3] = self._circle(s) - self.move.goal[:3, 3]
        return offsets

    def joints(self, offsets: np.ndarray, near: np.ndarray) -> np.ndarray:
        """(K, 6) joint positions of offsets, going on from `near` (6,).

        Raises:
            Unreachable: out of reach, or a singularity on the way.
        """
        if self.move.joints is not None:
            return self.move.joints + offsets
        poses = matrices_of(np.hstack([self.move.goal[:3, 3] + offsets[:, :3], offsets[:, 3:]]))
        poses[:, :3, :3] = self.move.goal[:3, :3] @ poses[:, :3, :3]
        return self._arm.inverse(poses @ np.linalg.inv(self.move.tcp), near)

    def within(self, radius: float, of_goal: bool) -> float:
        """Part of the path, at its end or its beginning, where the TCP is within `radius` [m] of that end."""
        if not self.in_joints and self.straight:
            return min(radius, self.length)
        s = np.linspace(0.0, self.length, _FINE)
        if self.in_joints:
            poses = self._arm.forward(self.joints(self.offsets(s), self.start)) @ self.move.tcp
            places = poses[:, :3, 3]
        else:
            places = self.offsets(s)[:, :3]
        distance = np.linalg.norm(places - places[-1 if of_goal else 0], axis=1)
        if of_goal:
            s, distance = self.length - s[::-1], distance[::-1]
        beyond = int(np.argmax(distance > radius)) if distance.max() > radius else _FINE - 1
        return float(np.interp(radius, distance[max(beyond - 1, 0) : beyond + 1], s[max(beyond - 1, 0) : beyond + 1]))


@dataclass(frozen=True, eq=False)
class PlannedSetpoints:
    """Set-points (K, 6), one a period; the blend into the next move begins with number `blend`."""

    position: np.ndarray
    velocity: np.ndarray
    blend: int


class UrInterpolator:
    """Plans move after move. Each is given with the one that it blends into, which has to be the next that is given.

    What was planned is remembered, so that a repeated cycle is planned once.
    """

    def __init__(self, arm: DenavitHartenberg, law: BlendLaw, period: float, q: np.ndarray) -> None:
        self._arm, self._law, self._period = arm, law, period
        self._plans: OrderedDict[tuple[object, ...], tuple[PlannedSetpoints, dict[str, Any]]] = OrderedDict()
        self.rest(q)

    def rest(self, q: np.ndarray) -> None:
        """The next move begins from a standstill at joint positions (6,)."""
        self.q, self._next = q, self._period  # seconds from the end of the plan to the next set-point
        self._entered: tuple[Stretch, float, float] | None = None

    def plan(self, move: UrMove, after: UrMove | None) -> PlannedSetpoints:
        """The rest of a move, and the blend into `after` or the stop at its goal.

        Raises:
            Unreachable: out of reach, or a singularity on the way.
        """
        start, speed = (0.0, 0.0) if self._entered is None else self._entered[1:]
        now = tuple(np.round([*self.q, self._next, start, speed], 9).tolist())
        key = (now, move.key, after and after.key)
        if key not in self._plans:
            planned = self._plan(move, after)
            self._plans[key] = planned, {name: getattr(self, name) for name in ("q", "_next", "_entered")}
            if len(self._plans) > _REMEMBERED:
                self._plans.popitem(last=False)
        planned, state = self._plans[key]
        vars(self).update(state)
        return planned

    def _plan(self, move: UrMove, after: UrMove | None) -> PlannedSetpoints:
        stretch, start, speed = self._entered or (Stretch(self._arm, move, self.q), 0.0, 0.0)
        if after is None:
            goal = self._along(stretch, start, stretch.length, speed, 0.0, stops=True)
            self._entered, self._next = None, self._period
            return self._setpoints([goal], len(goal), stops=True)
        corner = stretch.joints(np.zeros((1, 6)), self.q)[0]
        following = Stretch(self._arm, after, corner)
        blend = _Blend(stretch, following, self._law, start, speed)
        straight = self._along(stretch, start, stretch.length - blend.before, speed, blend.entering)
        at = self._times(blend.duration)
        last = straight[-1] if len(straight) else self.q
        turned = blend.joints(at, last) if len(at) else np.zeros((0, 6))
        self._entered = following, blend.after, blend.leaving
        return self._setpoints([straight, turned], len(straight))

    def _along(
        self, stretch: Stretch, begin: float, end: float, v0: float, v1: float, stops: bool = False
    ) -> np.ndarray:
        times, speeds = trapezoid(end - begin, v0, stretch.speed, v1, stretch.acceleration)
        at = self._times(times[-1], stops)
        if not len(at):
            return np.zeros((0, 6))
        knots = np.concatenate([[0.0], np.cumsum(np.diff(times) * (speeds[1:] + speeds[:-1]) / 2)])
        index = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
        s = knots[index] + (at - times[index]) * (speeds[index] + np.interp(at, times, speeds)) / 2
        return stretch.joints(stretch.offsets(begin + np.minimum(s, end - begin)), self.q)

    def _times(self, duration: float, stops: bool = False) -> np.ndarray:
        """Moments of the set-points within a piece of `duration` [s]; one at its end where the arm stops there."""
        at = np.arange(self._next, duration + 1e-9, self._period)
        self._next += self._period * len(at) - duration
        return np.append(at[at < duration - 1e-9], duration) if stops else at

    def _setpoints(self, pieces: list[np.ndarray], blend: int, stops: bool = False) -> PlannedSetpoints:
        position = np.vstack(pieces)
        rows = np.vstack([self.q, position, *([position[-1:]] if stops else [])])
        velocity = np.zeros_like(rows)
        if len(rows) > 1:
            order: Literal[1, 2] = 1 if stops or len(rows) == 2 else 2
            velocity = np.asarray(np.gradient(rows, self._period, axis=0, edge_order=order))
        if stops:
            velocity[-2:] = 0.0
        self.q = rows[-1]
        return PlannedSetpoints(position, velocity[1 : len(position) + 1], blend)


class _Blend:
    """From one stretch into the next: `before` of the first and `after` of the second are left out of both."""

    def __init__(self, first: Stretch, second: Stretch, law: BlendLaw, start: float, speed: float) -> None:
        self._first, self._second = first, second
        self._place_on_curve: Callable[[np.ndarray], np.ndarray] = lambda t: t / self.duration
        radius = law.begin * first.move.radius
        self.before = min(first.within(radius, of_goal=True), 0.98 * (first.length - start))
        self.after = min(second.within(radius, of_goal=False), 0.98 * second.length)
        keeps = law.keeps_speed or first.move.kind == "process"
        stoppable = np.sqrt(2 * second.acceleration * (second.length - self.after))
        reachable = np.sqrt(speed**2 + 2 * first.acceleration * (first.length - start - self.before))
        self.entering = min(first.speed, reachable)
        self._rounded = first.straight and second.straight and first.in_joints == second.in_joints
        if not self._rounded:
            self.leaving = min(second.speed, stoppable)
            self.duration = self.before / self.entering + self.after / self.leaving
        elif keeps:
            self._keep_speed(stoppable)
        else:
            self.leaving = min(second.speed, stoppable)
            self.duration = 2 * min(self.before / self.entering, self.after / self.leaving)
            self.before, self.after = self.entering * self.duration / 2, self.leaving * self.duration / 2

    def joints(self, t: np.ndarray, near: np.ndarray) -> np.ndarray:
        """(K, 6) joint positions at t (K,) from the begin of the blend."""
        if not self._rounded:
            return self._between(t / self.duration, near)
        u = self._place_on_curve(t)[:, None]
        return self._first.joints((1 - u) ** 2 * self._ends[0] + u**2 * self._ends[1], near)

    @property
    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (6,) of both ends from the corner: the rounded corner is (1 - u)² of one and u² of the other."""
        first, second = self._first, self._second
        return first.offset * (self.before / first.length), -second.offset * (self.after / second.length)

    def _keep_speed(self, stoppable: float) -> None:
        moved = [stretch.offset[: 6 if stretch.in_joints else 3] for stretch in (self._first, self._second)]
        part = len(moved[0]) if min(np.linalg.norm(m) for m in moved) > _NOTHING else 6
        per_length = [
            float(np.linalg.norm(stretch.offset[:part])) / stretch.length for stretch in (self._first, self._second)
        ]
        self.entering = min(self.entering, stoppable * per_length[1] / per_length[0])
        u = np.linspace(0.0, 1.0, _FINE)
        curve = np.outer((1 - u) ** 2, self._ends[0]) + np.outer(u**2, self._ends[1])
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve[:, :part], axis=0), axis=1))])
        even = np.linspace(0.0, travelled[-1], _FINE // 4)
        along = np.transpose([np.interp(even, travelled, column) for column in curve.T])
        bent = np.abs(np.diff(along, 2, axis=0)).max(axis=0) / even[1] ** 2
        limits = _SHARPEST if not self._first.in_joints else _SHARPEST[3]
        speed = min(self.entering * per_length[0], float(np.sqrt(np.min(limits / np.maximum(bent, _NOTHING)))))
        self.entering, self.leaving = speed / per_length[0], speed / per_length[1]
        self.duration = float(travelled[-1]) / speed
        self._place_on_curve = lambda t: np.interp(speed * t, travelled, u)

    def _between(self, u: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Where the stretches have no space in common: a cubic of the joints."""
        ends = []
        begin = self._first.length - self.before
        for stretch, s, speed in ((self._first, begin, self.entering), (self._second, self.after, self.leaving)):
            step = 1e-4 * stretch.length
            q = stretch.joints(stretch.offsets(np.array([s - step, s, s + step])), reference)
            ends.append((q[1], (q[2] - q[0]) / (2 * step) * speed * self.duration))
            reference = q[1]
        (q0, v0), (q1, v1) = ends
        u = u[:, None]
        return q0 + u * (v0 + u * (3 * (q1 - q0) - 2 * v0 - v1 + u * (2 * (q0 - q1) + v0 + v1)))


def trapezoid(length: float, v0: float, speed: float, v1: float, acceleration: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and speeds of the corners of a trapezoid over `length`, from v0 to v1 with at most `speed`.

    Where `length` is too short for the change of speed, the acceleration is what that takes.
    """
    peak = speed if v0 > speed else min(speed, np.sqrt(acceleration * max(length, 0.0) + (v0**2 + v1**2) / 2))
    ramps = (abs(peak**2 - v0**2) + abs(peak**2 - v1**2)) / (2 * acceleration)
    if length <= _NOTHING and v0 + v1 == 0:
        return np.zeros(2), np.zeros(2)
    if peak == 0 or ramps > length * (1 + 1e-9):
        return np.array([0.0, 2 * max(length, 0.0) / (v0 + v1)]), np.array([v0, v1])
    steps = [abs(peak - v0) / acceleration, max(length - ramps, 0.0) / peak, abs(peak - v1) / acceleration]
    return np.concatenate([[0.0], np.cumsum(steps)]), np.array([v0, peak, peak, v1])


def _circle(begin: np.ndarray, via: np.ndarray, end: np.ndarray) -> tuple[float, Callable[[np.ndarray], np.ndarray]]:
    """Length of the arc through three points (3,), and the points (K, 3) at s (K,) along it."""
    first, second = via - begin, end - begin
    normal = np.cross(first, second)
    squared = normal @ normal
    if squared < _NOTHING**2:
        length = float(np.linalg.norm(second))
        return length, lambda s: begin + np.outer(s / length, second)
    to_centre = np.cross(second * (first @ first) - first * (second @ second), normal) / (2 * squared)
    radius = float(np.linalg.norm(to_centre))
    x = -to_centre / radius
    y = np.cross(normal / np.sqrt(squared), x)
    last = (second - to_centre) / radius
    angle = float(np.arctan2(last @ y, last @ x) % (2 * np.pi))
    centre = begin + to_centre
    return (
        radius * angle,
        lambda s: centre + radius * (np.outer(np.cos(s / radius), x) + np.outer(np.sin(s / radius), y)),
    )
