"""The system variables of the motion subset, how each stands in Pdl2Settings, and POS: units are converted here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from agent.motion import rotation
from agent.motion.path_settings import FlyTrajectory, FlyType, OrientationType, SpeedOption
from agent.motion.pdl2.settings import Pdl2Settings, Termination
from agent.motion.pdl2.syntax import Constant, Pos
from agent.motion.program import MoveType, frame_of, matrix_of


def pos_to_pose(pos: np.ndarray) -> np.ndarray:
    """Poses (S, 4, 4) [m] of coordinates (S, 6): x, y, z [mm] and the Euler ZYZ angles a, e, r [deg]; (4, 4) of one."""
    pos = np.asarray(pos, dtype=float)
    si = np.concatenate([pos[..., :3] / 1000.0, np.radians(pos[..., 3:])], axis=-1)
    return rotation.pose_of(si) + 0.0  # no negative zeros


def pose_to_pos(pose: np.ndarray) -> np.ndarray:
    """Coordinates (..., 6) of poses (..., 4, 4) [m]: x, y, z [mm], a, e, r [deg] as `rotation.to_euler` gives them."""
    pose = np.asarray(pose, dtype=float)
    return np.concatenate([1000.0 * pose[..., :3, 3], np.degrees(rotation.to_euler(pose[..., :3, :3]))], axis=-1)


Value = bool | int | float | str | Constant | Pos


@dataclass(frozen=True)
class SystemVariable:
    """One system variable: the field of Pdl2Settings it stands in (None for `$MOVE_TYPE`), and what it may hold.

    A number lies in `low`..`high` in the unit of PDL2 (`above` excludes `low` itself) and is `scale` times SI.
    """

    name: str
    field: str | None
    kind: str  # REAL, INTEGER, BOOLEAN, POS or predefined
    scale: float = 1.0
    unit: str = ""
    low: float = 0.0
    above: bool = False
    high: float = float("inf")
    choices: type[Enum] | None = None

    def refusal(self, value: Value) -> str:
        """Why the variable cannot hold a value, empty where it can."""
        if self.choices is not None:
            names = [choice.name for choice in self.choices]
            return "" if isinstance(value, Constant) and value.name in names else f"is one of {', '.join(names)}"
        if self.kind not in ("REAL", "INTEGER") or not isinstance(value, int | float):
            return ""
        if self.kind == "INTEGER" and value % 1 != 0:
            return f"is {value:g} and is an INTEGER: a whole number"
        if not self.low <= value <= self.high or (self.above and value == self.low):
            return f"is {value:g} and must be {self._range()}"
        return ""

    def _range(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.high == float("inf"):
            return f"{'above' if self.above else 'at least'} {self.low:g}{unit}"
        return f"in {self.low:g}..{self.high:g}{unit}"

    def read(self, settings: Pdl2Settings) -> Value:
        """The value in PDL2's unit."""
        if self.field is None:
            return Constant(MoveType.JOINT.name)  # the controller's own default
        value = getattr(settings, self.field)
        if self.kind == "POS":
            return Pos(tuple(pose_to_pos(matrix_of(value)).tolist()), "")
        if isinstance(value, Enum):
            return Constant(value.name)
        if isinstance(value, bool):
            return value
        number = value * self.scale
        whole = self.kind == "INTEGER" and abs((number + 0.5) % 1 - 0.5) < 1e-9
        return round(number) if whole else number

    def convert(self, value: Value) -> Any:
        """The value of the field of Pdl2Settings."""
        if isinstance(value, Constant):
            return self.choices[value.name] if self.choices else value.name
        if isinstance(value, Pos):
            return frame_of(pos_to_pose(np.array(value.fields)))
        return value if isinstance(value, bool) else float(value) / self.scale


def _percent(name: str, field: str, scale: float = 100.0) -> SystemVariable:
    return SystemVariable(name, field, "INTEGER", scale=scale, unit="%", low=1, high=100)


