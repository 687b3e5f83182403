"""The state of a cell, and where its arm stands when it is switched on."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from agent.robot import RobotDescription
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.program.memory import RefusedRequest

#: Of each fault of the cell: what changes, the alarm, and why the arm stops.
_FAULTS: dict[str, tuple[dict[str, bool | str], tuple[str, ...], EndReason, str]] = {
    "emergency_stop": (
        {"emergency_stop": True, "drives_on": False},
        (),
        EndReason.EMERGENCY_STOP,
        "the emergency stop was pressed",
    ),
    "drive_fault": (
        {"drives_on": False},
        ("drive fault on axis 2",),
        EndReason.DRIVE_FAULT,
        "the drive of axis 2 reports a fault",
    ),
    "alarm": ({}, ("62513 motor 3 too hot",), EndReason.ALARM, "alarm 62513: motor 3 is too hot"),
    "protective_stop": ({"cell_closed": False}, (), EndReason.PROTECTIVE_STOP, "the gate of the cell was opened"),
    "teach_mode": ({"mode": "teach"}, (), EndReason.MODE_CHANGED, "the selector was turned to teach"),
}
_UPRIGHT = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])  # upper arm up, forearm level, tool down
_CALIBRATION_POSE = {
    "comau_ns16": np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0]),
    **dict.fromkeys(("ur3e", "ur5e", "ur10e"), _UPRIGHT),
}


class State(BaseModel):
    """What a person at the cell can change, and what the controller reports of it; checked where a file says it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    drives_on: bool = True
    mode: Literal["auto", "teach"] = "auto"
    emergency_stop: bool = False
    alarms: tuple[str, ...] = ()
    override: Annotated[float, Field(gt=0, le=1)] = 1.0
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
        if fault not in _FAULTS:
            return None
        changed, alarm, reason, message = _FAULTS[fault]
        for name, value in changed.items():
            setattr(self, name, value)
        self.alarms = (*self.alarms, *alarm)
        return reason, message


def home(robot: RobotDescription) -> np.ndarray:
    """(n,) where a robot stands when it is switched on: its calibration pose, or zero clear of its limits."""
    lower, upper = robot.position_limits
    clear = np.minimum(0.1, (upper - lower) / 10)  # rad, m: a joint that stands on its limit is measured beyond it
    return _CALIBRATION_POSE.get(robot.name, np.clip(np.zeros(robot.dof), lower + clear, upper - clear))
