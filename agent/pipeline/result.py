"""What a calibration found: the content of `result.json`, and what its report shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.link.record import Recording
from agent.pipeline.plan import planned_motion_data, search_data
from agent.pipeline.planning import Plan
from agent.recipe import Recipe
from agent.report import RunData
from agent.robot.torque_figures import torque_units, without_nominal

if TYPE_CHECKING:
    from agent.estimation import IdentifiedModel
    from agent.report.page import Section
    from agent.validation import Prediction


def build_result(
    recipe: Recipe,
    plan: Plan,
    recordings: Sequence[Recording],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
    provenance: dict[str, str],
) -> dict[str, Any]:
    """The content of `result.json`.

    `accepted` is the gate's word: every axis that has a nominal torque, moving samples of all motions pooled.
    """
    from agent.validation import summary

    overall = summary(predictions)["overall"]
    moving = pooled_rmse(predictions)
    figures = moving / model.robot.nominal_torque
    gate = recipe.gate.normalised_rmse
    not_judged = without_nominal(model.robot)
    broken = [
        (name, figure)
        for name, figure in zip(model.robot.joint_names, figures, strict=True)
        if name not in not_judged and not figure <= gate
    ]
    return {
        "schema": "calibration/1",
        "robot": recipe.robot.name,
        "accepted": not broken,
        "reason": "; ".join(
            f"{name}: prediction error {100 * figure:.2f} %, the gate is {100 * gate:.2f} %" for name, figure in broken
        ),
        "gate": {"normalised_rmse": gate, "not_judged": list(not_judged)},
        "search": {
            "method": recipe.search.method,
            "seed": recipe.search.seed,
            "fitness": plan.search["fitness"],
            "evaluations": plan.search["evaluated"],
            "motion": planned_motion_data(recipe, plan.excitation).description[0],
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
    further: Sequence[Section],
) -> RunData:
    """What the report shows of a run; `further` sections go between parameters and provenance."""
    typical = typical_motion(predictions)
    every = max(1, len(typical.time) // 1500)
    return RunData(
        result=result,
        motion=planned_motion_data(recipe, plan.excitation),
        search=search_data(plan.search),
        parameter_rows=model.rows(),
        motion_rmse=np.array([p.rmse(moving=True) for p in predictions]),
        nominal=model.robot.nominal_torque,
        prediction=(
            typical.time[::every],
            typical.measured[::every],
            typical.predicted[::every],
            typical.half_width[::every],
        ),
        further=further,
    )


def typical_motion(predictions: Sequence[Prediction]) -> Prediction:
    """The motion in the middle of the field, so that the plot flatters nobody."""
    rmse = np.array([p.rmse(moving=True) for p in predictions])
    nominal = predictions[0].model.robot.nominal_torque
    usual = np.maximum(np.nanmedian(rmse, axis=0), 1e-300)
    worst = np.nanmax(rmse / np.where(np.isfinite(nominal), nominal, usual), axis=1)
    return predictions[int(np.argsort(worst)[len(worst) // 2])]


def provenance(run_path: Path, state: dict[str, Any], logs: Sequence[Path]) -> dict[str, str]:
    """Versions and SHA-256 of everything that went into a run, as names and text."""
    from agent.runs.folder import sha256_file

    entries = {f"version of {name}": version for name, version in state["versions"].items()}
    entries |= {f"SHA-256 of {name}": value for name, value in state["inputs_sha256"].items()}
    entries |= {f"SHA-256 of {path.name}": sha256_file(path) for path in logs}
    return {"run": run_path.name, "started": state["started"], **entries}
