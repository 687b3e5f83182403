"""What a model is worth on motions it has not seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.recipe import Recipe
from agent.recording import Log
from agent.validation import predict_log
from agent.validation.torque import filtered_columns

_EVERY = 10  # samples between those that intervals are worked out at


def fitted(recipe: Recipe, log: Log, seconds: float) -> IdentifiedModel:
    """The model of the first seconds of a log."""
    return estimate(recipe.robot, [log.between(0.0, seconds)], EstimationSettings.create(method="weighted"))


def error(model: IdentifiedModel, logs: Sequence[Log]) -> list[float]:
    """(n,) RMSE over nominal torque [%], standstill included, to five digits."""
    left = np.concatenate([predict_log(model, log).error for log in logs])
    values = 100 * np.sqrt(np.mean(left**2, axis=0)) / model.robot.nominal_torque
    return [float(f"{value:.5g}") for value in values]


def covered(model: IdentifiedModel, log: Log) -> float:
    """Share [%] of samples in motion that lie within the 95 % intervals, mean over joints."""
    prediction = predict_log(model, log)
    rows = np.concatenate([filtered_columns(model, motion) for motion in prediction._motions])[::_EVERY]
    speed = np.concatenate([motion.low_pass(motion.qd) for motion in prediction._motions])[::_EVERY]
    inside = np.abs(prediction.error[::_EVERY]) <= model.prediction_interval(rows, speed)
    return float(f"{100 * np.mean(inside[prediction.moving[::_EVERY]]):.5g}")
