"""Output error: the servo numbers whose free motion follows the recorded positions (Levenberg-Marquardt).

Minimised is Σ (q − q(θ))² / σ² over all frames and joints, plus a wide prior about the file's numbers: each may differ
by what would take all of its joint's torque. Every stretch starts at its first frames' position and speed, as a start
that is fitted hides where friction holds a joint. It is judged from when the servos have settled. Derivatives are those
of the linear response. No number goes below zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agent.core import InputError
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.recording import CommandedStretch, LinearisedMotion
from agent.diagnosis.rows.rounding import rounding_step
from agent.model import NominalModel
from agent.simulators import KINDS, FreeMotion, FreeSimulator, ServoNumbers

_ROUNDS, _TRIES = 30, 6
_GAINED = 1e-3  # of the cost, below which a round is the last
_LONGEST_DELAY = 0.6  # s
_DELAY = 0.1  # s, prior deviation of a delay


@dataclass(frozen=True, eq=False)
class Parameters:
    """Which of the 5 n numbers are free, and which move together: `basis` (5 n, p) of the table's change."""

    basis: np.ndarray
    scale: np.ndarray

    @classmethod
    def create(cls, scale: np.ndarray, fixed: Sequence[str] = (), one_delay: bool = True) -> Parameters:
        """All numbers but kinds that are `fixed`, in units of `scale` (5, n); one delay of the arm, or one a joint."""
        kinds, n = len(KINDS), scale.shape[1]
        eye = np.eye(kinds * n)
        columns = []
        for number, kind in enumerate(KINDS):
            own = eye[:, number * n : (number + 1) * n]
            if kind in fixed:
                continue
            columns.append(own.sum(axis=1, keepdims=True) if kind == "delay" and one_delay else own)
        return cls(np.hstack(columns), scale)


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """A fit: the numbers, the motions linearised there, and residuals q − q(θ) per stretch (S', n)."""

    simulator: FreeSimulator
    reference: NominalModel
    parameters: Parameters
    numbers: ServoNumbers
    stretches: tuple[CommandedStretch, ...]
    motions: tuple[LinearisedMotion, ...]
    residuals: tuple[np.ndarray, ...]
    sigma: np.ndarray

    @cached_property
    def columns(self) -> list[np.ndarray]:
        """Per stretch (S', n, 5 n): change of its positions with each number."""
        return [one.number_columns(self.simulator, self.numbers) for one in self.motions]

    @property
    def rmse(self) -> np.ndarray:
        """(n,) root mean square over all frames."""
        return np.sqrt(np.mean(np.concatenate(self.residuals) ** 2, axis=0))


def usual_scale(reference: NominalModel, numbers: ServoNumbers, stretches: Sequence[CommandedStretch]) -> np.ndarray:
    """(5, n) of each number what would take all of its joint's torque; of kp itself, of a delay 0.1 s."""
    lag, speed, acceleration = [], [], []
    for one in stretches:
        asked = one.command.between(np.append(one.time, 2 * one.time[-1] - one.time[-2]), numbers.delay)
        qd = np.gradient(one.position, one.time, axis=0)
        lag.append(asked - one.position)
        speed.append(qd)
        acceleration.append(np.gradient(qd, one.time, axis=0))
    torque, speeds, accelerations = (
        np.maximum(np.sqrt(np.mean(np.concatenate(part) ** 2, axis=0)), 1e-6) for part in (lag, speed, acceleration)
    )
    torque = torque * numbers.kp
    return np.stack([torque / accelerations, torque / speeds, torque, numbers.kp, np.full(len(torque), _DELAY)])


def rounding_error(stretches: Sequence[CommandedStretch]) -> np.ndarray:
    """(n,) error of positions by their rounding [rad or m]."""
    steps = [[rounding_step(column) for column in one.position.T] for one in stretches]
    return np.asarray(np.max(steps, axis=0) / np.sqrt(12))


def usual_twist(motions: Sequence[FreeMotion], kp: np.ndarray) -> np.ndarray:
    """(n,) how far the servos' torque twists them [rad or m]: a share of torque is the same share of it.

    Not the lag behind the recorded command: most of that is the delay, which has no error of its own.
    """
    torque = np.std(np.concatenate([one.torque for one in motions]), axis=0)
    return np.asarray(np.maximum(torque / np.maximum(kp, 1e-9), 1e-6))


