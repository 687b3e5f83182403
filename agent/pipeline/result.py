"""What a run found: the content of `result.json`, the conditions of the run, and the page of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import sha256_file
from agent.estimation import conditional_covariance
from agent.link import Recording
from agent.model import ODD, IdentifiedModel, steady_columns
from agent.pipeline.plan import Plan, planned_motion_data, search_data, with_residual
from agent.pipeline.reports import about_run
from agent.recipe import Recipe
from agent.recording import Log
from agent.report import LogHealth, RunContent, RunData, further_sections, run_report, torque_plot
from agent.robot import axle_motion, torque_units, without_nominal
from agent.validation import Prediction, pooled_rmse, summary

#: Friction is compared at these shares of the highest speed of the axle in the loop.
SHARES = (0.15, 0.6)
_FEWEST_CYCLES = 3


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

    Attributes
    ----------
    accepted, reason : the gate's decision (None: it could judge no joint), and why not.
    conditions : those of the excitation.
    reference : the last accepted run of the same loop.
    diagnosis : why its model predicts worse now, if it does.
    current_model : the run whose model is the robot's current one.
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
        """Whether the gate rejected the model."""
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
    **further: Any,
) -> CalibrationResult:
    """The result with the gate's decision on moving samples of all motions; `further` fields are known elsewhere."""
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
        **further,
    )


def judge(
    gate: float, joints: Sequence[str], figures: Sequence[float] | np.ndarray, not_judged: Sequence[str]
) -> tuple[bool | None, str]:
    """The gate's decision on the errors over nominal torque, and why not; None where it can judge no joint."""
    broken = [
        f"{name}: prediction error {100 * figure:.2f} %, the gate is {100 * gate:.2f} %"
        for name, figure in zip(joints, figures, strict=True)
        if name not in not_judged and not figure <= gate
    ]
    return (None if len(not_judged) == len(joints) else not broken), "; ".join(broken)


def calibration_page(
    recipe: Recipe,
    plan: Plan,
    result: dict[str, Any],
    model: IdentifiedModel,
    predictions: Sequence[Prediction],
    health: Sequence[LogHealth],
    run: Path,
) -> str:
    """HTML of the report of a calibration in its folder; `health` is that of the validation logs."""
    paths = [motion.loop.trajectory.tcp for motion in plan.validation]
    return run_report(
        RunData(
            result=result,
            about=about_run("calibrate", recipe, result, run),
            motion=with_residual(planned_motion_data(recipe, plan.excitation), model, run / "excitation.mcap"),
            search=search_data(plan.search),
            parameter_rows=model.rows(),
            rmse=np.array([p.rmse(moving=True) for p in predictions]),
            nominal=model.robot.nominal_torque,
            prediction=torque_plot(typical_motion(predictions), pooled_rmse(predictions)),
            further=further_sections(RunContent(run, recipe, model, predictions, health)),
            validation_paths=np.array([_thinned(path) for path in paths]),
        )
    )


def _thinned(poses: np.ndarray, points: int = 120) -> np.ndarray:
    """(points, 3) positions of poses (S, 4, 4), evenly chosen."""
    return poses[np.linspace(0, len(poses) - 1, points).round().astype(int), :3, 3]


def typical_motion(predictions: Sequence[Prediction]) -> Prediction:
    """The motion of median error, for the plot."""
    rmse = np.array([p.rmse(moving=True) for p in predictions])
    nominal = predictions[0].model.robot.nominal_torque
    usual = np.maximum(np.nanmedian(rmse, axis=0), 1e-300)
    worst = np.nanmax(rmse / np.where(np.isfinite(nominal), nominal, usual), axis=1)
    return predictions[int(np.argsort(worst)[len(worst) // 2])]


def provenance(run_path: Path, state: dict[str, Any], logs: Sequence[Path]) -> dict[str, str]:
    """Versions and SHA-256 of everything that went into a run, as names and text."""
    entries = {f"version of {name}": version for name, version in state["versions"].items()}
    entries |= {f"SHA-256 of {name}": value for name, value in state["inputs_sha256"].items()}
    entries |= {f"SHA-256 of {path.name}": sha256_file(path) for path in logs}
    return {"run": run_path.name, "started": state["started"], **entries}


@dataclass(frozen=True)
class Level:
    """Friction torque [N·m] of an axle turning forward at a steady `speed` [rad/s], with its standard deviations.

    `from_run_to_run` leaves out the error of base parameters kept from an earlier model, as all such runs share it.
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

    Single friction parameters are correlated; friction at a speed that the axle reached is well determined.
    """
    base = len(model.independent)
    between = conditional_covariance(model)
    levels = []
    for axle, joint in enumerate(model.robot.joint_names):
        # an offset and an asymmetry are no friction level; load-dependent friction counts at no load
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
    """(n,) speed [rad/s] of each axle in a log: the 99 % quantile."""
    speed = np.gradient(log.position, log.t, axis=0) if log.velocity is None else log.velocity
    return np.quantile(np.abs(axle_motion(model.robot, speed)), 0.99, axis=0)


def warm_up(log: Log, prediction: Prediction) -> WarmUp:
    """Rate of change of friction while the arm moved, relative to the model.

    The scale of a cycle is <F, F + e> / <F, F> with the model's friction torque F and the residual e; the rate is the
    slope of a straight line through the cycles.
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
    """`conditions` of `result.json`: of the excitation `log`, with its prediction and how it was recorded."""
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
