"""What an interpolator of paths is told about a move, whichever language says it.

The words are those of a recipe's `motion.fly`, and of the system variables of PDL2.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from agent.motion.program import MotionSettings


class FlyType(Enum):
    """How a blend is run: NORM lets the speed dip where two moves overlap, CART keeps it (`$FLY_TYPE`)."""

    FLY_NORM = "FLY_NORM"
    FLY_CART = "FLY_CART"


class FlyTrajectory(Enum):
    """What bounds a blend: its share of the moves, its distance from the point, or where it begins (`$FLY_TRAJ`)."""

    FLY_AUTO = "FLY_AUTO"
    FLY_TOL = "FLY_TOL"
    FLY_PASS = "FLY_PASS"
    FLY_FROM = "FLY_FROM"


class SpeedOption(Enum):
    """Which speed is programmed (`$SPD_OPT`)."""

    SPD_LIN = "SPD_LIN"
    SPD_CONST = "SPD_CONST"
    SPD_JNT = "SPD_JNT"
    SPD_ROT = "SPD_ROT"


class OrientationType(Enum):
    """How the orientation goes along a line or an arc (`$ORNT_TYPE`)."""

    RS_WORLD = "RS_WORLD"
    RS_TRAJ = "RS_TRAJ"
    EUL_WORLD = "EUL_WORLD"
    WRIST_JNT = "WRIST_JNT"


@dataclass(frozen=True)
class PathSettings(MotionSettings):
    """How the path of one move is blended and run; a dialect that says more derives its settings from it.

    `fly_percent` and `stress_percent` 1..100, overrides as fractions of one. The care flags ask for a refusal where
    the configuration, the turns or a singularity would be passed over; `multi_turn` lets a joint move turn an axis by
    more than half a turn, as its target says.
    """

    fly_type: FlyType = FlyType.FLY_NORM
    fly_trajectory: FlyTrajectory = FlyTrajectory.FLY_AUTO
    fly_percent: float = 100.0
    stress_percent: float = 50.0
    speed_option: SpeedOption = SpeedOption.SPD_LIN
    orientation: OrientationType = OrientationType.RS_WORLD
    acceleration_override: float = 1.0
    deceleration_override: float = 1.0
    arm_override: float = 1.0
    configuration_care: bool = False
    turn_care: bool = False
    singularity_care: bool = False
    multi_turn: bool = True
