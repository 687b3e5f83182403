"""What a run found: the content of `result.json`, and the conditions of the run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from agent.core import sha256_file
from agent.estimation import conditional_covariance
from agent.link import Recording
from agent.model import ODD, IdentifiedModel, steady_columns
from agent.pipeline.planning.plan import Plan
from agent.pipeline.planning.plan_files import shown_loop
from agent.recipe import Recipe
from agent.recording import Log
from agent.robot import axle_motion, torque_units, without_nominal
from agent.runs import RunFolder
from agent.validation import Prediction, pooled_rmse, predict_log, summary

#: Friction is compared at these shares of the highest speed of the axle in the loop.
SHARES = (0.15, 0.6)
_FEWEST_CYCLES = 3


def calibration_result(
    recipe: Recipe,
    run: RunFolder,
    plan: Plan,
    recordings: Sequence[Recording],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
    met: dict[str, Any],
) -> dict[str, Any]:
    """The document `calibration/1`, with the gate's decision on moving samples of all motions.

    `met` are the conditions of the excitation. To come: the comparison with earlier runs, and the current model.
    """
    overall = summary(predictions).overall
    rmse = pooled_rmse(predictions)
    shares = rmse / model.robot.nominal_torque
    accepted, reason = gate_decision(
        recipe.gate.normalised_rmse, model.robot.joint_names, shares, without_nominal(model.robot)
    )
    return {
        "schema": "calibration/1",
        "robot": recipe.robot.name,
        "accepted": accepted,
        "reason": reason,
        "gate": gate_figures(recipe),
        "search": {
            "method": recipe.search.method,
            "seed": recipe.search.seed,
            "fitness": plan.search["fitness"],
            "evaluations": plan.search["evaluated"],
            "motion": shown_loop(recipe, plan.excitation).description,
        },
        "estimation": {
            "method": model.method,
            "cutoff_hz": model.cutoff,
            "parameters": len(model.values),
            "base_parameters": len(model.base_values),
            "condition_number": model.condition_number,
            "notes": list(model.notes),
        },
        "validation": {
            "motions": len(predictions),
            "speed": recipe.validate.speed,
            "joints": list(recipe.robot.joint_names),
            "units": list(torque_units(recipe.robot)),
            "rmse": rmse,
            "normalised_rmse": shares,
            "normalised_rmse_all_samples": list(overall.normalised_rmse),
            "relative_error_all_joints": overall.relative_error_all_joints,
        },
        **provenance_of(run, recordings),
        "serial": run.state["serial"],
        "conditions": met,
    }


def gate_figures(recipe: Recipe) -> dict[str, Any]:
    """The gate, and the joints that have no nominal torque and are not judged by it."""
    return {"normalised_rmse": recipe.gate.normalised_rmse, "not_judged": list(without_nominal(recipe.robot))}


def provenance_of(run: RunFolder, recordings: Sequence[Recording]) -> dict[str, Any]:
    """`recordings`, one per log with its length [s], and `provenance`: versions and SHA-256 of all that went in."""
    state = run.state
    sources = {f"version of {name}": version for name, version in state["versions"].items()}
    sources |= {f"SHA-256 of {name}": value for name, value in state["inputs_sha256"].items()}
    sources |= {f"SHA-256 of {recording.path.name}": sha256_file(recording.path) for recording in recordings}
    return {
        "recordings": [
            {
                "log": recording.path.name,
                "samples": recording.samples,
                "lost": recording.lost,
                "duration": recording.duration,
            }
            for recording in recordings
        ],
        "provenance": {"run": run.path.name, "started": state["started"], **sources},
    }


def gate_decision(
    gate: float, joints: Sequence[str], figures: Sequence[float] | np.ndarray, not_judged: Sequence[str]
) -> tuple[bool | None, str]:
    """The gate's decision on the errors over nominal torque, and why not; None where it can judge no joint."""
    broken = [
        f"{name}: prediction error {100 * figure:.2f} %, the gate is {100 * gate:.2f} %"
        for name, figure in zip(joints, figures, strict=True)
        if name not in not_judged and not figure <= gate
    ]
    return (None if len(not_judged) == len(joints) else not broken), "; ".join(broken)


