"""Programs of joint trajectories: their text, and the law by which a JointTrajectoryController joins the points.

A text has one JSON object a line; lines that begin with # are comments:

    {"program": "excite", "joint_names": ["joint_1", …]}
    {"to": [0.0, …], "velocity": [0.3, …], "acceleration": [1.0, …]}     from where the arm rests; limits of each joint
    {"rest": 0.5}                                                         [s]
    {"cycles": 10, "goal": {"trajectory": …, "path_tolerance": …}}        FollowJointTrajectory goals, sent in turn

A goal is the message itself: rest to rest, with positions, velocities and accelerations. Its first point is where the
arm stands, `LEAD` after the start, and every joint has a path tolerance: what keeps the arm safe while nobody is there.
"""

from __future__ import annotations

import json
import math
import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from drivers.errors import RefusedError

#: Longest goal [s]: the arm goes on to its end when nobody is there any more.
LONGEST = 20.0
#: Time [s] from a trajectory's stamp to its first point, at least: a controller jumps to a point that is due.
LEAD = 0.2
#: Largest path tolerance [rad, m].
WIDEST = 0.2
#: Rows of a point, as messages call them.
RATES = ("positions", "velocities", "accelerations")
_SHORTEST = 0.5  # s, of a move from where the arm rests
_SETTLED = 0.5  # s, between the last point and the duration that is allowed, for rounding and the lead
_PARTS = 10  # goals of one move, at most
_LINES, _POINTS, _CYCLES, _REST = 100_000, 10_000, 1_000_000, 3600.0
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
# A quintic from rest to rest over e in T seconds: peak speed 15/8 e/T, peak acceleration 10/√3 e/T².
_SPEED, _ACCELERATION = 15 / 8, 10 / math.sqrt(3)


@dataclass(frozen=True, eq=False)
class JointSpline:
    """Points at times t (K,) [s]: q, qd and qdd (K, n). Between a and b, with d = t_b − t_a, s = t − t_a, e = q_b − q_a

        q(s) = q_a + v_a s + a_a/2 s² + c₃ s³ + c₄ s⁴ + c₅ s⁵
        c₃ = ( 20 e − (8 v_b + 12 v_a) d − (3 a_a − a_b) d²) / (2 d³)
        c₄ = (−30 e + (14 v_b + 16 v_a) d + (3 a_a − 2 a_b) d²) / (2 d⁴)
        c₅ = ( 12 e − 6 (v_a + v_b) d − (a_a − a_b) d²) / (2 d⁵)

    as in joint_trajectory_controller of ros2_controllers (trajectory.cpp, Humble to Kilted).
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray

    @property
    def duration(self) -> float:
        """Time [s] of the last point."""
        return float(self.t[-1])

    def stretched(self, factor: float) -> JointSpline:
        """The same path, slower by the factor."""
        return JointSpline(self.t * factor, self.q, self.qd / factor, self.qdd / factor**2)

    def later(self, seconds: float) -> JointSpline:
        """The same, begun later by `seconds`."""
        return JointSpline(self.t + seconds, self.q, self.qd, self.qdd)

    def after_rest_at(self, start: np.ndarray) -> JointSpline:
        """Led to from rest at `start` (n,) at time 0, as a controller does."""
        nothing = np.zeros_like(start)
        rows = (np.vstack(pair) for pair in ((start, self.q), (nothing, self.qd), (nothing, self.qdd)))
        return JointSpline(np.concatenate([[0.0], self.t]), *rows)

    def at(self, t: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, qd, qdd at times t (S,) or one; stationary before and after."""
        k = np.minimum(np.maximum(np.searchsorted(self.t, t, side="right") - 1, 0), len(self.t) - 2)
        s = np.asarray(np.minimum(np.maximum(t, self.t[0]), self.t[-1]) - self.t[k])[..., None]
        c0, c1, c2, c3, c4, c5 = self._coefficients[:, k]
        q = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
        q[np.asarray(t >= self.t[-1])] = self.q[-1]  # to the last digit: a motion that begins there has no way to go
        qd = c1 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))
        return q, qd, 2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))

    def position(self, t: float) -> np.ndarray:
        """q (n,) of `at` at one time, in a tenth of its time: a guard asks for it at every sample."""
        k = min(max(bisect_right(self._times, t) - 1, 0), len(self._times) - 2)
        s = min(max(t, self._times[0]), self._times[-1]) - self._times[k]
        q: np.ndarray = np.array((1.0, s, s**2, s**3, s**4, s**5)) @ self._coefficients[:, k]
        return q

    @cached_property
    def _times(self) -> list[float]:
        times: list[float] = self.t.tolist()
        return times

    @cached_property
    def _coefficients(self) -> np.ndarray:
        d, e = np.diff(self.t)[:, None], np.diff(self.q, axis=0)
        (va, vb), (aa, ab) = ((rows[:-1], rows[1:]) for rows in (self.qd, self.qdd))
        c3 = (20 * e - (8 * vb + 12 * va) * d - (3 * aa - ab) * d**2) / (2 * d**3)
        c4 = (-30 * e + (14 * vb + 16 * va) * d + (3 * aa - 2 * ab) * d**2) / (2 * d**4)
        c5 = (12 * e - 6 * (va + vb) * d - (aa - ab) * d**2) / (2 * d**5)
        return np.array([self.q[:-1], va, aa / 2, c3, c4, c5])


