"""Under which conditions a run was made, and what friction it met: what the history compares from run to run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.recording import Log

if TYPE_CHECKING:
    from agent.link import Recording
    from agent.model import IdentifiedModel
    from agent.validation import Prediction

#: Friction is compared at these shares of the highest speed the axle had in the loop.
SHARES = (0.15, 0.6)
_FEWEST_CYCLES = 3


@dataclass(frozen=True)
class Level:
    """Friction torque [N·m] of an axle turning forward at a steady `speed` [rad/s], with its deviations.

    `standard_deviation` is all that is not known; `from_run_to_run` leaves out what base parameters kept from an
    earlier model may be off, which is the same in every run that keeps them.
    """

    joint: str
    speed: float
    value: float
    standard_deviation: float
    from_run_to_run: float


@dataclass(frozen=True, eq=False)
class WarmUp:
    """Relative change of friction per second of motion (n,) and its deviation (n,); NaN where cycles are too few."""

    rate: np.ndarray
    deviation: np.ndarray


def friction_levels(model: IdentifiedModel, top_speed: np.ndarray) -> list[Level]:
    """Friction of every axle at the `SHARES` of its `top_speed` (n,) [rad/s].

    Single friction parameters lean on each other; friction at a speed the axle had does not.
    """
    from agent.estimation import conditional_covariance
    from agent.model import ODD, steady_columns

    base = len(model.independent)
    between = conditional_covariance(model)
    levels = []
    for axle, joint in enumerate(model.robot.joint_names):
        # an offset and an asymmetry are no friction level; load friction counts from no load
        own = np.array([term.axle == axle and term.form in ODD for term in model.terms], dtype=bool)
        speeds = np.array(SHARES) * float(top_speed[axle])
        turning = np.maximum(speeds, np.finfo(float).tiny)
        for speed, row in zip(speeds, steady_columns(model.terms, turning, sharp=True) * own, strict=True):
            deviation = np.sqrt(max(row @ model.covariance[base:, base:] @ row, 0.0))
            between_runs = np.sqrt(max(row @ between @ row, 0.0))
            level = float(row @ model.friction_values)
            levels.append(Level(joint, float(speed), level, float(deviation), float(between_runs)))
    return levels


def top_speed(log: Log, model: IdentifiedModel) -> np.ndarray:
    """(n,) speed [rad/s] that each axle reached in a log, but for the fastest hundredth of it."""
    from agent.robot import axle_motion

    speed = np.gradient(log.position, log.t, axis=0) if log.velocity is None else log.velocity
    return np.quantile(np.abs(axle_motion(model.robot, speed)), 0.99, axis=0)


def warm_up(log: Log, prediction: Prediction) -> WarmUp:
    """How friction changed while the arm moved: its scale against the model's, cycle by cycle, over time.

    For each cycle the scale is <F, F + e> / <F, F>, F the model's friction torque and e what the model leaves; the rate
    is the slope of a straight line through the cycles.
    """
    n = prediction.model.robot.dof
    nothing = np.full(n, np.nan)
    starts = np.asarray(log.cycle_starts, dtype=float)
    if len(starts) < _FEWEST_CYCLES:
        return WarmUp(nothing, nothing)
    length = float(np.median(np.diff(starts)))
    numerator, denominator = np.zeros((len(starts), n)), np.zeros((len(starts), n))
    for cycle, start in enumerate(starts):
        inside = slice(*np.searchsorted(prediction.time, (start, start + length)))
        force = prediction.friction[inside]
        error = prediction.measured[inside] - prediction.predicted[inside]
        numerator[cycle], denominator[cycle] = np.sum(force * error, axis=0), np.sum(force**2, axis=0)
    whole = np.all(denominator > 0, axis=1)
    if whole.sum() < _FEWEST_CYCLES:
        return WarmUp(nothing, nothing)
    scale = numerator[whole] / denominator[whole]
    time = starts[whole] - starts[whole].mean()
    rate = time @ scale / (time @ time)
    left = scale - scale.mean(axis=0) - np.outer(time, rate)
    deviation = np.sqrt(np.sum(left**2, axis=0) / max(1, len(time) - 2) / (time @ time))
    return WarmUp(rate, deviation)


def conditions(log: Log, prediction: Prediction, recording: Recording) -> dict[str, Any]:
    """What `result.json` says of a run's conditions and of the friction it met, as plain data.

    Args:
        log: the excitation, of which `prediction` is; `recording` says how it came about.
    """
    model = prediction.model
    found = warm_up(log, prediction)
    return {
        "cycles": len(log.cycle_starts),
        "motion_s": float(log.t[-1] - log.t[0]),
        "temperatures_c": dict(zip(("first", "last"), recording.temperatures, strict=False)) or None,
        "warm_up": {"rate_per_s": found.rate.tolist(), "standard_deviation": found.deviation.tolist()},
        "nominal_torque": [float(v) if np.isfinite(v) else None for v in model.robot.nominal_torque],
        "friction": [level.__dict__ for level in friction_levels(model, top_speed(log, model))],
    }
