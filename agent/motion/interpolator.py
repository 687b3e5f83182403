"""What every interpolator offers, and where they are found by name."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Any, Protocol

import numpy as np

from agent.core.errors import InputError
from agent.motion.program import Statement
from agent.motion.trajectory import Trajectory
from agent.robot.description import RobotDescription

#: Third parties add interpolators under this entry-point group.
ENTRY_POINTS = "calibration_agent.interpolators"


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
        """Set-points of the program, at rest at `start` (n,) [rad] first and at rest at the end.

        Raises:
            MotionError: the program cannot be run; names the move, the limit and by how much.
        """
        ...


def interpolator_names() -> tuple[str, ...]:
    """Names that `create_interpolator` knows: the built-in ones and those of installed packages."""
    return tuple(sorted({*_builtin(), *(entry.name for entry in entry_points(group=ENTRY_POINTS))}))


def create_interpolator(name: str, robot: RobotDescription, tool: Any = None, **options: Any) -> Interpolator:
    """An interpolator by its registered name.

    Raises:
        InputError: no interpolator has that name.
    """
    factory = _builtin().get(name)
    if factory is None:
        found = next((entry for entry in entry_points(group=ENTRY_POINTS) if entry.name == name), None)
        if found is None:
            raise InputError(f"interpolator {name!r} is not known; there are: {', '.join(interpolator_names())}")
        factory = found.load()
    return factory(robot, tool, **options)


def _builtin() -> dict[str, Any]:
    # Registered in code as well: a checkout that was never installed has no entry points.
    from agent.motion.fly import FlyInterpolator
    from agent.motion.orl import OrlInterpolator

    return {"fly": FlyInterpolator, "orl": OrlInterpolator}
