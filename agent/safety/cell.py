"""Whether a motion keeps clear: of the arm itself, of keep-out boxes and of the ends of the joint ranges.

Between two postures no distance shrinks faster than the joints can carry a body (`BodyPair.reach`). One posture in the
middle of a stretch therefore clears the whole stretch where its distances are larger than half the stretch can take
away, and only the other stretches are looked at more closely: branch and bound, over the continuous motion that is
linear in joint space between samples. Nothing that is deeper than `tolerance` is missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agent.core.errors import InputError
from agent.motion.trajectory import Trajectory
from agent.robot.description import Capsule, RobotDescription

if TYPE_CHECKING:
    from agent.robot.collision import Box, CollisionModel
    from agent.robot.dynamics import Tool

#: Radius [m] of the capsule from flange to TCP that stands for tool and payload.
TOOL_RADIUS = 0.05
#: Radius [m] of the links' capsules where the description has no bodies; these are checked against boxes only.
SKELETON_RADIUS = 0.05
#: The smallest clearance of a pair is found to this part of its distance from the margin.
RESOLUTION = 0.25
#: Joint positions so near to the end of a range [rad, m] are inside it.
RANGE_SLACK = 1e-6
_POSTURES = 64
_FIRST_STRETCHES = 64


@dataclass(frozen=True)
class PairClearance:
    """The smallest distance found between two bodies [m], negative where they overlap, and the sample it is at.

    `at_least`: no posture of the motion is nearer than this.
    """

    first: str
    second: str
    clearance: float
    at_least: float
    index: int


@dataclass(frozen=True)
class Violation:
    """The first violation of a motion: two bodies nearer than the margin, or a joint out of its range (`second` "").

    `index` of the sample at or before it, `time` [s] where the motion has times; `depth` is how far beyond the margin
    or range these two get on the whole motion [m, rad]; `stopping` says that it happens on the way to a stop that
    begins at the sample.
    """

    first: str
    second: str
    index: int
    time: float | None
    depth: float
    margin: float
    stopping: bool

    def __str__(self) -> str:
        where = f"sample {self.index}" if self.time is None else f"{self.time:.3f} s"
        begin = f"on the way to a stop from {where}" if self.stopping else f"at {where}"
        if not self.second:
            return f"{begin} {self.first} leaves its range, by {self.depth:.3g} (rad or m) at most"
        if self.margin > 0:
            amount = f"nearer than the margin of {1000 * self.margin:.0f} mm, by {1000 * self.depth:.1f} mm at most"
        else:
            amount = f"in collision, {1000 * self.depth:.1f} mm deep at most"
        return f"{begin} {self.first} and {self.second} are {amount}"


@dataclass(frozen=True, eq=False)
class CellReport:
    """What a check found.

    `pairs`: the smallest clearance of each pair; `clearance` the smallest of all [m], infinite where there is nothing
    to check; `collision`: the first violation in time, or None; `depth`: the deepest of all violations [m, rad], to
    rank motions by; `joint_margins` (n,): distance of each joint from the nearer end of its range [rad, m].
    """

    pairs: tuple[PairClearance, ...]
    clearance: float
    collision: Violation | None
    depth: float
    joint_margins: np.ndarray


class Cell:
    """An arm with its tool among keep-out boxes. Not thread-safe.

    `keep_out`: boxes with `name`, `minimum` and `maximum` (3,) in the base frame [m]. `joint_ranges`: by joint name,
    (lower, upper) [rad, m] where a cable or the cell allows less than the joint itself. `tolerance` [m]: no collision
    deeper than this is missed.

    Raises:
        InputError: a joint range for a joint that the robot has not, or an empty one.
    """

    def __init__(
        self,
        robot: RobotDescription,
        tool: Tool | None = None,
        keep_out: Sequence[Box] = (),
        joint_ranges: Mapping[str, tuple[float, float]] | None = None,
        tool_radius: float = TOOL_RADIUS,
        tolerance: float = 0.001,
    ):
        self.robot = robot
        self.tolerance = tolerance
        self.lower, self.upper = position_ranges(robot, joint_ranges or {})
        self._model = _collision_model(robot, tool, keep_out, tool_radius)
        self.left_out, self._largest_margins, self._widest = self._try_many_postures()

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the pairs that are checked."""
        return tuple((pair.first, pair.second) for pair in self._model.pairs)

    def check(self, motion: Trajectory | np.ndarray, margin: float = 0.0) -> CellReport:
        """Check a motion, a trajectory or joint positions (S, n): every distance at least `margin` [m].

        Between two bodies of the arm that are never far apart the margin is half their widest distance at most.
        """
        q, times = _samples(motion)
        return self._report(q, None, times, margin)

    def check_with_stopping(
        self, motion: Trajectory, margin: float = 0.0, deceleration: np.ndarray | None = None
    ) -> CellReport:
        """Check a motion and, from each of its samples, the way to a stop.

        A stop takes each joint q̇ |q̇| / (2 a) farther, together in a straight line in joint space; a (n,) is
        `deceleration` [rad/s², m/s²], the description's `max_acceleration` where it is not given.
        """
        q, times = _samples(motion)
        limits = self.robot.max_acceleration if deceleration is None else np.asarray(deceleration, dtype=float)
        return self._report(q, motion.qd * np.abs(motion.qd) / (2 * limits), times, margin)

    def clearance(self, q: np.ndarray) -> np.ndarray:
        """(S,) smallest distance [m] at each of the joint positions (S, n), for a curve over time."""
        if not self._model.pairs:
            return np.full(len(q), np.inf)
        return self._model.distances(np.asarray(q, dtype=float)).min(axis=1)

    def check_boxes(self, margin: float = 0.0) -> None:
        """Refuse boxes that no motion can keep clear of.

        Raises:
            InputError: a body of the arm is nearer than `margin` [m] to a box in every one of many postures.
        """
        from agent.robot.collision import KEEP_OUT

        for pair, widest in zip(self._model.pairs, self._widest, strict=True):
            if pair.second.startswith(KEEP_OUT) and not widest >= margin:
                raise InputError(
                    f"{pair.first} is in {pair.second}, or nearer to it than {1000 * margin:.0f} mm, in each of "
                    f"{_POSTURES} postures all over the joint ranges: no motion can keep clear of it. Make the box "
                    "smaller; where the robot itself stands there needs to be none"
                )

    def _report(self, q: np.ndarray, stop: np.ndarray | None, times: np.ndarray | None, margin: float) -> CellReport:
        if not (np.isfinite(q).all() and (stop is None or np.isfinite(stop).all())):
            raise ValueError("joint positions and ways to a stop must be finite")
        if not 0.0 <= margin < np.inf:
            raise ValueError("the margin must be a number, zero or more")
        found = [*self._range_violations(q, stop, times)]
        pairs: tuple[PairClearance, ...] = ()
        depth = 0.0
        if self._model.pairs:
            search = _Search(self._model, q, stop, np.minimum(margin, self._largest_margins), self.tolerance)
            search.run()
            pairs = search.clearances()
            found += search.first_violation(times)
            depth = max(depth, search.depth())
        clearance = min((pair.clearance for pair in pairs), default=np.inf)
        depth = max([depth, *(violation.depth for violation in found)])
        ends = [q] if stop is None else [q, q + stop]
        margins = np.min([np.minimum(end - self.lower, self.upper - end).min(axis=0) for end in ends], axis=0)
        first = min(found, key=lambda violation: violation.index, default=None)
        return CellReport(pairs, clearance, first, depth, margins)

    def _range_violations(
        self, q: np.ndarray, stop: np.ndarray | None, times: np.ndarray | None
    ) -> Sequence[Violation]:
        found = []
        for positions, stopping in ((q, False), (None if stop is None else q + stop, True)):
            if positions is None:
                continue
            beyond = np.maximum(self.lower - positions, positions - self.upper)
            outside = ~(beyond <= RANGE_SLACK)
            for joint in np.flatnonzero(outside.any(axis=0)):
                index = int(np.argmax(outside[:, joint]))
                time = None if times is None else float(times[index])
                depth = float(beyond[:, joint].max())
                found.append(Violation(self.robot.joint_names[joint], "", index, time, depth, 0.0, stopping))
        return found

    def _try_many_postures(self) -> tuple[tuple[tuple[str, str], ...], np.ndarray, np.ndarray]:
        """What is left out; of each pair that stays, the largest margin and the widest distance found.

        Left out are pairs of the arm's bodies that overlap in every posture: capsules too coarse to tell anything. A
        margin means nothing for two that no posture takes so far apart: neighbours but one, a wrist and its tool.
        """
        from agent.robot.collision import KEEP_OUT

        if not self._model.pairs:
            return (), np.zeros(0), np.zeros(0)
        lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (self.lower, self.upper))
        postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, self.robot.dof))
        postures[0] = np.clip(0.0, self.lower, self.upper)
        widest = self._model.distances(postures).max(axis=0)
        own = np.array([not pair.second.startswith(KEEP_OUT) for pair in self._model.pairs])
        touching = own & (widest < 0)
        always = [pair for pair, touches in zip(self._model.pairs, touching, strict=True) if touches]
        self._model.leave_out(always)
        largest = np.where(own, widest / 2, np.inf)[~touching]
        return tuple((pair.first, pair.second) for pair in always), largest, widest[~touching]


