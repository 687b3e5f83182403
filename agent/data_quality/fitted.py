"""Checks of a fitted model that point to mistakes in its logs or its description."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.data_quality.finding import QualityFinding
from agent.model import IdentifiedModel
from agent.recording import Log

_CERTAIN = 5.0  # standard deviations below zero
_FAR = 10.0  # times the noise of torque, and
_MUCH = 0.1  # of a joint's torque, root mean square: an error that is worth a look


def fitted_doubts(model: IdentifiedModel, logs: Sequence[Log]) -> list[QualityFinding]:
    """Rotor inertias that none has, and errors far above the noise, with the likeliest reason."""
    return [*_negative_rotors(model), *_large_errors(model, logs)]


def _negative_rotors(model: IdentifiedModel) -> Iterator[QualityFinding]:
    n = model.robot.dof
    deviation = np.sqrt(np.diag(model.covariance))
    first = len(model.standard_names) - n  # rotors come last
    found = []
    for row, (of, parameter) in enumerate(zip(model.projection, model.independent, strict=True)):
        alone = parameter >= first and np.count_nonzero(of) == 1
        if alone and model.values[row] < -_CERTAIN * deviation[row]:
            found.append((model.robot.joint_names[parameter - first], float(model.values[row])))
    if found:
        listed = ", ".join(f"{name} {value:.3g} kg·m²" for name, value in found)
        yield QualityFinding(
            f"the fit gives rotors a negative inertia ({listed}), which none has",
            tuple(name for name, _ in found),
            advice="check lengths and axes of the URDF, gear ratios, and that positions and torques share their stamps",
            refuses=False,
        )


def _large_errors(model: IdentifiedModel, logs: Sequence[Log]) -> Iterator[QualityFinding]:
    efforts = [(log.effort, log.sample_rate) for log in logs if log.effort is not None]
    noise = np.sqrt(np.mean([_torque_noise(effort, rate, model.cutoff) ** 2 for effort, rate in efforts], axis=0))
    torque = np.concatenate([effort for effort, _ in efforts])
    size = np.sqrt(np.mean(torque**2, axis=0))
    large = (model.held_out_rmse > _FAR * noise) & (model.held_out_rmse > _MUCH * size)
    if large.any():
        whose = tuple(np.array(model.robot.joint_names)[large].tolist())
        share = 100 * (model.held_out_rmse / size)[large]
        listed = ", ".join(f"{name} {percent:.0f} %" for name, percent in zip(whose, share, strict=True))
        yield QualityFinding(
            f"the model leaves much more of the torque than its noise: {listed}",
            whose,
            advice="likeliest: lengths or axes of the URDF, a unit, or an effect beyond bodies and friction; "
            "`agent diagnose` with this model says which",
            refuses=False,
        )


def _torque_noise(effort: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """(n,) standard deviation of white noise on a torque (S, n), as a filter at `cutoff` [Hz] leaves it."""
    fourth = np.median(np.abs(np.diff(effort, 4, axis=0)), axis=0) / (0.6745 * np.sqrt(70))
    return np.asarray(fourth * np.sqrt(min(1.0, 2 * cutoff / rate)))
