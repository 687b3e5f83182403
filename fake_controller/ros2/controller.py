"""A JointTrajectoryController: goals, tolerances, replacement and hold, cycle by cycle (Jazzy's semantics).

It knows no ROS: `node` puts it on the wire, and tests call it as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from fake_controller.ros2.trajectory import SampledTrajectory, TrajectoryMessage, TrajectoryPoint


class ErrorCode(IntEnum):
    """Of FollowJointTrajectory's result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


@dataclass(eq=False)
class Goal:
    """A goal: tolerances by joint [rad], time [s] allowed after the end, and who hears of the end.

    `ended(status, code, text)`: status is `succeeded`, `aborted` or `canceled`.
    """

    message: TrajectoryMessage
    ended: Callable[[str, ErrorCode, str], object]
    path: Mapping[str, float] = field(default_factory=dict)
    goal: Mapping[str, float] = field(default_factory=dict)
    goal_time: float = 0.0


@dataclass(eq=False)
class Tolerances:
    """By joint [rad]; 0 is none."""

    path: np.ndarray
    goal: np.ndarray
    goal_time: float


class TrajectoryController:
    """One controller with a position interface.

    Args:
        joints: in its order.
        period: of its cycle [s].
        position: (n,) where the arm stands.
        path, goal: tolerances of its parameters [rad]; 0 is none, as by default.
        goal_time: the same for the time after the end [s]; 0 waits for ever.
    """

    def __init__(
        self,
        joints: Sequence[str],
        period: float,
        position: np.ndarray,
        path: float = 0.0,
        goal: float = 0.0,
        goal_time: float = 0.0,
    ) -> None:
        self.joints, self.period = tuple(joints), period
        count = len(self.joints)
        self.defaults = Tolerances(np.full(count, path), np.full(count, goal), goal_time)
        self.tolerances = self.defaults
        self.scaling = 1.0
        self.active = True
        self.started = 0  # motions from rest
        self.refused: list[str] = []
        self.command, self.command_velocity = position.copy(), np.zeros(count)
        self._lock = threading.RLock()
        self._new: TrajectoryMessage | None = None
        self._trajectory: SampledTrajectory | None = None
        self._goal: Goal | None = None
        self._time = 0.0  # of the trajectory [s], slower than the clock where it is scaled
        self._last = 0.0

    @property
    def moving(self) -> bool:
        """Whether a trajectory is under way that leads anywhere: one that holds the arm is no motion."""
        with self._lock:
            messages = [] if self._new is None else [self._new]
            if self._trajectory is not None and self._time < self._trajectory.end:
                messages.append(self._trajectory.message)
            return any(message.leads_away(self.joints, self.command) for message in messages)

    def take(self, message: TrajectoryMessage, now: float) -> str:
        """A trajectory by topic: it replaces what runs; why it is refused, or nothing."""
        with self._lock:
            refusal = message.refusal(self.joints, now) if self.active else "the controller is not active"
            if refusal:
                self.refused.append(refusal)
            else:
                was_moving, self._new = self.moving, message
                self.started += self.moving and not was_moving
            return refusal

    def take_goal(self, goal: Goal, now: float) -> str:
        """A goal: it aborts the one before."""
        with self._lock:
            refusal = self.take(goal.message, now)
            if not refusal:
                self._end("aborted", ErrorCode.INVALID_GOAL, "replaced by another goal")
                self._goal, self.tolerances = goal, self._of(goal)
            return refusal

    def cancel(self) -> bool:
        """Cancel the goal, if there is one, and hold; a trajectory that came by topic goes on."""
        with self._lock:
            if self._goal is None:
                return False
            self._end("canceled", ErrorCode.SUCCESSFUL, "canceled")
            self._hold()
            return True

    def deactivate(self) -> None:
        """As controller_manager or a fault of the hardware does: the last command stays."""
        with self._lock:
            self._end("aborted", ErrorCode.INVALID_GOAL, "the controller was deactivated")
            self.active, self._new, self._trajectory = False, None, None
            self.command_velocity = np.zeros_like(self.command)

    def update(self, now: float, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One cycle at `now` [s] with what was measured (n,); the position and velocity that are commanded next."""
        with self._lock:
            if self._new is not None:
                self._trajectory = SampledTrajectory(self._new, self.joints, now, (position.copy(), velocity.copy()))
                self._new, self._time = None, now
            else:
                passed = now - self._last  # a clock that is set back changes nothing that runs
                self._time += self.scaling * (passed if passed > 0.0 else self.period)
            self._last = now
            trajectory = self._trajectory
            if trajectory is not None:
                desired, _ = trajectory.at(self._time)
                self._measured = position
                if self._within(trajectory, np.abs(desired - position)):
                    self.command, rate = trajectory.at(self._time + self.scaling * self.period)
                    self.command_velocity = self.scaling * rate
            return self.command, self.command_velocity

    def _within(self, trajectory: SampledTrajectory, error: np.ndarray) -> bool:
        """Whether tolerances hold; where they do not, the goal is aborted and the arm held."""
        tolerances = self.tolerances
        if self._time < trajectory.end:
            if np.any((tolerances.path > 0.0) & (error > tolerances.path)):
                worst = self.joints[int(np.argmax(error - np.where(tolerances.path > 0, tolerances.path, np.inf)))]
                self._end("aborted", ErrorCode.PATH_TOLERANCE_VIOLATED, f"{worst} left its path")
                self._hold()
                return False
        elif self._goal is not None:
            if not np.any((tolerances.goal > 0.0) & (error > tolerances.goal)):
                self._end("succeeded", ErrorCode.SUCCESSFUL, "Goal successfully reached!")
            elif 0.0 < tolerances.goal_time < self._time - trajectory.end:
                self._end("aborted", ErrorCode.GOAL_TOLERANCE_VIOLATED, "the goal was not reached in time")
                self._hold()
                return False
        return True

    def _hold(self) -> None:
        """One point at the measured position, which is a step of the command back by the lag."""
        self._time = self._last
        position = self._measured if self._trajectory is not None else self.command
        message = TrajectoryMessage(self.joints, 0.0, (TrajectoryPoint.of(0.0, position.tolist()),))
        self._new, self._trajectory = (
            None,
            SampledTrajectory(message, self.joints, self._last, (position, np.zeros_like(position))),
        )
        self.command, self.command_velocity = position.copy(), np.zeros_like(position)

    def _end(self, status: str, code: ErrorCode, text: str) -> None:
        goal, self._goal = self._goal, None
        if goal is not None:
            goal.ended(status, code, text)

    def _of(self, goal: Goal) -> Tolerances:
        """Those of a goal: above 0 sets, 0 leaves the default, -1 switches off; what is wrong leaves all of them."""
        tolerances = []
        for asked, default in ((goal.path, self.defaults.path), (goal.goal, self.defaults.goal)):
            values = default.copy()
            for name, value in asked.items():
                if name not in self.joints or (value < 0.0 and value != -1.0):
                    return self.defaults
                if value != 0.0:
                    values[self.joints.index(name)] = max(value, 0.0)
            tolerances.append(values)
        return Tolerances(tolerances[0], tolerances[1], goal.goal_time or self.defaults.goal_time)
