"""How well a model predicts torque: measured and predicted torque over time, and errors of several motions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.pages.elements import Bar, Bars, Table
from agent.pages.plots import SERIES, Panel, Plot, Series, thinned, worst_first
from agent.robot import torque_units
from agent.validation import Prediction

_PARTS = {"gravity": 0, "inertia": 2, "Coriolis": 3, "friction": 4, "effects": 5}  # their colours
_INK = "#808890"


def torque_plot(prediction: Prediction, error: np.ndarray, start: float = -np.inf, stop: float = np.inf) -> Plot:
    """Predicted torque in parts and measured torque from `start` to `stop` [s], and the residual with its bounds.

    The joint with the largest `error` (n,) [N·m] over nominal torque comes first.

    Args:
        prediction: torque in parts, and measured.
        error: (n,) held out [N·m].
        start: first time that is shown [s].
        stop: last one [s].
    """
    inside = np.flatnonzero((prediction.time >= start) & (prediction.time <= stop))
    chosen = inside[thinned(np.hstack([prediction.error[inside], prediction.measured[inside]]))]
    robot = prediction.model.robot
    measured, predicted, half = (
        values[chosen] for values in (prediction.measured, prediction.predicted, prediction.half_width)
    )
    panels = []
    for k in worst_first(robot, error):
        joint, unit = robot.joint_names[k], torque_units(robot)[k]
        parts = [
            Series(name, values[chosen, k], "part", SERIES[_PARTS[name]])
            for name, values in prediction.parts.items()
            if np.abs(values[chosen, k]).max() > 1e-3 * np.abs(predicted[:, k]).max()
        ]
        torque = (*parts, Series("measured", measured[:, k], colour=_INK))
        torque += (Series("predicted", predicted[:, k], "dashed", SERIES[1]),)
        residual = (
            Series("95 % bounds", half[:, k], colour=SERIES[2], low=-half[:, k]),
            Series("left over", measured[:, k] - predicted[:, k], colour=SERIES[1]),
        )
        panels.append(Panel(joint, unit, torque, joint=joint))
        panels.append(Panel(f"{joint}, measured less predicted", unit, residual, joint=joint))
    return Plot("prediction", "", "time", tuple(panels), prediction.time[chosen], "s", columns=2)


def error_table(rmse: np.ndarray, nominal: np.ndarray, names: Sequence[str], gate: float, caption: str) -> Table:
    """RMSE (motions, n) of several motions per axis, over the nominal torque (n,) where there is one, as box plots.

    A box is the middle half, its line the median; whiskers reach the errors no farther off than 1.5 boxes.
    """
    known = np.isfinite(nominal)
    rows: list[list[str | Bars]] = []
    for name, has, column in zip(
        names, known, np.where(known, 100 * rmse / np.where(known, nominal, 1), rmse).T, strict=True
    ):
        quantiles = np.quantile(column, (0.0, 0.25, 0.5, 0.75, 1.0)).tolist()
        _, low, half, high, most = quantiles
        usual = column[(column >= low - 1.5 * (high - low)) & (column <= high + 1.5 * (high - low))]
        far = np.setdiff1d(column, usual).tolist()
        unit = "%" if has else "N·m"
        bars = [
            Bar(usual.min(initial=low), usual.max(initial=high), _INK, 0.45, 0.1),
            Bar(low, high, SERIES[0]),
            *(Bar(place, place + 0.01 * most, SERIES[3], 0.35, 0.3) for place in far),
        ]
        marks = [(half, "currentColor"), *([(100 * gate, SERIES[3])] if has else [])]
        rows.append([name, *(f"{value:.3g}" for value in quantiles), unit, Bars(bars, marks, unit)])
    header = ("axis", "least", "lower quartile", "median", "upper quartile", "most", "unit", "middle half, line: gate")
    return Table("validation-box", header, rows, caption=caption)
