"""What a calibration found: the content of `result.json`, and what its report shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.planning import Plan
from agent.recipe import Recipe
from agent.record import Recording
from agent.report import RunData

if TYPE_CHECKING:
    from agent.estimation import IdentifiedModel
    from agent.validation import Prediction


def build_result(
    recipe: Recipe,
    plan: Plan,
    recordings: Sequence[Recording],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
    provenance: dict[str, str],
) -> dict[str, Any]:
    """The content of `result.json`. `accepted` is the gate's word: every axis, moving samples of all motions pooled."""
    from agent.validation import summary

    overall = summary(predictions)["overall"]
    moving = pooled_rmse(predictions)
    figures = moving / model.robot.nominal_torque
    gate = recipe.gate.normalised_rmse
    return {
        "schema": "calibration/1",
        "robot": recipe.robot.name,
        "accepted": bool(np.all(figures <= gate)),
        "gate": {"normalised_rmse": gate},
        "search": {
            "method": recipe.search.method,
            "seed": recipe.search.seed,
            "fitness": plan.search["fitness"],
            "evaluations": plan.search["evaluated"],
            "motion": _describe(recipe, plan),
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
            "rmse": moving,
            "normalised_rmse": figures,
            "normalised_rmse_all_samples": overall["normalised_rmse"],
            "relative_error_all_joints": overall["relative_error_all_joints"],
        },
        "recordings": [
            {"log": r.path.name, "samples": r.samples, "lost": r.lost, "duration": r.duration} for r in recordings
        ],
        "provenance": provenance,
    }


def pooled_rmse(predictions: Sequence[Prediction]) -> np.ndarray:
    """(n,) RMSE [N·m] over the moving samples of all motions."""
    error = np.concatenate([p.error[p.moving] for p in predictions])
    return np.sqrt(np.mean(error**2, axis=0))


def run_data(
    recipe: Recipe,
    plan: Plan,
    result: dict[str, Any],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
) -> RunData:
    """What the report shows of a run."""
    loop = plan.excitation.loop
    trajectory = loop.trajectory
    typical = predictions[_typical(predictions)]
    every = max(1, len(typical.time) // 1500)
    history = plan.search["history"]
    boxes = {box.name: (np.array(box.minimum), np.array(box.maximum)) for box in recipe.cell.keep_out}
    return RunData(
        result=result,
        path=trajectory.tcp[:, :3, 3],
        via_points=loop.poses[:, :3, 3],
        keep_out=boxes,
        t=trajectory.t[::5],
        speed=trajectory.path_speed[::5],
        programmed_speed=recipe.motion.speed,
        limit_use={name: values[::5] for name, values in limit_use(recipe, trajectory).items()},
        best=np.array(history["best"], dtype=float),
        mean=np.array(history["mean"], dtype=float),
        parameter_rows=model.rows(),
        normalised_rmse=np.array([p.normalised_rmse(moving=True) for p in predictions]),
        prediction=(
            typical.time[::every],
            typical.measured[::every],
            typical.predicted[::every],
            typical.half_width[::every],
        ),
    )


def limit_use(recipe: Recipe, trajectory: Any) -> dict[str, np.ndarray]:
    """{kind: (S, n)} how much of each joint limit a trajectory uses; 1 is all of it."""
    robot = recipe.robot
    lower, upper = robot.position_limits
    bounded = np.isfinite(lower) & np.isfinite(upper)
    centre, half = np.where(bounded, (lower + upper) / 2, 0.0), np.where(bounded, (upper - lower) / 2, np.inf)
    return {
        "position": np.abs(trajectory.q - centre) / half,
        "speed": np.abs(trajectory.qd) / robot.max_velocity,
        "acceleration": np.abs(trajectory.qdd) / robot.max_acceleration,
    }


def _typical(predictions: Sequence[Prediction]) -> int:
    """The motion in the middle of the field, so that the plot flatters nobody."""
    worst = [float(np.nanmax(p.normalised_rmse(moving=True))) for p in predictions]
    return int(np.argsort(worst)[len(worst) // 2])


def _describe(recipe: Recipe, plan: Plan) -> str:
    loop, settings = plan.excitation.loop, recipe.motion.settings
    binding = sorted({limit.limit for limit in loop.trajectory.binding})
    slowed = f"; slowed down by {', '.join(binding)}" if binding else ""
    return (
        f"{len(loop.poses)} via-points, {loop.trajectory.duration:.1f} s a cycle, {plan.excitation.cycles} cycles at "
        f"{plan.excitation.speed:g} m/s, {settings.fly_type.value} within {1000 * settings.fly_distance:g} mm{slowed}."
    )


def provenance(run_path: Path, state: dict[str, Any], logs: Sequence[Path]) -> dict[str, str]:
    """Versions and SHA-256 of everything that went into a run, as names and text."""
    from agent.run import sha256_file

    entries = {f"version of {name}": version for name, version in state["versions"].items()}
    entries |= {f"SHA-256 of {name}": value for name, value in state["inputs_sha256"].items()}
    entries |= {f"SHA-256 of {path.name}": sha256_file(path) for path in logs}
    return {"run": run_path.name, "started": state["started"], **entries}