class _Search:
    """Branch and bound over stretches of the motion u and, where there is a `stop`, of the way to a stop s in [0, 1].

    `margin` (pairs,) [m]. The posture is q(u) + s · stop(u), u counting samples. A stretch is the rectangle u0..u1,
    s0..s1; its bound is the distance in its middle less what the joints can take away on the way to its edges.
    """

    def __init__(
        self, model: CollisionModel, q: np.ndarray, stop: np.ndarray | None, margin: np.ndarray, tolerance: float
    ):
        self.model, self.q, self.stop, self.margin, self.tolerance = model, q, stop, margin, tolerance
        reach = np.array([pair.reach for pair in model.pairs]).T  # (n, pairs)
        self.travelled = _cumulated(q) @ reach
        self.stop_changed = None if stop is None else _cumulated(stop) @ reach
        self.stop_length = None if stop is None else np.abs(stop) @ reach
        count = len(model.pairs)
        self.smallest = np.full(count, np.inf)
        self.smallest_at = np.zeros(count)
        self.at_least = np.full(count, np.inf)
        self.first: tuple[float, int, bool] | None = None  # u, pair, on the way to a stop

    def run(self) -> None:
        edges = np.linspace(0.0, len(self.q) - 1.0, min(len(self.q), _FIRST_STRETCHES) + 1)
        edges = np.concatenate([[0.0], edges])  # the start by itself: it may be where the arm stands now
        stretches = np.zeros((len(edges) - 1, 4))
        stretches[:, 0], stretches[:, 1] = edges[:-1], edges[1:]
        stretches[:, 3] = 0.0 if self.stop is None else 1.0
        is_open = np.ones((len(stretches), len(self.model.pairs)), dtype=bool)
        while len(stretches):
            along, aside = self._radius(stretches)
            middle = (stretches[:, [0, 2]] + stretches[:, [1, 3]]) / 2
            distances = self.model.distances(self._postures(middle), is_open.any(axis=0))
            if np.isnan(distances).any():
                raise InputError("the distance of two bodies is no number; look at the robot's bodies and at the boxes")
            self._note(middle, distances)
            bounds = distances - along - aside
            was_open, is_open = is_open, is_open & self._undecided(stretches, bounds)
            decided = np.where(was_open & ~is_open, bounds, np.inf)
            self.at_least = np.minimum(self.at_least, decided.min(axis=0))
            going_on = is_open.any(axis=1)
            across_u = np.where(is_open, along, 0.0).max(axis=1) >= np.where(is_open, aside, 0.0).max(axis=1)
            stretches = _halves(stretches[going_on], across_u[going_on])
            is_open = np.concatenate([is_open[going_on]] * 2)

    def clearances(self) -> tuple[PairClearance, ...]:
        return tuple(
            PairClearance(pair.first, pair.second, float(distance), float(min(bound, distance)), int(u))
            for pair, distance, bound, u in zip(
                self.model.pairs, self.smallest, self.at_least, self.smallest_at, strict=True
            )
        )

    def first_violation(self, times: np.ndarray | None) -> Sequence[Violation]:
        if self.first is None:
            return []
        u, pair, stopping = self.first
        names = self.model.pairs[pair]
        time = None if times is None else float(np.interp(u, np.arange(len(times)), times))
        margin = float(self.margin[pair])
        depth = margin - float(self.smallest[pair])
        return [Violation(names.first, names.second, int(u), time, depth, margin, stopping)]

    def depth(self) -> float:
        """How far the worst pair is beyond its margin [m]; negative where none is."""
        return float(np.max(self.margin - self.smallest))

    def _postures(self, middle: np.ndarray) -> np.ndarray:
        postures = _at(self.q, middle[:, 0])
        return postures if self.stop is None else postures + middle[:, 1:] * _at(self.stop, middle[:, 0])

    def _radius(self, stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(R, pairs) what the joints can take away along u, and along s."""
        u0, u1, s0, s1 = stretches.T
        middle = (u0 + u1) / 2

        def half(cumulated: np.ndarray) -> np.ndarray:
            there = _at(cumulated, middle)
            return np.maximum(there - _at(cumulated, u0), _at(cumulated, u1) - there)

        along = half(self.travelled)
        if self.stop_changed is None or self.stop_length is None:
            return along, np.zeros_like(along)
        along = along + s1[:, None] * half(self.stop_changed)
        return along, (s1 - s0)[:, None] / 2 * _at(self.stop_length, middle)

    def _note(self, middle: np.ndarray, distances: np.ndarray) -> None:
        nearest = distances.argmin(axis=0)
        found = distances[nearest, np.arange(distances.shape[1])]
        better = found < self.smallest
        self.smallest = np.where(better, found, self.smallest)
        self.smallest_at = np.where(better, middle[nearest, 0], self.smallest_at)
        short = distances - self.margin
        violating = np.flatnonzero(~(short.min(axis=1) >= 0))
        if len(violating):
            row = violating[np.argmin(middle[violating, 0])]
            if self.first is None or middle[row, 0] < self.first[0]:
                self.first = (float(middle[row, 0]), int(short[row].argmin()), bool(middle[row, 1] > 0))

    def _undecided(self, stretches: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """(R, pairs) where there may be a smaller clearance worth knowing, or an earlier violation."""
        target = self.smallest - np.maximum(self.tolerance, RESOLUTION * np.abs(self.smallest - self.margin))
        earlier = stretches[:, :1] < (np.inf if self.first is None else self.first[0] - 1.0)  # to the sample
        return (bounds < target) | (earlier & (bounds < self.margin - self.tolerance))


def _halves(stretches: np.ndarray, across_u: np.ndarray) -> np.ndarray:
    """Each stretch cut in the middle of u, or of s."""
    lower, upper = stretches.copy(), stretches.copy()
    rows, column = np.arange(len(stretches)), np.where(across_u, 0, 2)
    middle = (stretches[rows, column] + stretches[rows, column + 1]) / 2
    lower[rows, column + 1] = middle
    upper[rows, column] = middle
    return np.concatenate([lower, upper])


def _cumulated(values: np.ndarray) -> np.ndarray:
    """(S, n) how far each joint has gone up to each sample."""
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(np.abs(np.diff(values, axis=0)), axis=0)])


def _at(values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Rows of `values` (S, …) at real-valued indices u (R,), linear between samples."""
    below = np.minimum(u.astype(int), max(len(values) - 2, 0))
    above = np.minimum(below + 1, len(values) - 1)
    part = (u - below)[:, None]
    return values[below] * (1 - part) + values[above] * part


def _samples(motion: Trajectory | np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    if isinstance(motion, Trajectory):
        return motion.q, motion.t
    return np.atleast_2d(np.asarray(motion, dtype=float)), None


def position_ranges(
    robot: RobotDescription, narrower: Mapping[str, tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) lower and (n,) upper ends of the joints' ranges [rad, m], where `narrower` allows less than the joint.

    Raises:
        InputError: a range for a joint that the robot has not, or an empty one.
    """
    lower, upper = robot.position_limits
    for name, (low, high) in narrower.items():
        if name not in robot.joint_names:
            raise InputError(f"joint range of {name}: {robot.name} has {', '.join(robot.joint_names)}")
        joint = robot.joint_names.index(name)
        lower[joint], upper[joint] = np.maximum(lower[joint], low), np.minimum(upper[joint], high)
        if not lower[joint] < upper[joint]:
            raise InputError(f"joint range of {name}: nothing is left of it ({low:g} to {high:g})")
    return lower, upper


def _collision_model(
    robot: RobotDescription, tool: Tool | None, keep_out: Sequence[Box], tool_radius: float
) -> CollisionModel:
    from agent.robot.collision import KEEP_OUT, Body, CollisionModel, skeleton

    bodies = [Body(link, link, capsules) for link, capsules in robot.bodies.items()]
    bodies = bodies or list(skeleton(robot, SKELETON_RADIUS))
    if tool is not None:
        x, y, z = (float(value) for value in np.asarray(tool.frame)[:3, 3])
        bodies.append(Body("tool", robot.tip_frame, (Capsule((0.0, 0.0, 0.0), (x, y, z), tool_radius),)))
    model = CollisionModel(robot, bodies, keep_out)
    if not robot.bodies:
        model.leave_out([pair for pair in model.pairs if not pair.second.startswith(KEEP_OUT)])
    return model
