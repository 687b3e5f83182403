"""Where the model is off: residuals over joint and regime of motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.model import REGIMES, regime_masks, standstill_speed
from agent.report.figures import Figure, cell_map
from agent.report.page import Section
from agent.report.residual_plots import residual_plots
from agent.robot import torque_units

if TYPE_CHECKING:
    from agent.validation import Prediction


def residual_section(predictions: Sequence[Prediction]) -> Section:
    """RMSE by joint and regime, over nominal torque or in N·m, then over time, angle, speed and frequency."""
    figures = residual_map(predictions)
    text = (
        "RMS error of the model by regime of the joint. A larger value points to an effect that the model lacks.",
        "At standstill, friction can have any value within stiction: that column is the largest on a healthy arm too.",
    )
    return Section("Residuals", text, (heat_map(figures, predictions[0]), *residual_plots(predictions)))


def residual_map(predictions: Sequence[Prediction]) -> np.ndarray:
    """(n, regimes) RMSE over nominal torque, or [N·m] where a joint has none; NaN where a joint is never in one."""
    robot = predictions[0].model.robot
    slowest = standstill_speed([prediction.velocity for prediction in predictions], robot.max_velocity)
    total, count = np.zeros((2, robot.dof, len(REGIMES)))
    for prediction in predictions:
        rate = 1 / float(np.median(np.diff(prediction.time)))
        for joint, square in enumerate(prediction.error.T**2):
            found = regime_masks(
                prediction.position[:, joint],
                prediction.velocity[:, joint],
                prediction.acceleration[:, joint],
                prediction.predicted[:, joint],
                float(slowest[joint]),
                rate,
            )
            total[joint] += [square[inside].sum() for inside in found.values()]
            count[joint] += [inside.sum() for inside in found.values()]
    with np.errstate(divide="ignore", invalid="ignore"):
        rmse = np.sqrt(total / count)
    nominal = robot.nominal_torque
    return rmse / np.where(np.isfinite(nominal), nominal, 1.0)[:, None]


def heat_map(
    values: np.ndarray,
    prediction: Prediction,
    name: str = "residuals",
    caption: str = "RMSE by joint (rows) and regime (columns), in % of nominal joint torque if known.",
) -> Figure:
    """Cells (n, regimes) of `residual_map`, shaded by their values."""
    names = prediction.model.robot.joint_names
    known = np.isfinite(prediction.model.robot.nominal_torque)
    shown = np.where(known[:, None], 100 * values, values)
    units = ["%" if has else unit for has, unit in zip(known, torque_units(prediction.model.robot), strict=True)]
    return cell_map(name, caption, shown, [regime.replace("_", "\n") for regime in REGIMES], names, units)