def _choice(name: str, field: str | None, choices: type[Enum]) -> SystemVariable:
    return SystemVariable(name, field, "predefined", choices=choices)


_TABLE = (
    _choice("$MOVE_TYPE", None, MoveType),
    _choice("$FLY_TYPE", "fly_type", FlyType),
    _choice("$FLY_TRAJ", "fly_trajectory", FlyTrajectory),
    SystemVariable("$FLY_DIST", "fly_distance", "REAL", scale=1000.0, unit="mm"),
    _percent("$FLY_PER", "fly_percent", scale=1.0),
    _percent("$STRESS_PER", "stress_percent", scale=1.0),
    _choice("$SPD_OPT", "speed_option", SpeedOption),
    SystemVariable("$LIN_SPD", "linear_speed", "REAL", unit="m/s", above=True),
    SystemVariable("$ROT_SPD", "rotational_speed", "REAL", unit="rad/s", above=True),
    _choice("$ORNT_TYPE", "orientation", OrientationType),
    _choice("$TERM_TYPE", "termination", Termination),
    SystemVariable("$TOL_FINE", "tolerance_fine", "REAL", scale=1000.0, unit="mm", above=True),
    SystemVariable("$TOL_COARSE", "tolerance_coarse", "REAL", scale=1000.0, unit="mm", above=True),
    SystemVariable("$CNFG_CARE", "configuration_care", "BOOLEAN"),
    SystemVariable("$TURN_CARE", "turn_care", "BOOLEAN"),
    SystemVariable("$SING_CARE", "singularity_care", "BOOLEAN"),
    SystemVariable("$JNT_MTURN", "multi_turn", "BOOLEAN"),
    _percent("$PROG_SPD_OVR", "speed_override"),
    _percent("$PROG_ACC_OVR", "acceleration_override"),
    _percent("$PROG_DEC_OVR", "deceleration_override"),
    _percent("$ARM_SPD_OVR", "speed_override"),
    _percent("$ARM_ACC_OVR", "acceleration_override"),
    _percent("$ARM_DEC_OVR", "deceleration_override"),
    _percent("$ARM_OVR", "arm_override"),
    SystemVariable("$BASE", "base", "POS"),
    SystemVariable("$TOOL", "tool", "POS"),
    SystemVariable("$UFRAME", "uframe", "POS"),
)

#: Frames in the order of the text, by their field of the settings.
FRAMES = {"base": "$BASE", "tool": "$TOOL", "uframe": "$UFRAME"}

SYSTEM_VARIABLES: dict[str, SystemVariable] = {variable.name: variable for variable in _TABLE}

#: Predefined constants by their name in lower case.
PREDEFINED: dict[str, bool | Constant] = {
    **{
        choice.name.lower(): Constant(choice.name)
        for variable in _TABLE
        if variable.choices is not None
        for choice in variable.choices
    },
    "true": True,
    "false": False,
    "on": True,
    "off": False,
}


def read(name: str, values: Mapping[str, Value]) -> Value:
    """What a system variable holds, `values` being those that were assigned."""
    if name in values:
        return values[name]
    if name.startswith("$ARM_") and name != "$ARM_OVR":
        return 100
    return SYSTEM_VARIABLES[name].read(Pdl2Settings())


def motion_settings(values: Mapping[str, Value]) -> Pdl2Settings:
    """The settings in force where these system variables were assigned; the others are Pdl2Settings' defaults.

    The program's and the arm's overrides of speed, acceleration and deceleration multiply.
    """
    fields: dict[str, Any] = {}
    for name, value in values.items():
        variable = SYSTEM_VARIABLES[name]
        if variable.field is None:
            continue
        converted = variable.convert(value)
        if variable.unit == "%" and variable.scale == 100.0:
            converted *= fields.get(variable.field, 1.0)
        fields[variable.field] = converted
    return Pdl2Settings().changed(**fields)
