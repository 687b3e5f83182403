"""What is about to move."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drivers.protocol import ViaPoint

if TYPE_CHECKING:
    from agent.motion.trajectory import Trajectory


def rest_at(position: np.ndarray) -> Trajectory:
    """The plan of an arm that stays at `position` (n,)."""
    from agent.motion.trajectory import Trajectory

    there = np.asarray(position, dtype=float)[None]
    nothing, unknown = np.zeros_like(there), np.full((1, 4, 4), np.nan)
    return Trajectory(np.zeros(1), there, nothing, nothing, unknown, np.zeros(1), np.zeros(1, dtype=int))


@dataclass(frozen=True, eq=False)
class PlannedProgram:
    """PDL2 text under a name, and what we planned of it from stop to stop.

    `stands_for`: checksum of the program that this one is the slow version of; empty for any other. `points`: the same
    motion for a controller that takes via-points.
    """

    name: str
    text: str
    chains: tuple[Trajectory, ...]
    stands_for: str = ""
    points: tuple[ViaPoint, ...] = ()

    @property
    def checksum(self) -> str:
        """SHA-256 (hex) of the text."""
        return hashlib.sha256(self.text.encode("utf-8")).hexdigest()

    @property
    def duration(self) -> float:
        """Seconds of motion."""
        return float(sum(chain.duration for chain in self.chains))

    @property
    def speed(self) -> float:
        """Highest speed of the tool centre point [m/s]."""
        return max((float(np.max(chain.path_speed)) for chain in self.chains), default=0.0)