def rest_to_rest(start: np.ndarray, end: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> JointSpline:
    """One quintic from rest to rest (n,) that keeps these limits (n,) [rad/s, rad/s²]; at least half a second."""
    distance = np.abs(end - start)
    seconds = max(
        _SHORTEST, np.max(_SPEED * distance / velocity), np.sqrt(np.max(_ACCELERATION * distance / acceleration))
    )
    nothing = np.zeros((2, len(start)))
    return JointSpline(np.array([0.0, seconds]), np.array([start, end]), nothing, nothing)


def parts(start: np.ndarray, end: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Where (K, n) the goals of such a move end: equal parts of its way, as few as take at most `LONGEST` each.

    Raises:
        RefusedError: the move would take too many.
    """
    distance = np.abs(end - start) / LONGEST
    ratio = max(np.max(_SPEED * distance / velocity), np.max(_ACCELERATION * distance / acceleration / LONGEST))
    if not ratio <= _PARTS:
        raise RefusedError(
            f"a move of more than {_PARTS * LONGEST:g} s; {_PARTS} goals of {LONGEST:g} s are allowed: move faster, or "
            "bring the arm nearer by hand"
        )
    count = max(1, math.ceil(ratio - 1e-6))
    share = np.arange(1, count + 1)[:, None] / count
    ends: np.ndarray = np.where(share == 1.0, end, start + share * (end - start))
    return ends


@dataclass(frozen=True, eq=False)
class Step:
    """A line: a goal that is run `cycles` times, `points` with the `tolerance` (n,) of their path; a move `to` (3, n)
    (position, and limits of velocity and acceleration) from where the arm rests; or a `rest` [s] before the next."""

    line: int
    cycles: int = 1
    points: JointSpline | None = None
    to: np.ndarray | None = None
    rest: float = 0.0
    tolerance: np.ndarray | None = None

    def from_(self, position: np.ndarray) -> JointSpline:
        """The points for an arm that rests at `position` (n,); of a move that takes several goals, those of the first.

        Raises:
            RefusedError: the move would take too long.
        """
        if self.points is not None:
            return self.points
        assert self.to is not None
        # A controller sets out for the first point at once, whatever the stamp: the first is where the arm rests.
        return rest_to_rest(position, parts(position, *self.to)[0], *self.to[1:]).later(LEAD)


@dataclass(frozen=True, eq=False)
class GoalProgram:
    """A program: its name, joints, and steps in order."""

    text: str
    name: str
    joints: tuple[str, ...]
    steps: tuple[Step, ...]

    @property
    def fastest(self) -> np.ndarray:
        """(n,) largest velocity of each joint in its goals [rad/s]."""
        return self._largest(1)

    @property
    def fastest_change(self) -> np.ndarray:
        """(n,) largest acceleration of each joint in its goals [rad/s²]."""
        return self._largest(2)

    def _largest(self, derivative: int) -> np.ndarray:
        rows = [step.to[derivative] for step in self.steps if step.to is not None]
        splines = [step.points for step in self.steps if step.points is not None]
        rows += [np.abs((spline.qd, spline.qdd)[derivative - 1]).max(axis=0) for spline in splines]
        return np.max(rows, axis=0)

    def run(self) -> Iterator[Step]:
        """Its steps, each as often as it is run."""
        for step in self.steps:
            for _ in range(step.cycles):
                yield step

    @classmethod
    def of(cls, text: str, path: str = "the program") -> GoalProgram:
        """Of a text; `path` is named in messages.

        Raises:
            RefusedError: no program, or one whose goals could not be left alone; names path and line.
        """
        header: tuple[str, tuple[str, ...]] | None = None
        steps: list[Step] = []
        for number, row in enumerate(text.splitlines(), 1):
            if not row.strip() or row.lstrip().startswith("#"):
                continue
            try:
                data = json.loads(row)
                if not isinstance(data, dict):
                    raise ValueError("an object is expected")
                if header is None:
                    header = _header(data)
                elif len(steps) >= _LINES:
                    raise ValueError(f"more than {_LINES} lines")
                else:
                    steps.append(_step(data, header[1], number))
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
                what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
                raise RefusedError(f"{path}:{number}: not a line of a program of joint trajectories: {what}") from None
        if header is None or not steps:
            what = "no program of joint trajectories, or it moves nothing; its first line names program and joint_names"
            raise RefusedError(f"{path}: {what}")
        return cls(text, *header, tuple(steps))


def _header(data: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    name, joints = data["program"], tuple(data["joint_names"])
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise ValueError("the name of a program is a letter, then letters, digits and _")
    if not joints or not all(isinstance(joint, str) for joint in joints) or len(set(joints)) != len(joints):
        raise ValueError("joint_names has to name every joint once")
    return name, joints


def _step(data: dict[str, Any], joints: tuple[str, ...], line: int) -> Step:
    if "rest" in data:
        seconds = float(data["rest"])
        if not 0.0 <= seconds <= _REST:
            raise ValueError(f"a rest of {seconds} s; 0 to {_REST:g} s are allowed")
        return Step(line, rest=seconds)
    if "to" in data:
        to = np.array([_row(data[key], len(joints)) for key in ("to", "velocity", "acceleration")])
        if not np.all(to[1:] > 0.0):
            raise ValueError("velocity and acceleration have to be above zero")
        return Step(line, to=to)
    goal, cycles = data["goal"], data["cycles"]
    if type(cycles) is not int or not 1 <= cycles <= _CYCLES:
        raise ValueError(f"cycles is {cycles!r}; 1 to {_CYCLES} are allowed")
    if tuple(goal["trajectory"]["joint_names"]) != joints:
        raise ValueError("the joints of a goal have to be those of the program, in its order")
    limits = {entry["name"]: float(entry["position"]) for entry in goal["path_tolerance"]}
    if set(limits) != set(joints) or not all(0.0 < limit <= WIDEST for limit in limits.values()):
        raise ValueError(f"path_tolerance has to give every joint a position above 0 and at most {WIDEST:g}")
    points = _points(goal["trajectory"]["points"], len(joints))
    return Step(line, cycles, points, tolerance=np.array([limits[name] for name in joints]))


def _points(points: list[dict[str, Any]], count: int) -> JointSpline:
    if not 2 <= len(points) <= _POINTS:
        raise ValueError(f"{len(points)} points; 2 to {_POINTS} are allowed")
    times = [_seconds(point["time_from_start"]) for point in points]
    if not (times[0] >= LEAD - 1e-9 and all(b > a for a, b in pairwise(times))):
        raise ValueError(f"times have to rise, from {LEAD} s on")
    if not times[-1] <= LONGEST + _SETTLED:
        raise ValueError(
            f"a goal of {times[-1]:.1f} s; {LONGEST:g} s are allowed, as the arm goes on to its end by itself"
        )
    q, qd, qdd = (np.array([_row(point[key], count) for point in points]) for key in RATES)
    if np.any(qd[[0, -1]]) or np.any(qdd[[0, -1]]):
        raise ValueError("a goal has to begin and end stationary")
    return JointSpline(np.array(times), q, qd, qdd)


def _row(values: list[float], count: int) -> list[float]:
    row = [float(value) for value in values]
    if len(row) != count or not all(map(math.isfinite, row)):
        raise ValueError(f"{count} finite numbers are expected, one a joint")
    return row


def _seconds(time: dict[str, int]) -> float:
    whole, nano = time["sec"], time["nanosec"]
    if type(whole) is not int or type(nano) is not int or not (0 <= whole < 2**31 and 0 <= nano < 10**9):
        raise ValueError("a time has whole sec and nanosec")
    return whole + 1e-9 * nano
