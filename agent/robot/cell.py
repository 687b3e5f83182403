"""Whether a motion keeps clear: of the arm itself, of keep-out boxes and of the ends of the joint ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from agent.core import InputError
from agent.robot.clearance import CellReport, ClearanceSearch, Violation
from agent.robot.description import Box, Capsule, RobotDescription

if TYPE_CHECKING:
    from agent.robot.collision import CollisionModel
    from agent.robot.dynamics import Tool

#: Radius [m] of the capsule from flange to TCP that stands for tool and payload.
TOOL_RADIUS = 0.05
#: Radius [m] of the links' capsules where the description has no bodies; these are checked against boxes only.
SKELETON_RADIUS = 0.05
#: Joint positions so near to the end of a range [rad, m] are inside it.
RANGE_SLACK = 1e-6
_POSTURES = 64


class TimedMotion(Protocol):
    """Samples of a motion: times (S,) [s], positions and velocities (S, n)."""

    @property
    def t(self) -> np.ndarray: ...
    @property
    def q(self) -> np.ndarray: ...
    @property
    def qd(self) -> np.ndarray: ...


class Cell:
    """An arm with its tool among keep-out boxes. Not thread-safe.

    `keep_out`: boxes with `name`, `minimum` and `maximum` (3,) in the base frame [m]. `joint_ranges`: by joint name,
    (lower, upper) [rad, m] where a cable or the cell allows less than the joint itself. `tolerance` [m]: no collision
    deeper than this is missed.

    Raises:
        InputError: a joint range for a joint that the robot has not, or an empty one; a body or box that is no number.
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

    def check(self, motion: TimedMotion | np.ndarray, margin: float = 0.0) -> CellReport:
        """Check a motion, timed or joint positions (S, n): every distance at least `margin` [m].

        Between two bodies of the arm that are never far apart the margin is half their widest distance at most.
        """
        if isinstance(motion, np.ndarray):
            return self._report(np.atleast_2d(motion.astype(float)), None, None, margin)
        return self._report(motion.q, None, motion.t, margin)

    def check_with_stopping(self, motion: TimedMotion, margin: float = 0.0) -> CellReport:
        """Check a motion and, from each of its samples, the way to a stop.

        A stop takes each joint q̇ |q̇| / (2 a) farther, a its `max_acceleration`, together in a straight line in joint
        space.
        """
        stop = motion.qd * np.abs(motion.qd) / (2 * self.robot.max_acceleration)
        return self._report(motion.q, stop, motion.t, margin)

    def is_clear(self, motion: TimedMotion, margin: float = 0.0) -> bool:
        """Whether `check` is known to find nothing, at a part of its cost; where this is False it may still."""
        beyond = np.maximum(self.lower - motion.q, motion.q - self.upper)
        if not (beyond <= RANGE_SLACK).all():
            return False
        margins = np.minimum(margin, self._largest_margins)
        return (
            not self._model.pairs
            or ClearanceSearch(self._model, motion.q, None, margins, self.tolerance).all_keep_margin()
        )

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
        violations = self._range_violations(q, times, stopping=False)
        if stop is not None:
            violations += self._range_violations(q + stop, times, stopping=True)
        clearances: dict[tuple[str, str], float] = {}
        depth = 0.0
        if self._model.pairs:
            search = ClearanceSearch(self._model, q, stop, np.minimum(margin, self._largest_margins), self.tolerance)
            search.run()
            clearances = search.clearances()
            violations += search.first_violation(times)
            depth = max(depth, search.depth())
        depth = max([depth, *(violation.depth for violation in violations)])
        first = min(violations, key=lambda violation: violation.index, default=None)
        return CellReport(clearances, first, depth)

    def _range_violations(self, q: np.ndarray, times: np.ndarray | None, stopping: bool) -> list[Violation]:
        beyond = np.maximum(self.lower - q, q - self.upper)
        outside = ~(beyond <= RANGE_SLACK)
        violations = []
        for joint in np.flatnonzero(outside.any(axis=0)):
            index = int(np.argmax(outside[:, joint]))
            time = None if times is None else float(times[index])
            depth = float(beyond[:, joint].max())
            violations.append(Violation(self.robot.joint_names[joint], "", index, time, depth, 0.0, stopping))
        return violations

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
    sizes: list[tuple[str, tuple[float, ...]]] = [(box.name, (*box.minimum, *box.maximum)) for box in keep_out]
    sizes += [
        (body.name, (*capsule.start, *capsule.end, capsule.radius)) for body in bodies for capsule in body.capsules
    ]
    for name, numbers in sizes:  # of such a shape every distance would be a large one
        if not np.isfinite(numbers).all():
            raise InputError(f"cell: the size or place of {name} is no number, so nothing can be kept clear of it")
    model = CollisionModel(robot, bodies, keep_out)
    if not robot.bodies:
        model.leave_out([pair for pair in model.pairs if not pair.second.startswith(KEEP_OUT)])
    return model
