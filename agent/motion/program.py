"""A motion program as data: what the PDL2 writer writes, the parser yields and the interpolator runs.

SI units throughout; millimetres and degrees exist in PDL2 text only.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np


class MoveType(Enum):
    """`$MOVE_TYPE` or the trajectory word of a MOVE statement."""

    LINEAR = "LINEAR"
    JOINT = "JOINT"
    CIRCULAR = "CIRCULAR"


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


Frame = tuple[tuple[float, ...], ...]
#: A frame that moves nothing. Where a program says so, that is more than saying nothing (None).
NO_FRAME: Frame = tuple(tuple(float(row == column) for column in range(4)) for row in range(4))


def matrix_of(frame: Frame | None) -> np.ndarray:
    """(4, 4) of a frame, the identity where a program does not say."""
    return np.array(NO_FRAME if frame is None else frame, dtype=float)


def frame_of(matrix: np.ndarray) -> Frame:
    """A matrix (4, 4) as settings hold it."""
    return tuple(tuple(row) for row in np.asarray(matrix, dtype=float).tolist())


@dataclass(frozen=True)
class MotionSettings:
    """The system variables in force for one move.

    `fly_distance` [m], `fly_percent` and `stress_percent` 1..100, speeds [m/s, rad/s], tolerances [m],
    overrides as fractions of one. `base`, `tool` and `uframe` are (4, 4) as nested tuples; None is a program that does
    not say, so that the controller's own are in force: whoever plans then takes its tool, and no base and user frame.
    The care flags ask for a refusal where the configuration, the turns or a singularity would be passed over;
    `multi_turn` lets a joint move turn an axis by more than half a turn, as its JOINTPOS says.
    """

    fly_type: FlyType = FlyType.FLY_NORM
    fly_trajectory: FlyTrajectory = FlyTrajectory.FLY_AUTO
    fly_distance: float = 0.01
    fly_percent: float = 100.0
    stress_percent: float = 50.0
    speed_option: SpeedOption = SpeedOption.SPD_LIN
    linear_speed: float = 0.25
    rotational_speed: float = 1.0
    orientation: OrientationType = OrientationType.RS_WORLD
    termination: Termination = Termination.COARSE
    tolerance_fine: float = 0.0005
    tolerance_coarse: float = 0.001
    speed_override: float = 1.0
    acceleration_override: float = 1.0
    deceleration_override: float = 1.0
    arm_override: float = 1.0
    base: Frame | None = None
    tool: Frame | None = None
    uframe: Frame | None = None
    configuration_care: bool = False
    turn_care: bool = False
    singularity_care: bool = False
    multi_turn: bool = True

    def changed(self, **values: object) -> MotionSettings:
        """A copy with some variables changed."""
        return replace(self, **values)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class CartesianTarget:
    """A POS: pose (4, 4) of the TCP [m] in the user frame, and its COMAU configuration string."""

    pose: np.ndarray
    configuration: str = ""


@dataclass(frozen=True, eq=False)
class JointTarget:
    """A JOINTPOS: joint positions (n,) [rad, or m on a prismatic joint]."""

    position: np.ndarray


Target = CartesianTarget | JointTarget


@dataclass(frozen=True, eq=False)
class Move:
    """One MOVE or (`fly`) MOVEFLY. `via` belongs to CIRCULAR; `name` is the target's variable, `line` its place."""

    type: MoveType
    target: Target
    settings: MotionSettings = field(default_factory=MotionSettings)
    fly: bool = False
    via: Target | None = None
    name: str = ""
    line: int = 0


@dataclass(frozen=True)
class Delay:
    """DELAY: the arm rests for so many seconds."""

    seconds: float


Statement = Move | Delay


def stop_to_stop(statements: Iterable[Statement]) -> Iterator[list[Move]]:
    """The moves of a program, cut where the arm stops. Rests between them are left out."""
    pending: list[Move] = []
    for statement in statements:
        if not isinstance(statement, Move):
            continue
        pending.append(statement)
        if not statement.fly:
            yield pending
            pending = []
    if pending:
        yield pending


def way_key(moves: Sequence[Move]) -> tuple[object, ...]:
    """The same for moves that make the same way from the same start, whatever they and their points are called."""

    def place(target: Target | None) -> tuple[object, ...]:
        if isinstance(target, CartesianTarget):
            return target.pose.tobytes(), target.configuration
        return () if target is None else (target.position.tobytes(),)

    return tuple((m.type, m.fly, m.settings, place(m.target), place(m.via)) for m in moves)
