"""Prediction error from rounded positions: the torque of accelerations that did not happen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.model import NominalModel
from agent.recording import Log

_POSTURES = 20  # numerical: of a log, for its mean inertia
_ON_GRID = 0.01  # numerical: steps off the grid that count as on it
UNIFORM = 1 / 12  # derived: variance of an error within half a step, in steps squared
_FIFTH = 1 / 5  # derived: ∫₀¹ x⁴ dx


def rounding_noise(reference: NominalModel, logs: Sequence[Log], cutoff: float) -> np.ndarray:
    """(n,) [N·m] root mean square of the torque that is predicted from the rounding of positions alone.

    Rounding to a step Δ at a rate f_s is white noise of Δ² / 12 (Widrow, Kollár, Quantization Noise, 2008) while a
    joint moves by more than a step a sample or so. Differentiated twice and passed up to the cut-off f_c it has a
    variance of Δ² / 12 · (2 / f_s) ∫₀^f_c (2π f)⁴ df, and the mass matrix makes torque of it. Of the log with most.
    """
    rotors = reference.coupling.T * (reference.rotors * reference.robot.gear_ratios**2) @ reference.coupling
    largest = np.zeros(reference.robot.dof)
    for log in logs:
        step = np.array([rounding_step(column) for column in log.position.T])
        variance = UNIFORM * step**2 * (2 / log.sample_rate) * _FIFTH * (2 * np.pi) ** 4 * cutoff**5
        every = max(1, len(log.position) // _POSTURES)
        inertia = np.mean([reference.solid.mass_matrix(q) for q in log.position[::every]], axis=0) + rotors
        noise = inertia**2 @ variance
        largest = np.maximum(largest, np.sqrt(noise))
    return largest


def rounding_step(position: np.ndarray) -> float:
    """Step that all positions (S,) are multiples of, apart from an offset; 0 if there is none."""
    values = np.unique(position)
    steps = np.diff(values)
    steps = steps[steps > 1e-9 * max(float(np.abs(values).max()), 1e-9)]
    if len(steps) < 2:
        return 0.0
    step = float(steps.min())
    off = np.abs((values - values[0]) / step - np.round((values - values[0]) / step))
    return step if np.mean(off > _ON_GRID) < _ON_GRID else 0.0
