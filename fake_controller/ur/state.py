"""What a UR controller knows of itself and its arm, and how it tells that in the fields of RTDE."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from agent.robot import Dynamics, RobotDescription, Tool
from fake_controller.actuation.machine import Machine
from fake_controller.faults import Faults, FaultyController
from fake_controller.state import State, home
from fake_controller.ur.arm import MODELS, DenavitHartenberg, poses_of

Version = tuple[int, int, int, int]
SWITCHED_ON = 60.0  # s that the controller has been on when it is first seen


class UrState(FaultyController):
    """State of a cell; what changes it is in `UrCell`, which alone knows what `_program` and `_moving` are.

    `tcp` (4, 4) is in the flange's frame; `payload` has mass, centre and inertia in the order of set_target_payload;
    `gravity` (3,) is the acceleration away from the ground. `position`, `velocity`, `reference`, `reference_velocity`
    (6,) are of the last cycle. `idle`: powered, brakes on. `protected`: in a protective stop.
    """

    def __init__(
        self, robot: RobotDescription, machine: Machine, serial: str, seed: int, version: Version, faults: Faults | None
    ) -> None:
        super().__init__(faults)
        self.robot, self.machine, self.serial, self.version = robot, machine, serial, version
        *_, self.robot_type, self.model = MODELS[robot.name]
        self.nominal = DenavitHartenberg.nominal(robot.name)
        self.kinematics = self.nominal.calibrated(seed)
        self.e_series = version[0] >= 5
        self.period = 0.002 if self.e_series else 0.008
        self.torque_constants = np.array([(j.torque_constant or 0.1) * abs(j.gear_ratio) for j in robot.joints])
        self.state = State()
        self.idle = self.protected = False
        self.cycle = self.control_line = 0
        self._program: Any = None
        self._moving: Any = None
        self._paused = self._stopping = False
        self._rate = 1.0  # of motion, as a share of the planned one
        self.tcp, self.payload, self.gravity = np.eye(4), [0.0] * 10, np.array([0.0, 0.0, 9.80665])
        self.registers: dict[str, list[Any]] = {}
        self.clear_registers()
        self.reference = self.position = home(robot)
        self.reference_velocity = self.velocity = np.zeros(6)
        self._dynamics: tuple[tuple[float, ...], Dynamics] | None = None

    @property
    def moving(self) -> bool:
        return self._moving is not None

    @property
    def running(self) -> bool:
        """Whether a program runs or is paused."""
        return self._program is not None

    @property
    def runtime_state(self) -> int:
        """As RTDE has it: 0 stopping, 1 stopped, 2 playing, 3 pausing, 4 paused."""
        if self._paused:
            return 3 if self._rate > 0 and self.moving else 4
        if self._stopping:
            return 0
        return 2 if self.running or "no_end" in self._lies else 1

    @property
    def remote(self) -> bool:
        """Whether commands from outside are taken; a CB3 takes them always."""
        return not self.e_series or self.state.mode == "auto"

    @property
    def time(self) -> float:
        """Controller time [s]."""
        return SWITCHED_ON + self.cycle * self.period

    def clear_registers(self) -> None:
        """As after switching on."""
        for kind in ("input", "output"):
            self.registers[f"{kind}_int"], self.registers[f"{kind}_double"] = [0] * 48, [0.0] * 48
            self.registers[f"{kind}_bit"] = [False] * 128

    @property
    def robot_mode(self) -> int:
        """As RTDE has it: 3 off, 5 idle, 7 running."""
        return 7 if self.state.drives_on else 5 if self.idle else 3

    @property
    def safety_mode(self) -> int:
        """As RTDE has it: 1 normal, 3 protective stop, 5 safeguard stop, 7 emergency stop, 9 fault."""
        if self.state.emergency_stop:
            return 7
        if self.state.alarms and not self.state.drives_on:
            return 9
        return 3 if self.protected else 1 if self.state.cell_closed else 5

    @property
    def tcp_offset(self) -> np.ndarray:
        """(6,) `tcp` as URScript has it."""
        return _offset(self.tcp.tobytes())

    def believed_dynamics(self) -> Dynamics:
        """The controller's own model: nominal bodies and the payload that was set."""
        key = (*self.payload[:4], *self.gravity)
        if self._dynamics is None or self._dynamics[0] != key:
            tool = Tool(np.eye(4), self.payload[0], np.array(self.payload[1:4]))
            self._dynamics = key, Dynamics(self.robot, tool).with_gravity(-self.gravity)
        return self._dynamics[1]


@lru_cache(maxsize=4)
def _offset(tcp: bytes) -> np.ndarray:
    """(6,) the URScript pose of a matrix (4, 4); a sample of every cycle has it."""
    return poses_of(np.frombuffer(tcp).reshape(1, 4, 4))[0]
