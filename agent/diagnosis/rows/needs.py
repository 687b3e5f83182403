"""What effects need of a joint's motion to show at all, and what the motion has of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.standstill import travelling_joints
from agent.model import Effect, MotionSignals

_METRES = 0.1  # derived: the unit of `Effect.needs_travel` where a joint slides [m]


@dataclass(frozen=True, eq=False)
class MotionCoverage:
    """What every joint went through: (n,) whether it moved, between which positions [rad or 0.1 m], its highest `speed`
    [/s], and how often it turned back by more than what counts as motion."""

    names: tuple[str, ...]
    moved: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    speed: np.ndarray
    reversals: np.ndarray

    @classmethod
    def of(cls, signals: Sequence[MotionSignals]) -> MotionCoverage:
        """Coverage of filtered motions."""
        robot = signals[0].reference.robot
        unit = np.where([joint.prismatic for joint in robot.joints], _METRES, 1.0)
        lowest, highest = (side([side(s.q, axis=0) for s in signals], axis=0) for side in (np.min, np.max))
        speed = np.max([np.abs(s.qd).max(axis=0) for s in signals], axis=0)
        turns = [sum(_count_reversals(s.q[:, j], LIMITS.least_travel) for s in signals) for j in range(robot.dof)]
        moved = travelling_joints(signals)
        return cls(robot.joint_names, moved, lowest / unit, highest / unit, speed / unit, np.array(turns))

    @property
    def travel(self) -> np.ndarray:
        """(n,) [rad or 0.1 m]."""
        return self.highest - self.lowest

    def __add__(self, other: MotionCoverage) -> MotionCoverage:
        """Coverage over both sets of motions."""
        return MotionCoverage(
            self.names,
            self.moved | other.moved,
            np.minimum(self.lowest, other.lowest),
            np.maximum(self.highest, other.highest),
            np.maximum(self.speed, other.speed),
            self.reversals + other.reversals,
        )

    def lacking(self, effect: Effect, joints: Sequence[int]) -> str:
        """Why an effect cannot show on these joints; empty where it can."""
        for j in joints:
            name = self.names[j]
            if not self.moved[j]:
                return f"{name} never moves in these logs"
            if self.travel[j] < effect.needs_travel:
                return f"{name} travels {self.travel[j]:.2g} of the {effect.needs_travel:g} rad (or 0.1 m) it takes"
            if self.speed[j] < effect.needs_speed:
                return f"{name} reaches {self.speed[j]:.2g} of the {effect.needs_speed:g} rad/s (or 0.1 m/s) it takes"
            if self.reversals[j] < effect.needs_reversals:
                return f"{name} turns back {self.reversals[j]} times, and it takes {effect.needs_reversals}"
        return ""


def _count_reversals(q: np.ndarray, least: float) -> int:
    """How often a position (S,) turns back by more than `least`."""
    turns, way = 0, 0
    low = high = q[0]
    q = q[:: max(1, len(q) // 5000)]
    onwards = np.diff(q)[:-1] * np.diff(q)[1:] > 0  # only where it turns it may be farthest
    for value in q[np.concatenate([[True], ~onwards, [True]])[: len(q)]].tolist():
        low, high = min(low, value), max(high, value)
        if way >= 0 and value < high - least:
            turns, way, low = turns + (way > 0), -1, value
        elif way <= 0 and value > low + least:
            turns, way, high = turns + (way < 0), 1, value
        if way > 0:
            low = value
        elif way < 0:
            high = value
    return turns
