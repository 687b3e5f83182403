"""The built-in interpolator: COMAU's FLY motion in every mode (`docs/decisions/fly-*.md`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from agent.compiled import tcp_rates
from agent.core import InputError
from agent.motion import rotation
from agent.motion.fly import rules
from agent.motion.fly.move_geometry import Segment
from agent.motion.fly.parameters import LONGEST, FlyParameters
from agent.motion.fly.profile import ArmLimits
from agent.motion.fly.runs import RunPlanner
from agent.motion.fly.segment_maker import SegmentMaker
from agent.motion.fly.setpoints import Run
from agent.motion.interpolator import MotionError
from agent.motion.program import Delay, Statement
from agent.motion.trajectory import BindingLimit, Trajectory
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot import Tool


#: One sample in this many is examined. A run is slowed down below this part of its programmed speed.
_EVERY, _REACHED = 5, 0.995
#: A limit is in force above this part of it.
_FULL = 0.7


class FlyInterpolator:
    """Plans MOVE and MOVEFLY programs at the controller's period.

    `tool` is the TCP of moves that name no $TOOL; `period` [s]; `parameters`: see `FlyParameters`.
    """

    def __init__(
        self,
        robot: RobotDescription,
        tool: Tool | None = None,
        period: float = 0.002,
        parameters: FlyParameters | None = None,
    ):
        if not 0.0 < period <= 0.1:
            raise InputError(f"period: {period} s; give the controller's period, more than 0 and at most 0.1 s")
        self.robot = robot
        self.period = period
        self.parameters = parameters or FlyParameters()
        self._planner = RunPlanner(robot, ArmLimits.of(robot, self.parameters), period, self.parameters)
        self._maker = SegmentMaker(robot, tool, self.parameters.turn_lever)

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) [rad] to rest; the first sample is `start` at t = 0.

        A move that does not fly, a DELAY, a change of $TOOL and a corner that turns back on itself are standstills.

        Raises:
            MotionError: out of reach, through a singularity, beyond a joint limit: names move, limit and amount.
            InputError: settings or points that make no sense.
        """
        plan = _Plan(self, self._maker.checked_start(start))
        for index, statement in enumerate(statements):
            if isinstance(statement, Delay):
                plan.run_pending()
                plan.rest(index, statement.seconds)
                continue
            segment = self._maker.segment(index, statement, plan.pending, plan.q)
            if segment is not None:
                plan.pending.append(segment)
            if not statement.fly:
                plan.run_pending()
        plan.run_pending()
        return plan.trajectory()


class _Plan:
    """A trajectory under construction: the joints at the last stop, the moves not yet planned, and the samples."""

    def __init__(self, interpolator: FlyInterpolator, q: np.ndarray):
        self.q = q
        self.pending: list[Segment] = []
        self._of = interpolator
        self._samples = 0
        self._runs: list[tuple[float, Run]] = []
        self._parts: list[tuple[np.ndarray, ...]] = []
        self._add_rest(0, 1)

    def rest(self, index: int, seconds: float) -> None:
        """A DELAY."""
        if not 0.0 <= seconds <= LONGEST:
            excess = seconds / LONGEST if seconds > LONGEST else 1.0
            message = f"statement {index + 1}: a DELAY of {seconds} s; it has to be 0 to {LONGEST:g} s"
            raise MotionError(message, index, "duration", excess)
        self._add_rest(index, round(seconds / self._of.period))

    def run_pending(self) -> None:
        """Plan the pending moves up to standstill."""
        if self.pending:
            for run in self._of._planner.plan(self.pending, self.q):
                self._add(run)
            self.pending = []

    def trajectory(self) -> Trajectory:
        """All samples up to now."""
        columns = zip(*self._parts, strict=True)
        q, qd, qdd, pose, speed, move = (
            np.concatenate(column, out=np.empty((self._samples, *column[0].shape[1:]), column[0].dtype))
            for column in columns
        )
        period = self._of.period
        binding = partial(_binding_limits, self._runs, self._of._planner.limits, self._of.robot.joint_names, period)
        return _Planned(pose, binding, t=np.arange(len(q)) * period, q=q, qd=qd, qdd=qdd, path_speed=speed, move=move)

    def _add_rest(self, index: int, count: int) -> None:
        pose = self._of._maker.pose_at(self.q)
        still = np.zeros((count, len(self.q)))
        self._parts.append(
            (
                np.tile(self.q, (count, 1)),
                still,
                still,
                np.tile(pose, (count, 1)),
                np.zeros(count),
                np.full(count, index),
            )
        )
        self._count(count, index)

    def _add(self, run: Run) -> None:
        samples, path = run.samples, run.path
        self._runs.append(((self._samples - 1) * self._of.period, run))
        # A sample at a knot belongs to the cell before it.
        ends = np.searchsorted(samples.s + path.s[0], path.s[:-1], side="right")
        counts = np.diff(ends, prepend=0, append=len(samples.s))
        speed = np.sqrt(np.einsum("is,is->s", samples.pose_rate[:3], samples.pose_rate[:3]))
        columns = (samples.q.T, samples.qd.T, samples.qdd.T, samples.pose.T, speed, np.repeat(path.move, counts))
        self._parts.append(tuple(column[1:] for column in columns))
        self._count(len(samples.s) - 1, int(path.move[-1]))
        self.q = path.q[-1]

    def _count(self, samples: int, index: int) -> None:
        self._samples += samples
        seconds = self._samples * self._of.period
        if seconds > LONGEST:
            message = f"statement {index + 1}: the program takes more than {LONGEST:g} s up to here; run it in parts"
            raise MotionError(message, index, "duration", seconds / LONGEST - 1.0)


