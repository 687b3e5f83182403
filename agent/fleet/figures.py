"""What a row says of a run: the figures of the single command, out of the same functions and the same numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Console, InputError, finite
from agent.fleet.tasks import RunQuestion

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.recording import Log
    from agent.robot import RobotDescription


class Notes(Console):
    """Keeps warnings and shows nothing."""

    def __init__(self) -> None:
        super().__init__(verbosity=-1)
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        """Kept."""
        self.warnings.append(text)


def estimate(
    question: RunQuestion, robot: str | RobotDescription | None, model: Path | None, logs: list[Path], notes: Notes
) -> tuple[dict[str, Any], bytes]:
    """`agent estimate`: the columns, and the model file but for when it was made."""
    from agent.pipeline import fit_files

    fitted, read = fit_files(
        _needed(robot),
        logs,
        question.cutoff,
        question.method,
        notes,
        question.allow_mixed,
        question.force,
        question.structure,
    )
    content = finite(fitted.to_dict())
    content["provenance"].pop("created", None)  # the same inputs give the same file
    nominal = fitted.robot.nominal_torque
    row = {
        "joints": list(fitted.robot.joint_names),
        "rmse": fitted.held_out_rmse.tolist(),
        "normalised_rmse": finite(fitted.held_out_rmse / nominal),
        "nominal_torque": finite(nominal),
        "method": fitted.method,
        "cutoff_hz": float(fitted.cutoff),
        "condition_number": content["condition_number"],
        "parameters": [
            {key: entry[key] for key in ("name", "unit", "value", "standard_deviation")}
            for entry in (*content["base_parameters"], *content["friction"])
        ],
        **_conditions(fitted, read),
    }
    return row, (json.dumps(content, allow_nan=False) + "\n").encode()


def _conditions(model: IdentifiedModel, logs: list[Log]) -> dict[str, Any]:
    """Friction that was met, and how it changed meanwhile: of the longest log, as a run folder has it."""
    from agent.pipeline import friction_levels, top_speed, warm_up
    from agent.validation import predict_log

    log = max(logs, key=lambda one: len(one.t))
    found = [asdict(level) for level in friction_levels(model, top_speed(log, model))]
    rates: list[dict[str, Any]] = []
    if len(log.cycle_starts) > 2:
        seen = warm_up(log, predict_log(model, log))
        rates = [
            {"rate_per_s": rate, "standard_deviation": deviation}
            for rate, deviation in zip(seen.rate.tolist(), seen.deviation.tolist(), strict=True)
        ]
    return {"friction": found, "warm_up": finite(rates)}


def validate(
    question: RunQuestion, robot: str | RobotDescription | None, model: Path | None, logs: list[Path], notes: Notes
) -> tuple[dict[str, Any], bytes]:
    """`agent validate`: the columns, with the whole result."""
    from agent.pipeline import validate_files

    if model is None:
        raise InputError(f"there is no {question.model or 'model'} in or above this run; name a model with --model")
    result = finite(validate_files(model, logs, question.cutoff, notes, question.allow_mixed).to_dict())
    overall = result["overall"]
    row = {
        "joints": result["joints"],
        "rmse": overall["rmse"],
        "normalised_rmse": overall["normalised_rmse"],
        "relative_error": overall["relative_error"],
        "relative_error_all_joints": overall["relative_error_all_joints"],
        "cutoff_hz": result["cutoff_hz"],
        "result": json.dumps(result, allow_nan=False),
    }
    return row, b""


def diagnose(
    question: RunQuestion, robot: str | RobotDescription | None, model: Path | None, logs: list[Path], notes: Notes
) -> tuple[dict[str, Any], bytes]:
    """`agent diagnose`: the columns, with the whole result."""
    from agent.pipeline import GapQuestion, diagnose_files
    from agent.robot import SHARE

    if question.model and model is None:
        raise InputError(f"there is no {question.model} in or above this run; leave --model out, or name another")
    asked = GapQuestion(
        model,
        cutoff=question.cutoff,
        without=question.without,
        allow_mixed=question.allow_mixed,
        force=question.force,
    )
    result = finite(diagnose_files(robot, logs, asked, notes))
    gap = result["gap"]
    empty = [None] * len(gap["joints"])
    shares = [unit == SHARE for unit in gap["units"]]
    row = {
        "joints": gap["joints"],
        "normalised_rmse": [b if share else None for b, share in zip(gap["before"], shares, strict=True)],
        "gap_before": gap["before"],
        "gap_after": gap["after"],
        "gap_floor": gap["floor"] or empty,
        "gap_units": gap["units"],
        "verdict": result["verdict"],
        "closure": result["closure"],
        "causes": [
            {key: cause[key] for key in ("effect", "joints", "closure", "probability")} for cause in result["causes"]
        ],
        "result": json.dumps(result, allow_nan=False),
    }
    return row, b""


def _needed(robot: str | RobotDescription | None) -> str | RobotDescription:
    if robot is None:
        raise InputError("there is no robot.yaml in or above this run; put one there, or name the robot with --robot")
    return robot


WORK: dict[str, Callable[..., tuple[dict[str, Any], bytes]]] = {
    "estimate": estimate,
    "validate": validate,
    "diagnose": diagnose,
}
