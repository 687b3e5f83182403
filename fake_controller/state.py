"""The state of a cell, and where its arm stands when it is switched on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.robot import RobotDescription
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.programs import RefusedRequest

_UPRIGHT = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])  # upper arm up, forearm level, tool down
_CALIBRATION_POSE = {
    "comau_ns16": np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0]),
    **dict.fromkeys(("ur3e", "ur5e", "ur10e"), _UPRIGHT),
}


@dataclass
class State:
    """What a person at the cell can change, and what the controller reports of it."""

    drives_on: bool = True
    mode: str = "auto"
    emergency_stop: bool = False
    alarms: tuple[str, ...] = ()
    override: float = 1.0
    cell_closed: bool = True
    emulator: bool = True  # what it says of itself; tests need a controller that says it drives a machine

    def check_ready(self) -> None:
        """Raises:
        RefusedRequest: the state forbids motion.
        """
        if self.emergency_stop:
            raise RefusedRequest(Refusal.EMERGENCY_STOP, "the emergency stop is pressed")
        if self.alarms:
            raise RefusedRequest(Refusal.ALARM, f"active alarms: {', '.join(self.alarms)}")
        if self.mode != "auto":
            raise RefusedRequest(Refusal.TEACH_MODE, f"the mode is {self.mode}; programs start in auto only")
        if not self.drives_on:
            raise RefusedRequest(Refusal.DRIVES_OFF, "the drives are off")
        if not self.cell_closed:
            raise RefusedRequest(Refusal.CELL_OPEN, "the cell is open")

    def apply_fault(self, fault: str) -> tuple[EndReason, str] | None:
        """Change as a fault of the cell asks; why the arm has to stop, or None where the fault is none of the cell."""
        match fault:
            case "emergency_stop":
                self.emergency_stop, self.drives_on = True, False
                return EndReason.EMERGENCY_STOP, "the emergency stop was pressed"
            case "drive_fault":
                self.drives_on, self.alarms = False, (*self.alarms, "drive fault on axis 2")
                return EndReason.DRIVE_FAULT, "the drive of axis 2 reports a fault"
            case "alarm":
                self.alarms = (*self.alarms, "62513 motor 3 too hot")
                return EndReason.ALARM, "alarm 62513: motor 3 is too hot"
            case "protective_stop":
                self.cell_closed = False
                return EndReason.PROTECTIVE_STOP, "the gate of the cell was opened"
            case "teach_mode":
                self.mode = "teach"
                return EndReason.MODE_CHANGED, "the selector was turned to teach"
        return None


def home(robot: RobotDescription) -> np.ndarray:
    """(n,) where a robot stands when it is switched on: its calibration pose, or zero within its limits."""
    lower, upper = robot.position_limits
    return _CALIBRATION_POSE.get(robot.name, np.clip(np.zeros(robot.dof), lower, upper))
