"""The settings of a move that COMAU's controllers have and others do not, as the system variables of PDL2."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Self

from agent.motion.path_settings import PathSettings


class Termination(Enum):
    """`$TERM_TYPE`."""

    FINE = "FINE"
    COARSE = "COARSE"
    JNT_FINE = "JNT_FINE"
    JNT_COARSE = "JNT_COARSE"
    NOSETTLE = "NOSETTLE"


@dataclass(frozen=True)
class Pdl2Settings(PathSettings):
    """The system variables in force for one move: those of its path, and how it ends, within tolerances [m]."""

    termination: Termination = Termination.COARSE
    tolerance_fine: float = 0.0005
    tolerance_coarse: float = 0.001

    def stopping(self) -> Self:
        return self.changed(termination=Termination.FINE)

    @property
    def blend(self) -> str:
        return f"{self.fly_type.value} within {1000 * self.fly_distance:g} mm"
