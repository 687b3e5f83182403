"""A program that was planned and checked, as it is about to run."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from drivers.protocol import ViaPoint

if TYPE_CHECKING:
    from agent.motion import Statement, Trajectory

#: Limits of a motion's duration: ratio to the plan, time at each stop [s], and time before and after the motion [s].
SLOWER, SETTLING, WAITING = 1.25, 3.0, 10.0
#: An approach shorter than this [rad, m] is where the arm rests off its set-point; the controller makes none.
ARRIVED_WITHIN = 1e-3


def is_standstill(chain: Trajectory) -> bool:
    """Whether a stretch moves too little for a controller to make it."""
    return bool(np.ptp(chain.q, axis=0).max() < ARRIVED_WITHIN)


def standstill_plan(position: np.ndarray) -> Trajectory:
    """The plan of an arm that stays at `position` (n,)."""
    from agent.motion import Trajectory

    q = np.asarray(position, dtype=float)[None]
    nothing, unknown = np.zeros_like(q), np.full((1, 4, 4), np.nan)
    return Trajectory(np.zeros(1), q, nothing, nothing, unknown, np.zeros(1), np.zeros(1, dtype=int))


def pauses(statements: Iterable[Statement]) -> float:
    """Seconds that a program rests because it says so."""
    from agent.motion import Delay

    return sum(statement.seconds for statement in statements if isinstance(statement, Delay))


@dataclass(frozen=True, eq=False)
class PlannedProgram:
    """A program under a name, and what we planned of it from stop to stop.

    `statements`: what its text says. `stands_for`: checksum of the program that this one is the slow version of; empty
    for any other. `points`: the same motion for a controller that takes via-points. `pauses` [s]: rests that the
    program asks for (DELAY). `frames`: those of the controller that the plan takes for granted, (4, 4) [m] by their
    name in the dialect; none where the program sets all that it needs. `approaches`: chains of the way to the first
    point.
    """

    name: str
    text: str
    chains: tuple[Trajectory, ...]
    stands_for: str = ""
    points: tuple[ViaPoint, ...] = ()
    pauses: float = 0.0
    frames: Mapping[str, np.ndarray] = field(default_factory=dict)
    statements: tuple[Statement, ...] = ()
    approaches: int = 1

    @property
    def checksum(self) -> str:
        """SHA-256 (hex) of the text."""
        return hashlib.sha256(self.text.encode("utf-8")).hexdigest()

    @property
    def duration(self) -> float:
        """Seconds of motion, and of the rests that the program asks for."""
        return float(sum(chain.duration for chain in self.chains)) + self.pauses

    @property
    def longest(self) -> float:
        """Seconds after which the motion must be over, all stops included."""
        return SLOWER * (self.duration - self.pauses) + self.pauses + SETTLING * len(self.chains) + WAITING

    @property
    def longest_rest(self) -> float:
        """Seconds that the arm may stand at one stop: the longest rest that the program asks for, and settling."""
        from agent.motion import Delay

        rests = [0.0]
        for statement in self.statements:
            rests.append(rests[-1] + statement.seconds if isinstance(statement, Delay) else 0.0)
        return SETTLING + (max(rests) if self.statements else self.pauses)

    @property
    def speed(self) -> float:
        """Highest speed of the tool centre point [m/s]."""
        return float(np.max([np.max(chain.path_speed) for chain in self.chains], initial=0.0))
