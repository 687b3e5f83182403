"""The built-in interpolator: COMAU's FLY motion in every mode (`docs/decisions/fly-*.md`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion import rotation
from agent.motion.fly.fly_parameters import LONGEST, FlyParameters
from agent.motion.fly.move_geometry import Segment
from agent.motion.fly.profile import ArmLimits
from agent.motion.fly.run_planner import RunPlanner
from agent.motion.fly.segment_maker import SegmentMaker
from agent.motion.fly.setpoints import Run
from agent.motion.interpolator import LazyTrajectory, MotionError, Trajectory
from agent.motion.program import Delay, Statement
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot import Tool


class FlyInterpolator:
    """Plans MOVE and MOVEFLY programs at the controller's period.

    `tool` is the TCP of moves that name no $TOOL; `period` [s]; `planner` is for the moves from one stop to the next.
    """

    def __init__(
        self,
        robot: RobotDescription,
        tool: Tool | None = None,
        period: float = 0.002,
        parameters: FlyParameters | None = None,
        planner: type[RunPlanner] = RunPlanner,
    ):
        if not 0.0 < period <= 0.1:
            raise InputError(f"period: {period} s; give the controller's period, more than 0 and at most 0.1 s")
        self.robot = robot
        self.period = period
        self.parameters = parameters or FlyParameters()
        self._planner = planner(robot, ArmLimits.of(robot, self.parameters), period, self.parameters)
        self._maker = SegmentMaker(robot, tool, self.parameters.turn_lever)

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) [rad] to rest; the first sample is `start` at t = 0.

        A move that does not fly, a DELAY, a change of $TOOL and a corner that turns back on itself are standstills.

        Raises:
            MotionError: out of reach, through a singularity, beyond a joint limit: names move, limit and amount.
            InputError: settings or points that make no sense.
        """
        made = _Unfinished(self._planner, self._maker, self._maker.checked_start(start))
        for index, statement in enumerate(statements):
            if isinstance(statement, Delay):
                made.run_pending()
                made.rest(index, statement.seconds)
                continue
            segment = self._maker.segment(index, statement, made.pending, made.q)
            if segment is not None:
                made.pending.append(segment)
            if not statement.fly:
                made.run_pending()
        made.run_pending()
        return made.trajectory()


class _Unfinished:
    """A trajectory under construction: the joints at the last stop, the moves not yet planned, and the samples."""

    def __init__(self, planner: RunPlanner, maker: SegmentMaker, q: np.ndarray):
        self.q = q
        self.pending: list[Segment] = []
        self._planner, self._maker = planner, maker
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
        self._add_rest(index, round(seconds / self._planner.period))

    def run_pending(self) -> None:
        """Plan the pending moves up to standstill."""
        if self.pending:
            for run in self._planner.plan(self.pending, self.q):
                self._add(run)
            self.pending = []

    def trajectory(self) -> Trajectory:
        """All samples up to now."""
        columns = zip(*self._parts, strict=True)
        q, qd, qdd, pose, speed, move = (
            np.concatenate(column, out=np.empty((self._samples, *column[0].shape[1:]), column[0].dtype))
            for column in columns
        )
        t = np.arange(len(q)) * self._planner.period
        late = {
            "tcp": lambda: rotation.to_pose(pose[:, :3], pose[:, 3:]),
            "binding": lambda: self._planner.binding_limits(self._runs),
        }
        return LazyTrajectory(late, t=t, q=q, qd=qd, qdd=qdd, path_speed=speed, move=move)

    def _add_rest(self, index: int, count: int) -> None:
        q, pose = np.tile(self.q, (count, 1)), np.tile(self._maker.pose_at(self.q), (count, 1))
        self._parts.append((q, np.zeros_like(q), np.zeros_like(q), pose, np.zeros(count), np.full(count, index)))
        self._count(count, index)

    def _add(self, run: Run) -> None:
        samples, path = run.samples, run.shape.path
        self._runs.append(((self._samples - 1) * self._planner.period, run))
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
        seconds = self._samples * self._planner.period
        if seconds > LONGEST:
            message = f"statement {index + 1}: the program takes more than {LONGEST:g} s up to here; run it in parts"
            raise MotionError(message, index, "duration", seconds / LONGEST - 1.0)
