"""The plan is what moves: set-points and measured positions of a motion against what was planned and checked.

The controller's interpolator is not ours, so samples are not compared one by one. Each is laid onto the nearest place
of the planned path in a window that goes along with it, and there it has to be near enough, at no more than the speed
that was planned around that place. How long the way took is compared apart from that, without the rests at stops.

The tool may be as far from its path as the cell was checked with (the FLY distance of the recipe), a joint as far as
that takes it there, by the row of the damped inverse Jacobian, and as the plan itself takes it around there, where a
blend of another family turns the tool earlier or later. What is measured may lag behind the set-points in time, which
is no distance from the path, and be off by an error of the servos beside that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agent.safety.planned_path import PlannedPath

if TYPE_CHECKING:
    from agent.motion.trajectory import Trajectory
    from agent.robot import RobotDescription
    from agent.robot.dynamics import Tool
    from drivers.protocol import SampleBlock

#: The window along the path [s of plan]: back from the last place, and beyond what the time since then allows.
BACK, AHEAD = 0.1, 0.1
#: What is measured may be so long [s] behind the set-points, or before them.
LAG, LEAD = 0.15, 0.05
#: So much of the time and so many seconds (a corner that is taken almost to a stop) may the arm be ahead or behind on a
#: way that was planned to take `WAY` [s].
SHARE, ALLOWANCE, WAY = 0.2, 0.5, 4.0
#: How far ahead or behind the arm was over these seconds says where time has it now: in a turn it is neither for long.
USUAL = 2.0
#: Samples that are so long [s] apart say nothing of the time between them.
GAP = 0.1
#: An approach shorter than this [rad, m] is where the arm rests off its set-point; the controller makes none.
THERE = 1e-3
_ROWS = 64


@dataclass(frozen=True)
class Tolerance:
    """What may differ from the plan.

    `tool` [m] and `joint` [rad, m]: from the path, beyond the margin that the cell was checked with. Speed may be more
    by a share `faster` of what was planned and a part `floor` of the joint's limit, taken over `span` [s]; below a part
    `resting` of its limit no joint counts as moving.
    """

    tool: float
    joint: float
    faster: float
    floor: float
    span: float
    resting: float


#: No margin is smaller than this [m]: blends and rounding of the controller.
SMALLEST_MARGIN = 0.005
SET_POINTS = Tolerance(tool=0.0, joint=0.03, faster=0.2, floor=0.02, span=0.03, resting=1e-5)
#: As of set-points, and an error of the servos and noise beside it.
MEASURED = Tolerance(tool=0.015, joint=0.07, faster=0.3, floor=0.05, span=0.06, resting=0.003)


class Adherence:
    """Follows a motion along its plan, block by block.

    Args:
        chains: what was planned from stop to stop, in order; at least one.
        robot, tool: who moves.
        margin: how far from its path the tool may be where the cell was checked [m].
        period: of the samples [s]; says with their numbers how long the arm had moved before the first that came.
    """

    def __init__(
        self, chains: Sequence[Trajectory], robot: RobotDescription, tool: Tool | None, margin: float, period: float
    ) -> None:
        from agent.robot.dynamics import Dynamics

        self._robot = robot
        self._margin = max(margin, SMALLEST_MARGIN)
        self._dynamics = Dynamics(robot, tool)
        if len(chains) > 1 and np.ptp(chains[0].q, axis=0).max() < THERE:
            chains = chains[1:]
        self._path = PlannedPath.of(chains, self._dynamics, self._margin)
        self._period = period
        self._began: float | None = None
        self._last = 0.0
        self._place = 0
        self._moved, self._mark, self._ahead = 0.0, (0.0, 0.0), 0.0
        self._recent: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._moving = np.zeros(0, dtype=bool)

    @property
    def left(self) -> float:
        """Seconds of the plan that the arm has not gone."""
        return float(self._path.when[-1] - self._path.when[self._place])

    def take(self, block: SampleBlock) -> str | None:
        """The next samples; returns why the arm has to stop, if it has to."""
        for start in range(0, len(block), _ROWS):
            reason = self._take(block.part(start, start + _ROWS))
            if reason is not None:
                return reason
        return None

    def _take(self, block: SampleBlock) -> str | None:
        time, measured, given = block.time, block.position, block.reference_position
        for name, values in (("times", time), ("measured positions", measured), ("set-points", given)):
            if values is not None and not np.isfinite(values).all():
                return f"the controller sent {name} that are no numbers; look for the fault there"
        if self._began is None:
            self._began = self._last = float(time[0]) - self._period * float(block.sequence[0])
        leading = measured if given is None else given
        places = self._along(time, leading)
        if given is None:
            reason, moving = self._compare("position", MEASURED, time, measured, places)
        else:
            reason, moving = self._compare("set-point", SET_POINTS, time, given, places)
            when = self._path.when[places]
            lagging = self._path.nearest(measured, when - LAG, when + LEAD, when)
            reason = reason or self._compare("position", MEASURED, time, measured, lagging)[0]
        return reason or self._pace(time, places, moving)

    def _along(self, time: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """(K,) places of positions that lead the way, in a window that goes with the time since the last of them."""
        begun = float(self._path.when[self._place])
        passed = np.maximum(time - self._last, 0.0)
        # At its pace the arm is here. A controller's blend may cut a turn off by the margin, and where the way back is
        # the way out, what is nearest to the last place alone would go back from there.
        expected = self._moved + self._ahead + passed
        other_side = self._path.around(self._place, 2 * self._margin)
        until = np.maximum(np.maximum(begun + passed, expected) + AHEAD, other_side)
        return self._path.nearest(positions, np.full(len(time), begun - BACK), until, expected)

    def _compare(
        self, what: str, allowed: Tolerance, time: np.ndarray, positions: np.ndarray, places: np.ndarray
    ) -> tuple[str | None, np.ndarray]:
        """Distance and speed of positions (K, n) at their places (K,); what is wrong, and (K,) whether they move."""
        path = self._path
        rows = path.rows[places]
        off = np.abs(positions - path.q[rows])
        joints = off - path.reach[rows]
        tool = np.linalg.norm(self._dynamics.tcp_pose(positions)[:, :3, 3] - path.tool[rows], axis=1)
        limit = self._robot.max_velocity
        speed, before, passed = self._speed(what, allowed.span, time, positions, places)
        planned = np.maximum(path.speed[rows], path.speed[path.rows[before]])
        planned[passed > GAP] = limit  # samples were lost: who knows how fast it was in between
        near = np.all(joints <= allowed.joint, axis=1) & (tool <= self._margin + allowed.tool)
        slow = np.all(speed <= (1 + allowed.faster) * planned + allowed.floor * limit, axis=1)
        moving = np.any(speed > allowed.resting * limit, axis=1)
        if near.all() and slow.all():
            return None, moving
        k = int(np.argmin(near & slow))
        at = f"{time[k] - (self._began or 0.0):.2f} s into the motion"
        if near[k]:
            joint = int(np.argmax((speed[k] - planned[k]) / limit))
            return (
                f"{at} the {what} of {self._robot.joint_names[joint]} goes at {speed[k, joint]:.3g} {self._unit(joint)}"
                f"/s, no more than {planned[k, joint]:.3g} was planned around there: {_LOOK}"
            ), moving
        return f"{at} {self._place_of(what, positions[k], rows[k], float(tool[k]), allowed)}", moving

    def _place_of(self, what: str, position: np.ndarray, row: int, tool: float, allowed: Tolerance) -> str:
        """Which joint is how far off, where."""
        q = self._path.q[row]
        joint = int(np.argmax(np.abs(position - q) * self._path.levers))
        name, unit = self._robot.joint_names[joint], self._unit(joint)
        if np.all(np.abs(np.radians(position) - q) <= allowed.joint):
            return f"each {what} fits the plan in degrees, where radians are expected: check the unit of the link"
        x, y, z = self._path.tool[row]
        most = 1000 * (self._margin + allowed.tool)
        return (
            f"the {what} of {name} is {position[joint]:.3f} {unit}, {position[joint] - q[joint]:+.3f} {unit} off the "
            f"planned path; the tool is {1000 * tool:.0f} mm from it, {most:.0f} mm are "
            f"allowed, near x {x:.3f}, y {y:.3f}, z {z:.3f} m: {_LOOK}"
        )

    def _speed(
        self, what: str, span: float, time: np.ndarray, positions: np.ndarray, places: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(K, n) |speed| over the `span` [s] before each sample, the place (K,) where that began, and its length."""
        if what in self._recent:
            times, was, at = self._recent[what]
            times = np.concatenate([times, time])
            was, at = np.concatenate([was, positions]), np.concatenate([at, places])
        else:
            times, was, at = time, positions, places
        now = np.arange(len(times) - len(time), len(times))
        since = np.maximum(np.searchsorted(times, time - span, side="right") - 1, 0)
        # Over a shorter way, at first, the noise of a position counts for as much as over a whole one.
        passed = np.maximum(times[now] - times[since], span)
        keep = slice(int(since[-1]), None)
        self._recent[what] = times[keep], was[keep], at[keep]
        return np.abs(was[now] - was[since]) / passed[:, None], at[since], passed

    def _pace(self, time: np.ndarray, places: np.ndarray, moving: np.ndarray) -> str | None:
        """Whether the way took the time that was planned for it, and where the arm is now."""
        passed = np.diff(time, prepend=self._last)
        self._moved += float(np.sum(passed[moving]))
        self._last, self._place = float(time[-1]), int(places[-1])
        when = float(self._path.when[self._place])
        if not passed.max() <= GAP:  # samples were lost: who knows whether it moved in between
            self._mark, self._ahead = (self._moved, when), when - self._moved
        self._ahead += min(1.0, float(passed.sum()) / USUAL) * (when - self._moved - self._ahead)
        took, planned = self._moved - self._mark[0], when - self._mark[1]
        if abs(took - planned) <= ALLOWANCE + SHARE * min(took, planned):
            if planned > WAY:
                self._mark = self._moved, when
            return None
        return (
            f"{self._last - (self._began or 0.0):.2f} s into the motion: what was planned to take {planned:.1f} s took "
            f"{took:.1f} s: the override is not at 100 %, or was changed, or it is not the planned motion; set it to "
            "100 %, then run the command again"
        )

    def _unit(self, joint: int) -> str:
        return "m" if self._robot.joints[joint].prismatic else "rad"


_LOOK = (
    "what moves is not what was planned and checked. Look at the program that "
    "runs there and at the servos, then run the command again"
)
