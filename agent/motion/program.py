"""A motion program as data: what a dialect writes and reads, and an interpolator runs.

SI units throughout; millimetres and degrees exist in a dialect's text only. A program sets the frames of its positions,
or leaves them to the controller.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from typing import TYPE_CHECKING, Self, TypeVar

import numpy as np

from agent.core import InputError

if TYPE_CHECKING:
    from agent.robot import Tool


class MoveType(Enum):
    """The curve of a move."""

    LINEAR = "LINEAR"
    JOINT = "JOINT"
    CIRCULAR = "CIRCULAR"


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
    """Settings of a move on every controller; a dialect derives its own class with further ones.

    `fly_distance` [m]: how far a blend keeps from the via-point (a tolerance, a zone, a blend radius: the dialect says
    which). Speeds [m/s, rad/s]; `speed_override` a fraction of them, and of the joint limits in a joint move. `base`,
    `tool` and `uframe` are (4, 4) as nested tuples; None is a program that does not say, so that the controller's own
    are in force: whoever plans then takes its tool, and no base and user frame.
    """

    fly_distance: float = 0.01
    linear_speed: float = 0.25
    rotational_speed: float = 1.0
    speed_override: float = 1.0
    base: Frame | None = None
    tool: Frame | None = None
    uframe: Frame | None = None

    @classmethod
    def of(cls, settings: MotionSettings) -> Self:
        """Any settings as this class has them; what they do not say has its default."""
        if isinstance(settings, cls):
            return settings
        return cls(**{field.name: getattr(settings, field.name) for field in fields(MotionSettings)})

    def changed(self, **values: object) -> Self:
        """A copy with some settings changed."""
        return replace(self, **values)  # type: ignore[arg-type]

    def stopping(self) -> Self:
        """The same for a move whose end the arm has to reach exactly before the program goes on."""
        return self

    def carrying(self, tool: Tool | None) -> Self:
        """The same for an arm that carries this tool, where programs tell the controller its load."""
        return self

    @property
    def blend(self) -> str:
        """How the loop passes its via-points, for people."""
        return f"blends of {1000 * self.fly_distance:g} mm"


#: The settings of one controller's language, or of all.
Settings = TypeVar("Settings", bound=MotionSettings)


@dataclass(frozen=True, eq=False)
class CartesianTarget:
    """Pose (4, 4) of the TCP [m] in the user frame, and its configuration in the controller's own notation."""

    pose: np.ndarray
    configuration: str = ""


@dataclass(frozen=True, eq=False)
class JointTarget:
    """Joint positions (n,) [rad, or m on a prismatic joint]."""

    position: np.ndarray


Target = CartesianTarget | JointTarget


@dataclass(frozen=True, eq=False)
class Move:
    """One move; it stops at its target, or blends into the next one (`fly`).

    `via` belongs to CIRCULAR; `name` is the target's variable, `line` its line in the text.
    """

    type: MoveType
    target: Target
    settings: MotionSettings = field(default_factory=MotionSettings)
    fly: bool = False
    via: Target | None = None
    name: str = ""
    line: int = 0


@dataclass(frozen=True)
class Delay:
    """The arm rests for some time [s]."""

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
    """The same for moves along the same path from the same start, regardless of their names and those of points."""

    def place(target: Target | None) -> tuple[object, ...]:
        if isinstance(target, CartesianTarget):
            return target.pose.tobytes(), target.configuration
        return () if target is None else (target.position.tobytes(),)

    return tuple((m.type, m.fly, m.settings, place(m.target), place(m.via)) for m in moves)


def loop_moves(poses: np.ndarray, settings: MotionSettings, joints: np.ndarray | None = None) -> tuple[Move, ...]:
    """One cycle over via-points (K, 4, 4): from a standstill at the first, flying to the others, back to the first.

    Every cycle ends with an exact stop, so that cycles repeat exactly. `settings` hold for all moves. A redundant arm
    needs the `joints` (K, n) at the via-points too: a pose would let it come back to its first point with other joints.

    Args:
        poses: via-points (K, 4, 4) [m].
        settings: of all moves.
        joints: positions (K, n) [rad or m] at the via-points of a redundant arm.
    """
    return cycle_moves(list(map(CartesianTarget, poses) if joints is None else map(JointTarget, joints)), settings)


