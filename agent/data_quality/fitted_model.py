"""Checks of a fitted model that point to mistakes in its logs or its description."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.data_quality.faults import QualityFinding
from agent.data_quality.rigid_fit import SAMPLES_PER_PARAMETER
from agent.estimation import FilterSettings, motions
from agent.model import IdentifiedModel
from agent.recording import Log

_CERTAIN = 5.0  # standard deviations below zero
_FAR = 10.0  # times the noise of torque, and
_MUCH = 0.1  # of a joint's torque, root mean square: an error that is worth a look
_APART = 1e-3  # rad or m between postures; the same logs pass at 0.2 to 5 mm, and at 10 mm a stroke of 8 mm fails


def fitted_doubts(model: IdentifiedModel, logs: Sequence[Log]) -> Iterator[QualityFinding]:
    """Too little motion for the parameters; else rotor inertias that none has, and errors far above the noise."""
    postures, needed = _postures(model, logs), SAMPLES_PER_PARAMETER * len(model.values) / model.robot.dof
    if postures < needed:
        text = (
            f"too little motion: the arm goes through {postures} independent postures ({_APART:g} rad or m and half a "
            f"period of the {model.cutoff:g} Hz cut-off apart); {len(model.values)} parameters need {needed:.0f}"
        )
        yield QualityFinding(text, advice="move longer, every joint both ways and in other postures")
        return
    if rotors := _negative_rotors(model):
        listed = ", ".join(f"{name} {value:.3g} kg·m²" for name, value in rotors.items())
        text = f"the fit gives rotors a negative inertia ({listed}), which none has"
        advice = "check lengths and axes of the URDF, gear ratios, and that positions and torques share their stamps"
        yield QualityFinding(text, tuple(rotors), advice=advice, refuses=False)
    if friction := _negative_friction(model):
        listed = ", ".join(f"{name} {value:.3g}" for name, value in friction.items())
        text = f"the fit gives Coulomb friction that drives the joint on ({listed} N·m or N), which none does"
        advice = "check that torques and positions share their stamps, and signs and units of torques"
        yield QualityFinding(text, tuple(friction), advice=advice, refuses=False)
    if errors := _large_errors(model, logs):
        listed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in errors.items())
        text = f"the model leaves much more of the torque than its noise: {listed}"
        advice = "likeliest: lengths or axes of the URDF, a unit, or an effect beyond bodies and friction; "
        advice += "`agent diagnose` with this model says which"
        yield QualityFinding(text, tuple(errors), advice=advice, refuses=False)


def _postures(model: IdentifiedModel, logs: Sequence[Log]) -> int:
    """Samples of the filtered motions that are independent, and apart by more than a joint that rests moves."""
    count, settings = 0, FilterSettings(model.cutoff, model.order)
    for motion in (filtered for log in logs for filtered in motions(log, settings)):
        q, every = motion.q[motion.kept], max(1, round(motion.rate / motion.step / (2 * model.cutoff)))
        last = q[0]
        for posture in q[::every]:
            if np.abs(posture - last).max() > _APART:
                count, last = count + 1, posture
    return count


def _negative_rotors(model: IdentifiedModel) -> dict[str, float]:
    """Rotor inertia [kg·m²] by joint, where it is clearly negative and identified alone."""
    deviation = np.sqrt(np.diag(model.covariance))
    first = len(model.standard_names) - model.robot.dof  # rotors come last
    return {
        model.robot.joint_names[parameter - first]: float(model.values[row])
        for row, (combined, parameter) in enumerate(zip(model.projection, model.independent, strict=True))
        if parameter >= first and np.count_nonzero(combined) == 1 and model.values[row] < -_CERTAIN * deviation[row]
    }


def _negative_friction(model: IdentifiedModel) -> dict[str, float]:
    """Coulomb friction [N·m or N] by joint, where it is clearly negative."""
    deviation = np.sqrt(np.diag(model.covariance))
    negative = {
        int(name.removeprefix("f0_")): value
        for name, value, scatter in zip(model.names, model.values, deviation, strict=True)
        if name.startswith("f0_") and name[3:].isdecimal() and value < -_CERTAIN * scatter
    }
    return {model.robot.joint_names[number - 1]: float(value) for number, value in negative.items()}


def _large_errors(model: IdentifiedModel, logs: Sequence[Log]) -> dict[str, float]:
    """Held-out error relative to the torque, by joint, where it is large and far above the noise."""
    efforts = [(log.effort, log.sample_rate) for log in logs if log.effort is not None]
    noise = np.sqrt(np.mean([_torque_noise(effort, rate, model.cutoff) ** 2 for effort, rate in efforts], axis=0))
    size = np.sqrt(np.mean(np.concatenate([effort for effort, _ in efforts]) ** 2, axis=0))
    return {
        name: float(error / torque)
        for name, error, torque, least in zip(model.robot.joint_names, model.held_out_rmse, size, noise, strict=True)
        if torque > 0 and error > _FAR * least and error > _MUCH * torque
    }


def _torque_noise(effort: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """(n,) standard deviation of white noise on a torque (S, n), as a filter at `cutoff` [Hz] leaves it."""
    fourth = np.median(np.abs(np.diff(effort, 4, axis=0)), axis=0) / (0.6745 * np.sqrt(70))
    return np.asarray(fourth * np.sqrt(min(1.0, 2 * cutoff / rate)))
