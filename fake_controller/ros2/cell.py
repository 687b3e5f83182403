"""An arm under a trajectory controller in real time: cycles, what they measured, and faults; without ROS."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent.robot import RobotDescription
from drivers.wire.reasons import EndReason
from fake_controller.execution import Astray, follow
from fake_controller.faults import LASTING, Fault, Faults, FaultyController
from fake_controller.plant import Plant
from fake_controller.ros2.controller import TrajectoryController
from fake_controller.state import State, home

#: Faults that make no sense here, and why.
IMPOSSIBLE = {
    **dict.fromkeys(LASTING, "samples come by no broker there, points in no queue"),
    **dict.fromkeys(("wrong_program", "full_memory", "untranslatable"), "no program is stored there"),
    "refuse": "nothing is opened there",
    "no_end": "that a motion is over follows from the samples",
    "restart": "a controller that starts again is another one there",
    "slow": "its period is that of its clock",
    "wrong_robot": "a robot is known by its joints there",
}
#: What joint_states may have as effort.
EFFORTS = ("torque", "current", "compensated", "none")
_SLICE = 25  # cycles at once
_BEHIND = 1.0  # s; what is further behind is left out, as a manager does that was held up


@dataclass(frozen=True, eq=False)
class RosCycles:
    """K cycles: stamps (K,) [s of the Unix clock], what was measured and what was commanded (K, n)."""

    stamps: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    reference: np.ndarray
    reference_velocity: np.ndarray


class Ros2Cell(FaultyController):
    """One arm with its controller.

    Args:
        robot: its type.
        plant: the arm, at the controller's period.
        period: of a cycle [s].
        faults: what goes wrong, and when.
        effort: one of `EFFORTS`.
        tolerance: of the path, by the controller's parameters [rad]; 0 is none.
        clock: the Unix clock.
    """

    def __init__(
        self,
        robot: RobotDescription,
        plant: Plant,
        period: float,
        faults: Faults | None = None,
        effort: str = "torque",
        tolerance: float = 0.2,
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(faults)
        self.robot, self.period, self.effort, self.tolerance = robot, period, effort, tolerance
        self.state = State()
        self.left_out = 0  # cycles
        self.late: deque[float] = deque(maxlen=100_000)  # [s] from the stamps of samples to when they were published
        self._plant, self._clock = plant, clock
        self._astray = Astray(robot.dof, period)
        self._start = home(robot)
        plant.rest(self._start)
        self.position, self.velocity = plant.resting.position[-1], np.zeros(robot.dof)
        self.controller = TrajectoryController(robot.joint_names, period, self._start, tolerance)
        self._begin, self._count = clock(), 0
        self._moved, self._was_moving = 0.0, False
        self._clock_back, self._reason = 0.0, EndReason.DONE
        constants = np.array([(j.torque_constant or 0.1) * abs(j.gear_ratio) for j in robot.joints])
        self._unit = constants if effort == "current" else np.ones(robot.dof)

    @property
    def moving(self) -> bool:
        return self.controller.moving

    def history(self) -> str:
        """Also how late samples were published: whoever measures a link has to take that off."""
        late = 1e3 * np.quantile(self.late or [0.0], 0.99)
        return f"{super().history()}; published {late:.0f} ms late (p99), {self.left_out} cycles left out"

    @property
    def mute(self) -> bool:
        """Whether joint_states stop."""
        return "mute" in self._lies

    @property
    def one_less(self) -> bool:
        """Whether joint_states lack a joint."""
        return "columns" in self._lies

    def now(self) -> float:
        """Time [s] by the controller's clock."""
        return self._clock() - self._clock_back

    def accepts(self) -> bool:
        """Whether a command acts; a stop may not, and faults of its phase strike."""
        self.reach("stop" if self.moving else "start")
        return self._obeys

    def run(self) -> RosCycles | None:
        """The cycles that are due; None where none is."""
        due = int((self._clock() - self._begin) / self.period) - self._count
        if due <= 0:
            return None
        if due * self.period > _BEHIND:
            self.left_out += due - _SLICE
            self._count += due - _SLICE
        count = min(due, _SLICE)
        stamps = self._begin + self.period * (self._count + 1 + np.arange(count)) - self._clock_back
        self._count += count
        commands = [self.controller.update(stamp, self.position, self.velocity) for stamp in stamps]
        reference, rate = (np.array(rows) for rows in zip(*commands, strict=True))
        samples = follow(self._plant, self._astray, reference, rate, self._start)
        self.position, self.velocity = samples.position[-1], samples.velocity[-1]
        self._notice(count)
        effort, reported = self._measured(samples.torque), self._reported(samples)
        return RosCycles(stamps, reported.position, reported.velocity, effort, reported.reference_position, rate)

    def _measured(self, torque: np.ndarray) -> np.ndarray:
        if self.effort == "none" or "no_numbers" in self._lies:
            return np.full_like(torque, np.nan)
        if self.effort == "compensated":
            q = np.repeat(self.position[None], len(torque), axis=0)
            nothing = np.zeros_like(q)
            return torque - self._plant.machine.dynamics().inverse_dynamics(q, nothing, nothing)
        return torque / self._unit

    def _notice(self, count: int) -> None:
        moving = self.moving
        self.motions_started = self.controller.started
        if moving and not self._was_moving:
            self._moved = 0.0
        if not moving:
            self._start = self.controller.command.copy()
            if self._was_moving:
                self.ends.append(self._reason)
                self._reason = EndReason.DONE
        else:
            self._moved += count * self.period
            self.reach("streaming", self._moved)
        self._was_moving = moving

    def _apply_fault(self, fault: Fault) -> None:
        self._astray.apply_fault(fault)
        match fault.name:
            case "override" | "off_speed":
                self.controller.scaling = fault.amount
            case "clock_back" | "reset_counters":
                self._clock_back = fault.amount or 3600.0
            case _:
                stop = self.state.apply_fault(fault.name)
                if stop is not None:
                    self._reason = stop[0]
                    self.controller.deactivate()
