"""How an arm under position servos answers to a small torque: its motion, linearised along a simulated one.

M δq̈ + D δq̇ + K δq = −τ, with τ what the motors have to give in addition (the sign of an effect's torque), M the mass
matrix, D damping, K = kₚ and the slopes of gravity and springs. A joint that friction holds only creeps; a servo at its
limit does not pull. The trapezoidal rule has second order and no damping of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agent.model import MotionSignals
from agent.simulators import FreeMotion, ServoNumbers

_AT_ONCE = 256  # numerical: columns that are stepped together


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """The response along one motion, at the `kept` ones of S times (S,) [s].

    mass (S, n, n), damping (S, n), stiffness (S, n, n); `at_once` (S, n) is damping that acts within a step: of
    friction that holds a joint, or turns with its speed.
    """

    time: np.ndarray
    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    at_once: np.ndarray
    kept: slice

    @classmethod
    def along(
        cls,
        signals: MotionSignals,
        motion: FreeMotion,
        numbers: ServoNumbers,
        kv: np.ndarray,
        creep: np.ndarray,
    ) -> LinearResponse:
        """Along a simulated motion whose samples are those of `signals`; kv (n,) is the servos' part of the damping,
        creep (n,) [1/s] the damping over inertia of a joint that friction holds."""
        free = ~motion.limited
        n = signals.q.shape[1]
        stiffness = signals.slow_slope + np.einsum("sj,jk->sjk", free * numbers.kp + numbers.stiffness, np.eye(n))
        mass = signals.mass + np.diag(numbers.armature)
        damping = np.where(free, numbers.damping, numbers.damping - np.minimum(kv, numbers.damping))
        held = creep * np.diagonal(mass, axis1=1, axis2=2)
        # friction that turns with the speed within a step has a slope of twice its level over the change of speed
        change = np.diff(motion.qd, axis=0, append=motion.qd[-1:])
        turns = (motion.qd * (motion.qd + change) < 0) & ~motion.stuck
        turning = np.where(turns, 2 * numbers.friction / np.maximum(np.abs(change), 1e-9), 0.0)
        at_once = np.where(motion.stuck, held, np.minimum(turning, held))
        return cls(motion.time, mass, np.where(motion.stuck, 0.0, damping), stiffness, at_once, signals.kept)

    @cached_property
    def _steps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """δq̇ at the next time by [δq, δq̇] at one (S - 1, n, 2n) and by the torque between (S - 1, n, n), and half of
        the time between (S - 1,)."""
        h = np.diff(self.time)[:, None, None]
        n = self.damping.shape[1]
        eye = np.eye(n)
        mass, slope = self.mass[:-1], self.stiffness[:-1]
        half = 0.5 * h
        before = half * (self.damping[:-1, :, None] * eye)
        after = before + h * (self.at_once[:-1, :, None] * eye)
        inverse = np.linalg.inv(mass + after + half**2 * slope)
        from_q, push = -inverse @ (h * slope), -inverse * h
        from_qd = inverse @ (mass - before - half**2 * slope)
        return np.concatenate([from_q, from_qd], axis=2), push, half.ravel()

    def of_torque(self, columns: Mapping[int, np.ndarray]) -> np.ndarray:
        """(S', n, K) positions for torque columns (S, K) by joint, the same K for each joint."""
        width = next(iter(columns.values())).shape[1]
        parts = []
        for first in range(0, width, _AT_ONCE):
            chunk = {j: block[:, first : first + _AT_ONCE] for j, block in columns.items()}
            parts.append(self._stepped(chunk))
        return np.concatenate(parts, axis=2)

    def _stepped(self, columns: Mapping[int, np.ndarray]) -> np.ndarray:
        from agent.compiled import stepped

        system, by_torque, half = self._steps
        push = np.stack([(block[1:] + block[:-1]) / 2 for block in columns.values()], axis=1).astype(float, order="C")
        kept = range(len(self.time))[self.kept]
        entry = np.ascontiguousarray(by_torque[:, :, list(columns)])
        answers = stepped(system, entry, half, push, kept.start, kept.step)
        return np.asarray(answers[: len(kept)])