def conditions(log: Log, model: IdentifiedModel, prediction: Prediction | None = None) -> dict[str, Any]:
    """`conditions` of `result.json`, of the excitation `log`: its cycles, its length [s], and friction.

    `friction` has one entry per axle and speed, as `_levels` says. `warm_up` has, by axle, the relative change of
    friction per second of motion and its deviation; without a `prediction` of the log, one is made where it is needed.

    Args:
        log: of the excitation.
        model: identified from it.
        prediction: of the log; None: made where it is needed.
    """
    n, cycles = model.robot.dof, len(log.cycle_starts)
    rate = deviation = np.full(n, np.nan)
    if cycles >= _FEWEST_CYCLES:
        rate, deviation = _warm_up(log, prediction or predict_log(model, log))
    return {
        "cycles": cycles,
        "motion_s": float(log.t[-1] - log.t[0]),
        "warm_up": {"rate_per_s": rate.tolist(), "standard_deviation": deviation.tolist()},
        "nominal_torque": [float(v) if np.isfinite(v) else None for v in model.robot.nominal_torque],
        "friction": list(_levels(log, model)),
    }


def temperatures(recording: Recording) -> dict[str, Any]:
    """Motor temperatures [°C] at both ends of a recording, as one of its conditions; None where none were reported."""
    return {"temperatures_c": dict(zip(("first", "last"), recording.temperatures, strict=False)) or None}


def _levels(log: Log, model: IdentifiedModel) -> Iterator[dict[str, Any]]:
    """Friction torque [N·m] of every axle turning forward at the `SHARES` of its highest `speed` [rad/s] in the log.

    Single friction parameters are correlated; friction at a speed that the axle reached is well determined. With its
    `standard_deviation`, and with that `from_run_to_run`, which leaves out the error of base parameters kept from an
    earlier model, as all such runs share it.
    """
    velocity = np.gradient(log.position, log.t, axis=0) if log.velocity is None else log.velocity
    top_speed = np.quantile(np.abs(axle_motion(model.robot, velocity)), 0.99, axis=0)
    base = len(model.independent)
    between = conditional_covariance(model)
    for axle, joint in enumerate(model.robot.joint_names):
        # an offset and an asymmetry are no friction level; load-dependent friction counts at no load
        own = np.array([term.axle == axle and term.form in ODD for term in model.terms], dtype=bool)
        speeds = np.array(SHARES) * float(top_speed[axle])
        turning = np.maximum(speeds, np.finfo(float).tiny)
        for speed, row in zip(speeds, steady_columns(model.terms, turning, sharp=True) * own, strict=True):
            yield {
                "joint": joint,
                "speed": float(speed),
                "value": float(row @ model.friction_values),
                "standard_deviation": float(np.sqrt(max(row @ model.covariance[base:, base:] @ row, 0.0))),
                "from_run_to_run": float(np.sqrt(max(row @ between @ row, 0.0))),
            }


def _warm_up(log: Log, prediction: Prediction) -> tuple[np.ndarray, np.ndarray]:
    """Rate of change of friction while the arm moved, relative to the model, (n,) [1/s], and its deviation.

    The scale of a cycle is <F, F + e> / <F, F> with the model's friction torque F and the residual e; the rate is the
    slope of a straight line through the cycles, NaN where too few are whole.
    """
    starts = np.asarray(log.cycle_starts, dtype=float)
    length = float(np.median(np.diff(starts)))
    numerator, denominator = np.zeros((2, len(starts), prediction.model.robot.dof))
    for cycle, start in enumerate(starts):
        inside = slice(*np.searchsorted(prediction.time, (start, start + length)))
        force = prediction.friction[inside]
        error = prediction.measured[inside] - prediction.predicted[inside]
        numerator[cycle], denominator[cycle] = np.sum(force * error, axis=0), np.sum(force**2, axis=0)
    whole = np.all(denominator > 0, axis=1)
    if whole.sum() < _FEWEST_CYCLES:
        nothing = np.full(numerator.shape[1], np.nan)
        return nothing, nothing
    scale = numerator[whole] / denominator[whole]
    time = starts[whole] - starts[whole].mean()
    rate = time @ scale / (time @ time)
    residual = scale - scale.mean(axis=0) - np.outer(time, rate)
    return rate, np.sqrt(np.sum(residual**2, axis=0) / max(1, len(time) - 2) / (time @ time))