class _Planned(Trajectory):
    """Poses, of rows (S, 7), and binding limits are computed on first use: a search never uses them."""

    def __init__(self, pose: np.ndarray, binding: Callable[[], tuple[BindingLimit, ...]], **values: np.ndarray):
        self.__dict__.update(values, _pose=pose, _binding=binding)  # a frozen dataclass is set like this

    @cached_property
    def tcp(self) -> np.ndarray:
        pose: np.ndarray = self.__dict__["_pose"]
        return rotation.to_pose(pose[:, :3], pose[:, 3:])

    @cached_property
    def binding(self) -> tuple[BindingLimit, ...]:
        limits: tuple[BindingLimit, ...] = self.__dict__["_binding"]()
        return limits


def _binding_limits(
    runs: list[tuple[float, Run]], limits: ArmLimits, joint_names: tuple[str, ...], period: float
) -> tuple[BindingLimit, ...]:
    """The limits in force where runs, each from its `begin` [s] on, are slower than programmed."""
    return tuple(one for begin, run in runs for one in _of_run(run, limits, joint_names, begin, period))


def _of_run(
    run: Run, limits: ArmLimits, joint_names: tuple[str, ...], begin: float, period: float
) -> list[BindingLimit]:
    """The limits in force where the run is slower than programmed, the fullest one at each time; `begin` [s].

    Stress and overrides reduce a limit, so the limit that is named may be below the arm's own.
    """
    samples, path = run.samples, run.path
    pick = slice(None, None, _EVERY)
    s, speed = samples.s[pick] + path.s[0], samples.speed[pick]
    knot = np.clip(np.searchsorted(path.s, s), 0, len(path.s) - 1)
    rule = path.rules[knot]
    with np.errstate(divide="ignore", invalid="ignore"):
        joint_full = np.max(np.abs(run.shape.q1[:, knot]) / limits.speed[:, None], axis=0)
        turning = rule[:, rules.ROTATIONAL] / run.shape.turn[knot]
        programmed = rule[:, rules.LINEAR] / run.shape.travel[knot]
        programmed = np.where(np.isfinite(programmed), programmed, turning)
        joint = np.where(rule[:, rules.JOINT] < 1.0, rule[:, rules.JOINT] / joint_full, np.inf)
        programmed = np.minimum(programmed, joint)
    allowed = rule[:, rules.STRESS] * np.maximum(rule[:, rules.ACCELERATION], rule[:, rules.DECELERATION])
    qd, qdd = samples.qd[:, pick], samples.qdd[:, pick]
    jerk = np.zeros_like(qdd)
    jerk[:, 1:] = (qdd[:, 1:] - samples.qdd[:, _EVERY - 1 :: _EVERY][:, : jerk.shape[1] - 1]) / period
    rates = tcp_rates(samples.rows, samples.joints)[:, pick]
    cartesian = limits.cartesian
    ceilings = (
        cartesian.linear_speed,
        cartesian.rotational_speed,
        cartesian.linear_acceleration * allowed / rule[:, rules.STRESS],
        cartesian.rotational_acceleration * allowed / rule[:, rules.STRESS],
    )
    full = np.concatenate(
        (
            np.abs(qd) / limits.speed[:, None],
            np.abs(qdd) / (limits.acceleration[:, None] * allowed),
            np.abs(jerk) / limits.jerk[:, None],
            rates / (np.stack([np.broadcast_to(ceiling, len(s)) for ceiling in ceilings]) * rule[:, rules.CARTESIAN]),
            np.where(path.overlap[knot] < 0.999, speed / np.maximum(programmed * path.overlap[knot], 1e-12), 0.0)[None],
            (speed / turning)[None],
        )
    )
    names = [f"{name} {what}" for what in ("speed", "acceleration", "jerk") for name in joint_names]
    names += ["linear speed", "rotational speed", "linear acceleration", "rotational acceleration", "FLY_NORM overlap"]
    names += ["programmed rotational speed"]
    slowed = speed < _REACHED * programmed
    slowed[[0, -1]] = len(s) > 2 and slowed[1], len(s) > 2 and slowed[-2]
    # Between two limits, where the acceleration changes its sign, none is full: the nearest one that was counts.
    certain = np.flatnonzero(slowed & (full.max(axis=0) > _FULL))
    nearest = np.arange(len(s))
    if len(certain):
        after = np.minimum(np.searchsorted(certain, nearest), len(certain) - 1)
        before = np.maximum(after - 1, 0)
        nearer = nearest - certain[before] <= certain[after] - nearest
        nearest = certain[np.where(nearer, before, after)]
    worst = np.where(slowed, np.argmax(full, axis=0)[nearest], -1)
    edges = np.concatenate(([0], 1 + np.flatnonzero(np.diff(worst)), [len(worst)]))
    end = begin + (len(samples.s) - 1) * period
    return [
        BindingLimit(names[worst[a]], begin + a * _EVERY * period, min(begin + b * _EVERY * period, end))
        for a, b in pairwise(edges)
        if worst[a] >= 0
    ]
