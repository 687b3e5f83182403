"""The built-in interpolator: COMAU's FLY motion in every mode (`docs/decisions/fly-*.md`)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion import rotation
from agent.motion.fly.binding import binding_limits
from agent.motion.fly.profile import ArmLimits
from agent.motion.fly.runs import RunPlanner
from agent.motion.fly.segments import SegmentMaker
from agent.motion.fly.setpoints import Run
from agent.motion.fly.time_law import samples_in
from agent.motion.fly_parameters import FlyParameters
from agent.motion.interpolator import MotionError
from agent.motion.path.segments import Segment
from agent.motion.program import Delay, Statement
from agent.motion.trajectory import BindingLimit, Trajectory
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot import Tool


class FlyInterpolator:
    """Plans MOVE and MOVEFLY programs at the controller's period.

    `tool` is the TCP of moves that name no $TOOL; `period` [s]; `parameters` are what public sources leave open.
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

    def with_parameters(self, parameters: FlyParameters) -> FlyInterpolator:
        """The same with other parameters; what it knows of the arm is shared."""
        other = copy(self)
        other.parameters = parameters
        other._planner = RunPlanner(self.robot, ArmLimits.of(self.robot, parameters), self.period, parameters)
        other._maker = self._maker.with_lever(parameters.turn_lever)
        return other

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
    """A trajectory in the making: where the arm rests, the moves not yet planned, and the samples so far."""

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
        longest = self._of.parameters.longest
        if not 0.0 <= seconds <= longest:
            excess = seconds / longest if seconds > longest else 1.0
            message = f"statement {index + 1}: a DELAY of {seconds} s; it has to be 0 to {longest:g} s"
            raise MotionError(message, index, "duration", excess)
        self._add_rest(index, round(seconds / self._of.period))

    def run_pending(self) -> None:
        """Plan the pending moves up to standstill."""
        if self.pending:
            for run in self._of._planner.plan(self.pending, self.q):
                self._add(run)
            self.pending = []

    def trajectory(self) -> Trajectory:
        """All samples so far."""
        columns = zip(*self._parts, strict=True)
        q, qd, qdd, pose, speed, move = (
            np.concatenate(column, out=np.empty((self._samples, *column[0].shape[1:]), column[0].dtype))
            for column in columns
        )
        return _Planned(self._of, q, qd, qdd, pose, speed, move, tuple(self._runs))

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
        counts = samples_in(path.s[:-1], samples.s + path.s[0], "right")
        speed = np.sqrt(np.einsum("is,is->s", samples.pose_rate[:3], samples.pose_rate[:3]))
        columns = (samples.q.T, samples.qd.T, samples.qdd.T, samples.pose.T, speed, np.repeat(path.move, counts))
        self._parts.append(tuple(column[1:] for column in columns))
        self._count(len(samples.s) - 1, int(path.move[-1]))
        self.q = path.q[-1]

    def _count(self, samples: int, index: int) -> None:
        self._samples += samples
        seconds, longest = self._samples * self._of.period, self._of.parameters.longest
        if seconds > longest:
            message = f"statement {index + 1}: the program takes more than {longest:g} s up to here; run it in parts"
            raise MotionError(message, index, "duration", seconds / longest - 1.0)


class _Planned(Trajectory):
    """Poses and the limits that bind are worked out when they are asked for: a search never asks for them."""

    def __init__(
        self,
        of: FlyInterpolator,
        q: np.ndarray,
        qd: np.ndarray,
        qdd: np.ndarray,
        pose: np.ndarray,
        speed: np.ndarray,
        move: np.ndarray,
        runs: tuple[tuple[float, Run], ...],
    ):
        values = {"t": np.arange(len(q)) * of.period, "q": q, "qd": qd, "qdd": qdd, "path_speed": speed, "move": move}
        limits, names = of._planner.limits, of.robot.joint_names
        # A frozen dataclass is set like this.
        self.__dict__.update(values, _pose=pose, _runs=runs, _limits=limits, _names=names, _period=of.period)

    @cached_property
    def tcp(self) -> np.ndarray:
        pose: np.ndarray = self.__dict__["_pose"]
        return rotation.to_pose(pose[:, :3], pose[:, 3:])

    @cached_property
    def binding(self) -> tuple[BindingLimit, ...]:
        limits, names, period, runs = (self.__dict__[name] for name in ("_limits", "_names", "_period", "_runs"))
        return tuple(found for begin, run in runs for found in binding_limits(run, limits, names, begin, period))
