"""The cascaded position and velocity servo of an industrial drive, on the motor side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ServoGains:
    """Gains of n axles, arrays (n,).

    `position` [1/s]; `velocity` [N·m·s/rad] and `integral` [N·m/rad] of the PI velocity loop; `feedforward`, the
    fraction of the reference velocity that is fed forward; `inertia` [kg·m²], fed forward on the reference
    acceleration; `limit` [N·m], the largest torque of the drive.
    """

    position: np.ndarray
    velocity: np.ndarray
    integral: np.ndarray
    feedforward: np.ndarray
    inertia: np.ndarray
    limit: np.ndarray

    @classmethod
    def tuned(cls, inertia: np.ndarray, limit: np.ndarray) -> ServoGains:
        """Common gains for axles of total `inertia` (n,) [kg·m²] and torque `limit` (n,) [N·m].

        Position loop of 30/s, velocity loop of 190 rad/s that resets at 30/s, 95 % of the velocity fed forward.
        """
        ones, gain = np.ones(len(inertia)), 190.0 * inertia
        return cls(30.0 * ones, gain, 30.0 * gain, 0.95 * ones, 0.0 * inertia, limit)


class CascadedServo:
    """u = kv (kff ṙ + kp (r − θ) − θ̇) + ki ∫(…) dt + J r̈ + τ_ff, clamped; the integral holds while clamped."""

    def __init__(self, gains: ServoGains):
        columns = (gains.position, gains.velocity, gains.integral, gains.feedforward, gains.inertia, gains.limit)
        self._axles = list(zip(*(np.asarray(column, dtype=float).tolist() for column in columns), strict=True))
        self._integral = [0.0] * len(self._axles)

    def reset(self, torque: Sequence[float]) -> None:
        """Start from rest, holding against the static `torque` (n,)."""
        self._integral = list(torque)

    def step(
        self,
        reference: Sequence[float],
        reference_velocity: Sequence[float],
        feedforward: Sequence[float],
        position: Sequence[float],
        velocity: Sequence[float],
        dt: float,
    ) -> list[float]:
        """(n,) motor torque, on the axles; all arguments (n,). `feedforward` [N·m] is everything fed forward."""
        integral = self._integral
        torque = []
        for k, (kp, kv, ki, kff, _, limit) in enumerate(self._axles):
            error = kff * reference_velocity[k] + kp * (reference[k] - position[k]) - velocity[k]
            command = kv * error + integral[k] + feedforward[k]
            if command > limit:
                command = limit
            elif command < -limit:
                command = -limit
            else:
                integral[k] += ki * error * dt
            torque.append(command)
        return torque