def fit_output_error(
    simulator: FreeSimulator,
    reference: NominalModel,
    stretches: Sequence[CommandedStretch],
    file: ServoNumbers,
    start: ServoNumbers,
    parameters: Parameters,
    progress: Callable[[str], None] = lambda text: None,
    gained: float = _GAINED,
) -> OutputErrorFit:
    """Fit the numbers.

    Raises:
        InputError: the simulator blows up with the numbers to start from.
    """
    basis, scale = parameters.basis, parameters.scale.ravel()
    size = np.sqrt(np.maximum((basis**2 * scale[:, None] ** 2).sum(axis=0) / (basis**2).sum(axis=0), 1e-300))
    table, n = start.table.ravel(), len(start.kp)
    first = _run(simulator, table, stretches)
    if first is None:
        raise InputError(f"{simulator.arm.path}: the simulator blows up under the recorded command as the file is")
    motions: list[FreeMotion] = first
    sigma = np.hypot(rounding_error(stretches), LIMITS.least_error * usual_twist(motions, start.kp))
    x = np.linalg.lstsq(basis, table - file.table.ravel(), rcond=None)[0]
    weight, residuals = 1e-2, _left(stretches, motions)

    def cost_of(left: Sequence[np.ndarray], at: np.ndarray) -> float:
        return sum(float(np.sum((one / sigma) ** 2)) for one in left) + float(np.sum((at / size) ** 2))

    cost = cost_of(residuals, x)
    for number in range(_ROUNDS):
        numbers = ServoNumbers.of_table(table.reshape(len(KINDS), n))
        matrix, side = np.diag(1 / size**2), -x / size**2
        for one, motion, left in zip(stretches, motions, residuals, strict=True):
            line = one.linearised(simulator, numbers, motion, reference)
            rows = (line.number_columns(simulator, numbers) @ basis / sigma[None, :, None]).reshape(-1, len(size))
            matrix += rows.T @ rows
            side += rows.T @ (left / sigma).ravel()
        drop = 0.0
        for _ in range(_TRIES):
            step = _bounded_step(matrix, side, weight, basis, table)
            moved = np.maximum(table + basis @ step, 0.0)
            moved[-n:] = np.minimum(moved[-n:], _LONGEST_DELAY)
            now = _run(simulator, moved, stretches)
            if now is not None:
                left_now = _left(stretches, now)
                if (cost_now := cost_of(left_now, x + step)) < cost:
                    drop = 1 - cost_now / cost
                    table, x, motions, residuals, cost = moved, x + step, now, left_now, cost_now
                    break
            weight *= 5
        if not drop:
            break
        weight = max(weight / 10, 1e-8)
        progress(f"output error, round {number + 1}")
        if drop < gained:
            break
    numbers = ServoNumbers.of_table(table.reshape(len(KINDS), n))
    lines = [s.linearised(simulator, numbers, m, reference) for s, m in zip(stretches, motions, strict=True)]
    return OutputErrorFit(
        simulator, reference, parameters, numbers, tuple(stretches), tuple(lines), tuple(residuals), sigma
    )


def _left(stretches: Sequence[CommandedStretch], motions: Sequence[FreeMotion]) -> list[np.ndarray]:
    return [missed(one, motion) for one, motion in zip(stretches, motions, strict=True)]


def missed(stretch: CommandedStretch, motion: FreeMotion) -> np.ndarray:
    """(S', n) what a motion misses of the judged positions."""
    return stretch.position[stretch.judged] - motion.at(stretch.time[stretch.judged])


def _bounded_step(
    matrix: np.ndarray, side: np.ndarray, weight: float, basis: np.ndarray, table: np.ndarray
) -> np.ndarray:
    """The damped step; numbers that are zero and would fall stay there."""
    free = np.ones(len(matrix), dtype=bool)
    for _ in range(len(matrix)):
        at = np.flatnonzero(free)
        some = matrix[np.ix_(at, at)]
        unit = 1 / np.sqrt(np.diag(some))
        some = some * np.outer(unit, unit) + weight * np.eye(len(at))
        step = np.zeros(len(matrix))
        step[at] = unit * np.linalg.solve(some, unit * side[at])
        below = (table <= 0) & (basis @ step < 0)
        stopped = np.any(basis[below] != 0, axis=0) & free
        if not stopped.any():
            break
        free &= ~stopped
    return step


def _run(simulator: FreeSimulator, table: np.ndarray, stretches: Sequence[CommandedStretch]) -> list[FreeMotion] | None:
    numbers = ServoNumbers.of_table(table.reshape(len(KINDS), -1))
    found = []
    for one in stretches:
        if (motion := one.run(simulator, numbers)) is None:
            return None
        found.append(motion)
    return found
