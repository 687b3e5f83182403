"""The settings of a move that joint trajectories have and other languages do not."""

from __future__ import annotations

from dataclasses import dataclass

from agent.motion.program import MotionSettings


@dataclass(frozen=True)
class PaceSettings(MotionSettings):
    """A move from wherever the arm rests: no joint exceeds this velocity and acceleration (n,)."""

    velocity: tuple[float, ...] = ()
    acceleration: tuple[float, ...] = ()


@dataclass(frozen=True)
class PointSettings(PaceSettings):
    """A point of a trajectory: reached `seconds` after the one before, with this velocity and acceleration (n,)."""

    seconds: float = 0.0