def cycle_moves(points: Sequence[Target], settings: MotionSettings) -> tuple[Move, ...]:
    """The same over targets of either kind."""
    flying = [Move(MoveType.LINEAR, point, settings, True, name=f"p{k}") for k, point in enumerate(points[1:], start=2)]
    return (*flying, Move(MoveType.LINEAR, points[0], settings.stopping(), name="p1"))


@dataclass(frozen=True, eq=False)
class LoopProgram:
    """What a program does that goes round its points: an approach, then a cycle, `cycles` times."""

    approach: Move
    moves: tuple[Move, ...]
    cycles: int

    @classmethod
    def of(
        cls,
        points: Sequence[Target],
        settings: MotionSettings,
        cycles: int,
        approach: MotionSettings | None = None,
        start: JointTarget | None = None,
    ) -> LoopProgram:
        """A joint move with settings `approach` (default: 10 % speed override) to `start`, joint positions of the first
        point, or to the first point itself; then linear moves that fly through points 2 to K and stop at the first.

        Raises:
            InputError: fewer than two points, or no cycle.
        """
        if len(points) < 2:
            raise InputError(f"a loop needs at least 2 points, not {len(points)}")
        if not 1 <= cycles <= 1_000_000:
            raise InputError(f"the number of cycles is 1 to 1000000, not {cycles}")
        if approach is None:
            approach = settings.changed(speed_override=min(0.1, settings.speed_override))
        first = Move(MoveType.JOINT, start or points[0], approach.stopping())
        return cls(first, cycle_moves(points, settings), cycles)


def decimals(value: float) -> str:
    """A coordinate in a program's text, with nine decimals at most.

    Raises:
        InputError: not finite.
    """
    if not np.isfinite(value):
        raise InputError(f"a coordinate of the program is {value} and must be finite")
    text = f"{value:.9f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def tool_frame(tool: Tool | None) -> np.ndarray:
    """(4, 4) of the tool centre point in the flange's frame [m]."""
    return np.eye(4) if tool is None else np.asarray(tool.frame, dtype=float)


def with_frames(settings: Settings, tool: Tool | None) -> Settings:
    """The settings for poses of this tool's centre point in the robot's base."""
    return settings.carrying(tool).changed(base=NO_FRAME, tool=frame_of(tool_frame(tool)), uframe=NO_FRAME)


def pose_in_robot_base(target: Target, settings: MotionSettings) -> np.ndarray:
    """(4, 4) where a Cartesian target is [m]: base⁻¹ · uframe · pose.

    `base` is where the robot stands in the world, `uframe` where the work is in it; a pose is given in `uframe`.
    """
    assert isinstance(target, CartesianTarget)
    pose = np.asarray(target.pose, dtype=float)
    if settings.uframe not in (None, NO_FRAME):
        pose = matrix_of(settings.uframe) @ pose
    return pose if settings.base in (None, NO_FRAME) else np.linalg.solve(matrix_of(settings.base), pose)


def left_open(statements: Iterable[Statement], tool: Tool | None, names: Mapping[str, str]) -> Mapping[str, np.ndarray]:
    """The frames (4, 4) [m] that a plan of these statements takes for granted, as the program does not set them.

    A move to a pose needs all three, a straight line or an arc between joint positions the tool, and so does a joint
    move that flies by its target, as the distance from it is the tool's; one that stops there needs none.

    Args:
        names: of the frames that the dialect has (`Dialect.frame_names`).
    """
    needed: set[str] = set()
    for move in statements:
        if not isinstance(move, Move):
            continue
        if any(isinstance(target, CartesianTarget) for target in (move.target, move.via)):
            frames = {*names}
        else:
            frames = set() if move.type is MoveType.JOINT and not move.fly else {"tool"}
        needed |= {frame for frame in frames if getattr(move.settings, frame) is None}
    frame_by_name = {"base": np.eye(4), "tool": tool_frame(tool), "uframe": np.eye(4)}
    return {names[frame]: frame_by_name[frame] for frame in names if frame in needed}
