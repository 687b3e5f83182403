"""The interface of every interpolator, and its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from agent.core import InputError
from agent.motion.program import Statement

#: Torques along a motion are worked out at one sample in this many; limits of joints and tool are checked at each.
TORQUE_STRIDE = 10


@dataclass(frozen=True)
class BindingLimit:
    """A limit that slows the motion down: which (`joint_3 speed`, `linear acceleration`, …), and where [s]."""

    limit: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Set-points at the controller's period. S samples, n joints, SI.

    t (S,); q, qd, qdd (S, n); tcp (S, 4, 4); path_speed (S,) of the TCP [m/s];
    move (S,) index of the statement that a sample belongs to; binding: the limits that slowed it down.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tcp: np.ndarray
    path_speed: np.ndarray
    move: np.ndarray
    binding: tuple[BindingLimit, ...] = field(default_factory=tuple)

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.t[-1] - self.t[0])

    def thinned(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, q̇ and q̈ (S', n) at one sample in `TORQUE_STRIDE`, for the torque that the motion needs."""
        return self.q[::TORQUE_STRIDE], self.qd[::TORQUE_STRIDE], self.qdd[::TORQUE_STRIDE]


class LazyTrajectory(Trajectory):
    """One of which the fields in `late` are computed on first use: a search never asks for them."""

    def __init__(self, late: Mapping[str, Callable[[], Any]], **values: np.ndarray):
        self.__dict__.update(values, _late=late)  # a frozen dataclass is set like this

    def __getattr__(self, name: str) -> Any:
        late = self.__dict__.get("_late", {})
        if name not in late:
            raise AttributeError(name)
        return self.__dict__.setdefault(name, late[name]())


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
