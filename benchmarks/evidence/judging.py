"""What a model is worth on motions it has not seen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from agent.model import IdentifiedModel
from agent.recording import Log
from agent.validation import predict_log
from agent.validation.torque import filtered_columns

Z = 1.959964  # of 95 %
_EVERY = 10  # samples between those that intervals and parts of the error are worked out at


def error(model: IdentifiedModel, logs: Sequence[Log]) -> list[float]:
    """(n,) RMSE over nominal torque [%], standstill included."""
    left = np.concatenate([predict_log(model, log).error for log in logs])
    return rounded(100 * np.sqrt(np.mean(left**2, axis=0)) / model.robot.nominal_torque)


def error_figures(model: IdentifiedModel, logs: Sequence[Log], truth: np.ndarray) -> dict[str, list[float]]:
    """Per joint, (n,) each, in percent:

    `error` and `torque`, RMS over nominal torque, all samples; `moving`, `resting`: of samples in which this joint
    moves or does not; `relative`: error over measured torque (AIM 2013, eq. 7); `bodies`: RMS over nominal torque of
    what the bodies' parameters alone get wrong, against the machine's own (11 n,) `truth`.
    """
    predictions = [predict_log(model, log) for log in logs]
    robot = model.robot
    left = np.concatenate([p.error for p in predictions]) / robot.nominal_torque
    measured = np.concatenate([p.measured for p in predictions]) / robot.nominal_torque
    moves = np.abs(np.concatenate([p.velocity for p in predictions])) > 1e-3 * robot.max_velocity
    square = left**2
    with np.errstate(invalid="ignore"):
        found = {
            "error": np.sqrt(square.mean(axis=0)),
            "torque": np.sqrt((measured**2).mean(axis=0)),
            "moving": np.sqrt((square * moves).sum(axis=0) / moves.sum(axis=0)),
            "resting": np.sqrt((square * ~moves).sum(axis=0) / (~moves).sum(axis=0)),
            "relative": np.linalg.norm(left, axis=0) / np.linalg.norm(measured, axis=0),
        }
    motion = [
        np.concatenate([getattr(p, name)[::_EVERY] for p in predictions])
        for name in ("position", "velocity", "acceleration")
    ]
    wrong = model.rigid.torque(*motion, model.base_values) - model.rigid.torque(*motion, model.projection @ truth)
    found["bodies"] = np.sqrt(np.mean((wrong / robot.nominal_torque) ** 2, axis=0))
    return {name: rounded(100 * values) for name, values in found.items()}


def intervals(model: IdentifiedModel, logs: Sequence[Log]) -> dict[str, float]:
    """Means over joints: `width` and `parameters`, RMS half width of 95 % intervals over nominal torque [%], whole
    and what the parameters' uncertainty has in it; `covered`, share of samples in motion that lie within [%]."""
    whole, own, within = [], [], []
    for log in logs:
        prediction = predict_log(model, log)
        columns = [filtered_columns(model, motion) for motion in prediction._motions]
        speed = np.concatenate([motion.low_pass(motion.qd) for motion in prediction._motions])[::_EVERY]
        rows = np.concatenate(columns)[::_EVERY]
        width = model.prediction_interval(rows, speed)
        variance = np.einsum("snp,pq,snq->sn", rows, model.covariance, rows, optimize=True)
        whole.append(width)
        own.append(Z * np.sqrt(np.maximum(variance, 0.0)))
        inside = np.abs(prediction.error[::_EVERY]) <= width
        within.append(inside[prediction.moving[::_EVERY]])
    nominal = model.robot.nominal_torque
    found = {
        "width": np.sqrt(np.mean(np.concatenate(whole) ** 2, axis=0)) / nominal,
        "parameters": np.sqrt(np.mean(np.concatenate(own) ** 2, axis=0)) / nominal,
        "covered": np.mean(np.concatenate(within), axis=0),
    }
    return dict(zip(found, rounded([100 * np.mean(values) for values in found.values()]), strict=True))


def covered_parameters(model: IdentifiedModel, truth: np.ndarray) -> float:
    """Share [%] of the base parameters whose 95 % interval holds the machine's own, from standard (11 n,) `truth`."""
    base = len(model.independent)
    away = np.abs(model.base_values - model.projection @ truth)
    return float(100 * np.mean(away <= Z * model.standard_deviations[:base]))


def rounded(values: Iterable[float]) -> list[float]:
    """Five digits are enough on disk."""
    return [float(f"{value:.5g}") for value in values]
