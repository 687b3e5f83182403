"""What acts between the torque of the motors and the joints: the protocol, and its plainest implementation.

Everything here is on the axles (see `agent.robot.drivetrain`): an axle's position is its motor's angle over the gear
ratio where nothing gives way in between, a torque on it is the motor's times the gear ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np


class Actuation(Protocol):
    """Friction, gears, springs: n axles with whatever states they need, advanced one inner step at a time.

    Plain floats in lists: for six joints they cost a fifth of what small arrays do. All in rad, rad/s, N·m
    (m, m/s, N on a prismatic joint), of the axles.
    """

    @property
    def rigid(self) -> Sequence[bool]:
        """(n,) whether an axle turns with its motor, so that the rotor's inertia belongs to the joint's.

        Where it is False, `step` integrates the rotor itself.
        """

    def reset(self, position: Sequence[float], torque: Sequence[float]) -> None:
        """The arm rests, its axles at `position` (n,) under the static `torque` (n,)."""

    def motors(self, position: Sequence[float], velocity: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        """What the motors' encoders see, (n,) and (n,), while the axles' load side is at `position`, `velocity`."""

    def step(
        self, time: float, position: Sequence[float], velocity: Sequence[float], torque: Sequence[float], dt: float
    ) -> Sequence[float]:
        """(n,) torque on the load side while the motors give `torque` (n,); advances the states by `dt` [s]."""


class RigidActuation:
    """Stiff gears and friction f0 tanh(v / transition) + f1 v + f2 |v| v on every axle; it runs compiled.

    Arrays (n,): `coulomb` f0 [N·m], `viscous` f1 [N·m·s/rad], `quadratic` f2 [N·m·s²/rad²], `transition` [rad/s], all
    taken at the velocity after the step, so that friction that is stiff at rest stays stable. `bristles` (6, n) are
    those of `agent.compiled.march`, friction with a memory beside it.
    """

    def __init__(
        self,
        coulomb: np.ndarray | float,
        viscous: np.ndarray | float,
        quadratic: np.ndarray | float,
        transition: np.ndarray | float,
        bristles: np.ndarray | None = None,
    ):
        terms = np.broadcast_arrays(coulomb, viscous, quadratic, np.maximum(transition, 1e-9))
        memoryless = np.array(terms, dtype=float)
        self.friction = np.vstack([memoryless, np.zeros((6, memoryless.shape[1])) if bristles is None else bristles])

    @property
    def rigid(self) -> Sequence[bool]:
        return [True] * self.friction.shape[1]

    def reset(self, position: Sequence[float], torque: Sequence[float]) -> None:
        pass

    def motors(self, position: Sequence[float], velocity: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        return position, velocity
