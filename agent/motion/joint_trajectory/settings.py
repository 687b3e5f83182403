"""The settings of a move that joint trajectories have and other languages do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.motion.interpolator import MotionError
from agent.motion.program import JointTarget, MotionSettings, Move
from drivers.errors import RefusedError
from drivers.joint_trajectory import parts


@dataclass(frozen=True)
class PointSettings(MotionSettings):
    """A point of a trajectory: reached `seconds` after the one before, with this velocity and acceleration (n,)."""

    seconds: float = 0.0
    velocity: tuple[float, ...] = ()
    acceleration: tuple[float, ...] = ()


@dataclass(frozen=True)
class PaceSettings(MotionSettings):
    """A move from wherever the arm rests: no joint exceeds this velocity and acceleration (n,)."""

    velocity: tuple[float, ...] = ()
    acceleration: tuple[float, ...] = ()


def parted(moves: Sequence[Move], start: np.ndarray) -> list[Sequence[Move]]:
    """Moves from stop to stop, from rest at `start` (n,), cut where a controller is given another goal on the way.

    Raises:
        MotionError: a move would take too many.
    """
    move = moves[0]
    if not (isinstance(move.settings, PaceSettings) and isinstance(move.target, JointTarget)):
        return [moves]
    pace, part = move.settings, move.settings.speed_override
    limits = part * np.array(pace.velocity), part * np.array(pace.acceleration)
    try:
        ends = parts(start, move.target.position, *limits)
    except RefusedError as error:
        raise MotionError(f"line {move.line}: {error}", 0, "duration", 1.0) from None
    return [[replace(move, target=JointTarget(end))] for end in ends]
