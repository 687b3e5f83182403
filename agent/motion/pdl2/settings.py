"""The settings of a move that COMAU's controllers have and others do not, as the system variables of PDL2."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum
from typing import Self

from agent.motion.program import MotionSettings


class FlyType(Enum):
    """`$FLY_TYPE`."""

    FLY_NORM = "FLY_NORM"
    FLY_CART = "FLY_CART"


class FlyTrajectory(Enum):
    """`$FLY_TRAJ`."""

    FLY_AUTO = "FLY_AUTO"
    FLY_TOL = "FLY_TOL"
    FLY_PASS = "FLY_PASS"
    FLY_FROM = "FLY_FROM"


class SpeedOption(Enum):
    """`$SPD_OPT`."""

    SPD_LIN = "SPD_LIN"
    SPD_CONST = "SPD_CONST"
    SPD_JNT = "SPD_JNT"
    SPD_ROT = "SPD_ROT"


class OrientationType(Enum):
    """`$ORNT_TYPE`."""

    RS_WORLD = "RS_WORLD"
    RS_TRAJ = "RS_TRAJ"
    EUL_WORLD = "EUL_WORLD"
    WRIST_JNT = "WRIST_JNT"


class Termination(Enum):
    """`$TERM_TYPE`."""

    FINE = "FINE"
    COARSE = "COARSE"
    JNT_FINE = "JNT_FINE"
    JNT_COARSE = "JNT_COARSE"
    NOSETTLE = "NOSETTLE"


@dataclass(frozen=True)
class Pdl2Settings(MotionSettings):
    """The system variables in force for one move.

    `fly_percent` and `stress_percent` 1..100, tolerances [m], overrides as fractions of one. The care flags ask for a
    refusal where the configuration, the turns or a singularity would be passed over; `multi_turn` lets a joint move
    turn an axis by more than half a turn, as its JOINTPOS says.
    """

    fly_type: FlyType = FlyType.FLY_NORM
    fly_trajectory: FlyTrajectory = FlyTrajectory.FLY_AUTO
    fly_percent: float = 100.0
    stress_percent: float = 50.0
    speed_option: SpeedOption = SpeedOption.SPD_LIN
    orientation: OrientationType = OrientationType.RS_WORLD
    termination: Termination = Termination.COARSE
    tolerance_fine: float = 0.0005
    tolerance_coarse: float = 0.001
    acceleration_override: float = 1.0
    deceleration_override: float = 1.0
    arm_override: float = 1.0
    configuration_care: bool = False
    turn_care: bool = False
    singularity_care: bool = False
    multi_turn: bool = True

    @classmethod
    def of(cls, settings: MotionSettings) -> Pdl2Settings:
        """Any settings as a COMAU controller understands them; what they do not say has its default."""
        if isinstance(settings, cls):
            return settings
        return cls(**{field.name: getattr(settings, field.name) for field in fields(MotionSettings)})

    def stopping(self) -> Self:
        return self.changed(termination=Termination.FINE)

    @property
    def blend(self) -> str:
        return f"{self.fly_type.value} within {1000 * self.fly_distance:g} mm"
