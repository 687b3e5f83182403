"""Compares the set-points and measured positions of a motion with the plan that was checked.

The controller's interpolator is not known exactly, so samples are not compared one by one. Four conditions hold:

- Each sample is close to some point of the planned path, at no more than the planned speed around that point.
- These points advance along the path: the points of a sample are reached from those of the sample before, never
  backwards (as in the Fréchet distance of two paths). If several points fit, all are kept.
- The time along the path matches the plan, without pauses at stops and with or without what is too slow to be seen.
- The arm stands only where the plan stops, and its positions change as its reported speeds say.

The tool may leave its path by the distance that the cell was checked with (the FLY distance of the recipe). A joint may
move by the amount that this distance causes, by the row of the damped inverse Jacobian. A blend of another family turns
the tool earlier or later, so a joint may also differ by its planned motion nearby. Measured positions may lag behind
the set-points in time, and may differ by an error of the servos in addition.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agent.safety.planned_program import is_standstill
from agent.safety.reference_path import ReferencePath
from agent.safety.stuck_positions import FREEZE_WINDOW, FROZEN_SHARE, StuckPositions

if TYPE_CHECKING:
    from agent.motion import Trajectory
    from agent.robot import RobotDescription, Tool
    from drivers.protocol import SampleBlock

#: Seconds of the plan that may pass in one second: the controller need not slow down for a corner as the plan does.
AHEAD = 4.0
#: Longest time [s] that measured values may be behind the set-points, or ahead of them.
LAG, LEAD = 0.15, 0.05
#: The arm may be ahead or behind by a share of the time plus an allowance [s]. It is counted anew on a path that takes
#: `RESYNC_AFTER` [s] by plan.
#: A corner that one law flies through and another almost stops at costs v/a, 0.7 s at 1.2 m/s and 1.7 m/s²; over a few
#: moves, ramps, corners and jerk of two laws differ by 20 % (tests/safety/test_off_plan.py: laws drawn at random).
SHARE, ALLOWANCE, RESYNC_AFTER = 0.2, 0.7, 4.0
#: Samples this far apart [s] say nothing about the time between them.
GAP = 0.1
#: No joint is farther than this [rad, m] or faster, and no torque is larger [N·m, N].
FARTHEST = 1e6
_COLUMNS = {
    "position": "measured positions",
    "velocity": "velocities",
    "torque": "torques",
    "current": "currents",
    "reference_position": "set-points",
    "reference_velocity": "speeds of set-points",
}
#: Samples of this duration [s] are judged together: a link may deliver them one by one.
BATCH_DURATION = 0.016
_BLOCKS, _ROWS = 16, 64  # at once


@dataclass(frozen=True)
class Tolerance:
    """Tolerances on differences from the plan.

    `tool` [m] and `joint` [rad, m] are distances from the path beyond the margin that the cell was checked with. The
    speed over `span` [s] may exceed the plan by a share `faster` of it and a share `floor` of the joint's limit. Below
    a share `resting` of its limit, a joint counts as stationary.
    """

    tool: float
    joint: float
    faster: float
    floor: float
    span: float
    resting: float


#: No margin is smaller than this [m]: blends and rounding of the controller.
SMALLEST_MARGIN = 0.005
SET_POINTS = Tolerance(tool=5e-5, joint=0.03, faster=0.3, floor=0.03, span=0.03, resting=1e-5)
#: As for set-points, plus an error of the servos and noise.
MEASURED = Tolerance(tool=0.015, joint=0.07, faster=0.3, floor=0.05, span=0.06, resting=0.003)


class Adherence:
    """Follows a motion along its plan, block by block.

    Args:
        chains: the plan from stop to stop, in order; at least one.
        robot, tool: the arm that moves.
        margin: distance from its path that the cell check allowed the tool [m].
        period: of the samples [s]; with their numbers it gives the motion time before the first sample.
        longest_rest: longest time [s] that the arm may stand at a stop, between its first and its last one.
    """

    def __init__(
        self,
        chains: Sequence[Trajectory],
        robot: RobotDescription,
        tool: Tool | None,
        margin: float,
        period: float,
        longest_rest: float = np.inf,
    ) -> None:
        from agent.robot import Dynamics

        self._robot = robot
        self._margin = max(margin, SMALLEST_MARGIN)
        self._dynamics = Dynamics(robot, tool)
        if len(chains) > 1 and is_standstill(chains[0]):
            chains = chains[1:]
        self._path = ReferencePath.of(chains, self._dynamics, self._margin, robot.max_velocity)
        self._stuck = StuckPositions(robot.max_velocity, GAP)
        self._longest_rest, self._stands_since = longest_rest, np.nan
        self._period = period
        self._began = np.nan
        self._last = 0.0
        #: The path points that fit the last sample: index of the first point, and a mask from there on.
        self._first, self._fits = 0, np.ones(1, dtype=bool)
        self._visible_time = self._path.moving(MEASURED.resting * robot.max_velocity)
        self._moved, self._mark = 0.0, (0.0, np.zeros(2))
        self._recent: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._waiting: list[SampleBlock] = []

    @property
    def remaining_time(self) -> float:
        """Seconds of the plan that the arm has not executed."""
        return float(self._path.plan_time[-1] - self._path.plan_time[self._first + len(self._fits) - 1])

    def ends_at(self, position: np.ndarray) -> bool:
        """Whether an arm that is stationary at `position` (n,) has arrived."""
        end = np.array([len(self._path.plan_time) - 1])
        return position.shape == self._path.q.shape[1:] and bool(self._near(position[None], MEASURED, end).all())

    def take(self, block: SampleBlock) -> str | None:
        """Take the next samples; return the reason if the arm has to stop."""
        self._waiting.append(block)
        few = len(self._waiting) < _BLOCKS  # of a clock that stands still, too
        if few and float(block.time[-1]) - float(self._waiting[0].time[0]) < BATCH_DURATION:
            return None
        return self.judge()

    def judge(self) -> str | None:
        """The result of `take` for the samples that it still holds back."""
        if not self._waiting:
            return None
        blocks, self._waiting = self._waiting, []
        time, measured = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("time", "position"))
        references = [block.reference_position for block in blocks if block.reference_position is not None]
        reference = np.concatenate(references) if len(references) == len(blocks) else None
        if not np.isfinite(time).all():
            return f"the controller sent times that are no numbers; {_FAULT}"
        for name, label in _COLUMNS.items():
            sent = [values for block in blocks if (values := getattr(block, name)) is not None]
            if not all(bool(np.all(np.abs(values) < FARTHEST)) for values in sent):
                return f"the controller sent {label} that are no numbers; {_FAULT}"
        if np.isnan(self._began):
            self._began = self._last = float(time[0]) - self._period * float(blocks[0].sequence[0])
        lost = np.flatnonzero(np.diff(time, prepend=self._last) > GAP)  # each of these has a long way to be on
        cuts = sorted({*range(0, len(time), _ROWS), *lost.tolist(), *(lost + 1).tolist(), len(time)})
        for part in (slice(*pair) for pair in itertools.pairwise(cuts)):
            reason = self._judge(time[part], measured[part], None if reference is None else reference[part])
            if reason is not None:
                return reason
        self._stuck.take(blocks)
        return self._standstill_fault(measured[-1], None if reference is None else reference[-1])

    def _standstill_fault(self, measured: np.ndarray, reference: np.ndarray | None) -> str | None:
        """Why an arm that is now at these positions (n,) may not stand, if it seems to stand."""
        at = f"{self._last - self._began:.2f} s into the motion"
        if (joint := self._stuck.contradicting_joint()) is not None:
            return (
                f"{at} the speed of {self._robot.joint_names[joint]} says that it moves, its positions do not change: "
                f"what the controller sends cannot be trusted; {_FAULT}"
            )
        crept, position, allowed = self._stuck.advance(), reference, SET_POINTS
        if position is None:
            position, allowed = measured, MEASURED
        points = self._first + np.flatnonzero(self._fits)
        nearest = points[np.argmin(self._path.distances(position, points))]
        slowest = float(self._path.slowest[self._path.rows[nearest]])
        if crept is None or not crept <= FROZEN_SHARE * FREEZE_WINDOW * max(slowest, allowed.resting):
            self._stands_since = np.nan
            return None
        if np.isnan(self._stands_since):
            self._stands_since = self._last
        stops = self._path.stops[(self._path.stops >= points[0]) & (self._path.stops <= points[-1])]
        close = stops[self._near(position[None], allowed, stops, SMALLEST_MARGIN)[0]] if len(stops) else stops
        if len(close) == 0:
            return (
                f"{at} the positions stand still where the plan does not stop: the arm was halted, or what the "
                f"controller sends is frozen; {_FAULT}"
            )
        if self._last - self._stands_since <= self._longest_rest or self._moved == 0.0 or self.remaining_time == 0.0:
            return None
        return f"{at} the arm has stood for more than {self._longest_rest:.1f} s at a stop of its program; {_FAULT}"

    def _judge(self, time: np.ndarray, measured: np.ndarray, reference: np.ndarray | None) -> str | None:
        """As `take`, for samples without NaN."""
        path, first, last = self._path, self._first, self._first + len(self._fits) - 1
        quantity, leading, allowed = (
            ("position", measured, MEASURED) if reference is None else ("set-point", reference, SET_POINTS)
        )
        passed = np.maximum(np.diff(time, prepend=self._last), 0.0)
        # Who knows how far it went while samples were lost: as far as it may in that time.
        ahead = np.minimum(AHEAD * passed, (1 + SHARE) * passed + ALLOWANCE)
        points = np.arange(first, path.index_at(path.plan_time[last] + float(ahead.sum()) + len(time) * path.step) + 1)
        fits, speed = self._fitting(quantity, leading, allowed, time, points)
        reached = np.zeros(len(points), dtype=bool)
        reached[: len(self._fits)] = self._fits
        firsts, lasts, reached = path.match_samples(fits, reached, first, passed, ahead, GAP, ALLOWANCE)
        if (k := len(firsts)) != len(time):
            return self._misfit_text(quantity, leading[k], speed[k], allowed, time[k], points[reached])
        self._first, self._fits = int(firsts[-1]), reached[firsts[-1] - first : lasts[-1] - first + 1]
        if reference is not None:
            reason = self._follow(measured, time, firsts, lasts)
            if reason is not None:
                return reason
        moving = np.any(speed > allowed.resting * self._robot.max_velocity, axis=1)
        return self._pace(time, passed, moving, self._visible_time if reference is None else path.plan_time)

    def _follow(self, measured: np.ndarray, time: np.ndarray, firsts: np.ndarray, lasts: np.ndarray) -> str | None:
        """Whether the measured positions match the set-points, or earlier ones."""
        path = self._path
        begin = path.index_at(path.plan_time[firsts] - LAG)
        end = path.index_at(path.plan_time[lasts] + LEAD)
        points = np.arange(begin.min(), end.max() + 1)
        fits, speed = self._fitting("position", measured, MEASURED, time, points)
        fits &= (points >= begin[:, None]) & (points <= end[:, None])
        if fits.any(axis=1).all():
            return None
        k = int(np.argmin(fits.any(axis=1)))
        return self._misfit_text("position", measured[k], speed[k], MEASURED, time[k], np.arange(begin[k], end[k] + 1))

    def _fitting(
        self, quantity: str, positions: np.ndarray, allowed: Tolerance, time: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mask (K, W) of the path's `points` (W,) that fit positions (K, n), and the speed (K, n) there."""
        speed, interval = self._speed(quantity, allowed.span, time, positions)
        fits, lost = self._near(positions, allowed, points), (interval > GAP)[:, None]
        for of_joint, fastest in zip(speed.T, self._fastest(allowed, points).T, strict=True):
            if not of_joint.max() <= fastest.min():
                fits &= (of_joint[:, None] <= fastest) | lost
        return fits, speed

    def _near(
        self, positions: np.ndarray, allowed: Tolerance, points: np.ndarray, margin: float | None = None
    ) -> np.ndarray:
        """Mask (K, W) of path points that are close enough to positions (K, n); `margin` [m], if not the usual one."""
        rows = self._path.rows[points]
        tool = self._dynamics.tcp_pose(positions)[:, :3, 3]
        margin = self._margin if margin is None else margin
        close = self._path.distance(tool, rows) <= margin + allowed.tool
        for joint, values in enumerate(positions.T):
            planned, within = self._path.q[rows, joint], self._path.reach[rows, joint] + allowed.joint
            farthest = max(values.max() - planned.min(), planned.max() - values.min())
            if not farthest <= within.min():
                close &= np.abs(values[:, None] - planned) <= within
        return close

    def _fastest(self, allowed: Tolerance, points: np.ndarray) -> np.ndarray:
        """Highest speed (W, n) at path points."""
        path, limit = self._path, self._robot.max_velocity
        rows = path.rows[points]
        return np.maximum((1 + allowed.faster) * path.speed[rows] + allowed.floor * limit, path.turning[rows])

    def _misfit_text(
        self,
        quantity: str,
        position: np.ndarray,
        speed: np.ndarray,
        allowed: Tolerance,
        time: float,
        points: np.ndarray,
    ) -> str:
        """Why none of the path's `points` fits a position (n,) with a speed (n,)."""
        close = self._near(position[None], allowed, points)[0]
        at = f"{time - self._began:.2f} s into the motion"
        if not close.any():
            row = int(self._path.rows[points[np.argmin(self._path.distances(position, points))]])
            return f"{at} {self._deviation_text(quantity, position, row, allowed)}"
        limit, fastest = self._robot.max_velocity, self._fastest(allowed, points[close])
        best = int(np.argmin(np.max((speed - fastest) / limit, axis=1)))
        joint = int(np.argmax((speed - fastest[best]) / limit))
        name, unit = self._robot.joint_names[joint], self._robot.joints[joint].position_unit
        return (
            f"{at} the {quantity} of {name} goes at {speed[joint]:.3g} {unit}/s, no "
            f"more than {self._path.speed[self._path.rows[points[close][best]], joint]:.3g} was planned around there: "
            f"{_LOOK}"
        )

    def _deviation_text(self, quantity: str, position: np.ndarray, row: int, allowed: Tolerance) -> str:
        """Text that names the joint, its distance and where it is."""
        q = self._path.q[row]
        tool = float(np.linalg.norm(self._dynamics.tcp_pose(position[None])[0, :3, 3] - self._path.tool[row]))
        joint = int(np.argmax(np.abs(position - q) * self._path.levers))
        name, unit = self._robot.joint_names[joint], self._robot.joints[joint].position_unit
        if np.all(np.abs(np.radians(position) - q) <= allowed.joint):
            return f"each {quantity} fits the plan in degrees, where radians are expected: check the unit of the link"
        x, y, z = self._path.tool[row]
        most = 1000 * (self._margin + allowed.tool)
        return (
            f"the {quantity} of {name} is {position[joint]:.3f} {unit}, {position[joint] - q[joint]:+.3f} {unit} off "
            f"the planned path; the tool is {1000 * tool:.0f} mm from it, {most:.0f} mm are "
            f"allowed, near x {x:.3f}, y {y:.3f}, z {z:.3f} m: {_LOOK}"
        )

    def _speed(
        self, quantity: str, span: float, time: np.ndarray, positions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(K, n) |speed| over the `span` [s] before each sample, and (K,) the length of that [s]."""
        times, recent = self._recent.get(quantity, (time[:0], positions[:0]))
        times, recent = np.concatenate([times, time]), np.concatenate([recent, positions])
        now = np.arange(len(times) - len(time), len(times))
        since = np.maximum(np.searchsorted(times, time - span, side="right") - 1, 0)
        # Over a shorter way, at first, the noise of a position counts for as much as over a whole one.
        interval = np.maximum(times[now] - times[since], span)
        keep = slice(int(since[-1]), None)
        self._recent[quantity] = times[keep], recent[keep]
        return np.abs(recent[now] - recent[since]) / interval[:, None], interval

    def _pace(self, time: np.ndarray, passed: np.ndarray, moving: np.ndarray, visible_time: np.ndarray) -> str | None:
        """Whether the motion took the planned time, and where the arm is now.

        Of the planned time (P,) up to each point, `visible_time` (P,) is what has to be seen as motion: a long slow
        move begins and ends so slowly that noise says whether it moves.
        """
        self._moved += float(np.sum(passed[moving]))
        self._last = float(time[-1])
        ends = [self._first, self._first + len(self._fits) - 1]
        bounds = np.stack([visible_time[ends], self._path.plan_time[ends]])  # the least and the most it may have moved
        if not passed.max() <= GAP:  # samples were lost: who knows whether it moved in between
            self._mark = self._moved, bounds.mean(axis=1)
        took = self._moved - self._mark[0]
        planned = float(np.clip(took, bounds[0, 0] - self._mark[1][0], bounds[1, 1] - self._mark[1][1]))
        if abs(took - planned) <= ALLOWANCE + SHARE * min(took, planned):
            if planned > RESYNC_AFTER:
                self._mark = self._moved, np.clip(self._mark[1] + took, *bounds.T)
            return None
        return (
            f"{self._last - self._began:.2f} s into the motion: what was planned to take {max(planned, 0.0):.1f} s "
            f"took {took:.1f} s: the override is not at 100 %, or was changed, or it is not the planned motion; set it "
            f"to 100 %, then run the command again; if it was, {_LAW}"
        )


_FAULT = "look for the fault there, then run the command again"
_LAW = "the controller has an interpolator of its own: agent learn-interpolator finds it from a motion before"
_LOOK = (
    "what moves is not what was planned and checked. Look at the program that "
    f"runs there and at the servos, then run the command again; if nothing is wrong there, {_LAW}"
)
