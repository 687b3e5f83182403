"""The interface of every interpolator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from agent.core import InputError
from agent.motion.program import Statement
from agent.motion.trajectory import Trajectory


class MotionError(InputError):
    """A program that the arm cannot run.

    `move` is the index of the statement, `limit` what it breaks (`reach`, `singularity`, `joint_3 position`, …) and
    `excess` > 0 how far it is beyond, dimensionless, so that a search can rank what is infeasible.
    """

    def __init__(self, message: str, move: int, limit: str, excess: float):
        super().__init__(message)
        self.move = move
        self.limit = limit
        self.excess = max(float(excess), 1e-9)


class Interpolator(Protocol):
    """Turns a program into the set-points that the controller would send to its servos."""

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program, from a standstill at `start` (n,) [rad] to a standstill at the end.

        Raises:
            MotionError: the program cannot be run; names the move, the limit and by how much.
        """
        ...
