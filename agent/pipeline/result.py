"""What a calibration found: the content of `result.json`, and what its report shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.link import Recording
from agent.pipeline.first_screen import about_run
from agent.pipeline.plan import planned_motion_data, search_data, with_residual
from agent.pipeline.planning import Plan
from agent.recipe import Recipe
from agent.report import RunData, torque_plot
from agent.robot import torque_units, without_nominal

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.report import Section
    from agent.validation import Prediction


@dataclass(frozen=True)
class GateFigures:
    """The gate, and the joints that have no nominal torque and are not judged by it."""

    normalised_rmse: float
    not_judged: list[str]


@dataclass(frozen=True)
class SearchFigures:
    """How the loop was found; `fitness` is log10 det(HᵀH/M), `motion` a line about the loop."""

    method: str
    seed: int
    fitness: float
    evaluations: int
    motion: str


@dataclass(frozen=True)
class EstimationFigures:
    """How the model was fitted."""

    method: str
    cutoff_hz: float
    parameters: int
    base_parameters: int
    condition_number: float
    notes: list[str]


@dataclass(frozen=True, eq=False)
class ValidationFigures:
    """Prediction of unseen motions at `speed` [m/s]; (n,) `rmse` in `units`, of samples where the arm moves.

    `normalised_rmse` (n,) is not a number where a joint has no nominal torque. The last two count standstill too.
    """

    motions: int
    speed: float
    joints: list[str]
    units: list[str]
    rmse: np.ndarray
    normalised_rmse: np.ndarray
    normalised_rmse_all_samples: list[float | None]
    relative_error_all_joints: float | None


@dataclass(frozen=True)
class RecordingFigures:
    """One log of the run: samples, those that never came, and its length [s]."""

    log: str
    samples: int
    lost: int
    duration: float

    @classmethod
    def of(cls, recording: Recording) -> RecordingFigures:
        """What a result says of it."""
        return cls(recording.path.name, recording.samples, recording.lost, recording.duration)


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The content of `result.json`.

    `accepted` is the gate's word, None where it could judge no joint; `reason` why not. `conditions` are those of the
    excitation; `reference` is the last accepted run of the same loop and `diagnosis` why its model predicts worse now,
    if it does; `current_model` the run whose model is the robot's.
    """

    robot: str
    accepted: bool | None
    reason: str
    gate: GateFigures
    search: SearchFigures
    estimation: EstimationFigures
    validation: ValidationFigures
    recordings: list[RecordingFigures]
    provenance: dict[str, str]
    serial: str
    conditions: dict[str, Any]
    reference: str
    diagnosis: dict[str, Any] | None
    current_model: str | None = None

    @property
    def rejected(self) -> bool:
        """Whether the gate said no."""
        return self.accepted is False

    def to_dict(self) -> dict[str, Any]:
        """The document `calibration/1`."""
        return {"schema": "calibration/1", **asdict(self)}


def build_result(
    recipe: Recipe,
    plan: Plan,
    recordings: Sequence[Recording],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
    *,
    provenance: dict[str, str],
    serial: str,
    conditions: dict[str, Any],
    reference: str,
    diagnosis: dict[str, Any] | None,
) -> CalibrationResult:
    """What was found, and the gate's word on it: every axis that has a nominal torque, moving samples of all motions
    pooled."""
    from agent.validation import pooled_rmse, summary

    overall = summary(predictions).overall
    moving = pooled_rmse(predictions)
    figures = moving / model.robot.nominal_torque
    gate = recipe.gate.normalised_rmse
    not_judged = without_nominal(model.robot)
    accepted, reason = judge(gate, model.robot.joint_names, figures, not_judged)
    return CalibrationResult(
        robot=recipe.robot.name,
        accepted=accepted,
        reason=reason,
        gate=GateFigures(gate, list(not_judged)),
        search=SearchFigures(
            method=recipe.search.method,
            seed=recipe.search.seed,
            fitness=plan.search["fitness"],
            evaluations=plan.search["evaluated"],
            motion=planned_motion_data(recipe, plan.excitation).description[0],
        ),
        estimation=EstimationFigures(
            method=model.method,
            cutoff_hz=model.cutoff,
            parameters=len(model.values),
            base_parameters=len(model.base_values),
            condition_number=model.condition_number,
            notes=list(model.notes),
        ),
        validation=ValidationFigures(
            motions=len(predictions),
            speed=recipe.validate.speed,
            joints=list(recipe.robot.joint_names),
            units=list(torque_units(recipe.robot)),
            rmse=moving,
            normalised_rmse=figures,
            normalised_rmse_all_samples=list(overall.normalised_rmse),
            relative_error_all_joints=overall.relative_error_all_joints,
        ),
        recordings=[RecordingFigures.of(recording) for recording in recordings],
        provenance=provenance,
        serial=serial,
        conditions=conditions,
        reference=reference,
        diagnosis=diagnosis,
    )


def judge(
    gate: float, joints: Sequence[str], figures: Sequence[float] | np.ndarray, not_judged: Sequence[str]
) -> tuple[bool | None, str]:
    """The gate's word on the shares of nominal torque of the joints, and why not; None where it can judge no joint."""
    broken = [
        f"{name}: prediction error {100 * figure:.2f} %, the gate is {100 * gate:.2f} %"
        for name, figure in zip(joints, figures, strict=True)
        if name not in not_judged and not figure <= gate
    ]
    return (None if len(not_judged) == len(joints) else not broken), "; ".join(broken)


def run_data(
    recipe: Recipe,
    plan: Plan,
    result: dict[str, Any],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
    further: Sequence[Section],
    run: Path,
) -> RunData:
    """What the report shows of a run in its folder; `further` sections go between parameters and provenance."""
    from agent.validation import pooled_rmse

    return RunData(
        result=result,
        about=about_run("calibrate", recipe, result, run),
        motion=with_residual(planned_motion_data(recipe, plan.excitation), model, run / "excitation.mcap"),
        search=search_data(plan.search),
        parameter_rows=model.rows(),
        rmse=np.array([p.rmse(moving=True) for p in predictions]),
        nominal=model.robot.nominal_torque,
        prediction=torque_plot(typical_motion(predictions), pooled_rmse(predictions)),
        further=further,
        validation_paths=np.array([_path(motion.loop.trajectory.tcp) for motion in plan.validation]),
    )


def _path(poses: np.ndarray, points: int = 120) -> np.ndarray:
    """(points, 3) positions of poses (S, 4, 4), evenly chosen."""
    return poses[np.linspace(0, len(poses) - 1, points).round().astype(int), :3, 3]


def typical_motion(predictions: Sequence[Prediction]) -> Prediction:
    """The motion in the middle of the field, so that the plot flatters nobody."""
    rmse = np.array([p.rmse(moving=True) for p in predictions])
    nominal = predictions[0].model.robot.nominal_torque
    usual = np.maximum(np.nanmedian(rmse, axis=0), 1e-300)
    worst = np.nanmax(rmse / np.where(np.isfinite(nominal), nominal, usual), axis=1)
    return predictions[int(np.argsort(worst)[len(worst) // 2])]


def provenance(run_path: Path, state: dict[str, Any], logs: Sequence[Path]) -> dict[str, str]:
    """Versions and SHA-256 of everything that went into a run, as names and text."""
    from agent.core import sha256_file

    entries = {f"version of {name}": version for name, version in state["versions"].items()}
    entries |= {f"SHA-256 of {name}": value for name, value in state["inputs_sha256"].items()}
    entries |= {f"SHA-256 of {path.name}": sha256_file(path) for path in logs}
    return {"run": run_path.name, "started": state["started"], **entries}
