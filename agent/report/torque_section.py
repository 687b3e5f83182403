"""Measured against predicted torque: what the model adds up, and what it leaves, joint by joint, the worst first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agent.report.plots import SERIES, Panel, Plot, Series, thinned
from agent.robot import torque_units

if TYPE_CHECKING:
    from agent.robot import RobotDescription
    from agent.validation import Prediction

_PARTS = {"gravity": 0, "inertia": 2, "Coriolis": 3, "friction": 4, "effects": 5}  # their colours
_INK = "#808890"


@dataclass(frozen=True, eq=False)
class TorqueData:
    """A stretch of motion: time (S,) [s]; measured, predicted, half width of the 95 % bounds (S, n) [N·m].

    `parts` (S, n) sum to the prediction; `units` (n,) of the joints, `order` (n,) of them: the worst first.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    order: tuple[int, ...]
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    half_width: np.ndarray
    parts: dict[str, np.ndarray]

    @classmethod
    def of(cls, prediction: Prediction, error: np.ndarray, start: float = -np.inf, stop: float = np.inf) -> TorqueData:
        """What a prediction shows from `start` to `stop` [s], thinned for the screen; joints by their `error` (n,)."""
        inside = np.flatnonzero((prediction.time >= start) & (prediction.time <= stop))
        left = prediction.error[inside]
        chosen = inside[thinned(np.hstack([left, prediction.measured[inside]]))]
        robot = prediction.model.robot
        return cls(
            robot.joint_names,
            tuple(torque_units(robot)),
            tuple(worst_first(robot, error)),
            prediction.time[chosen],
            prediction.measured[chosen],
            prediction.predicted[chosen],
            prediction.half_width[chosen],
            {name: values[chosen] for name, values in prediction.parts.items()},
        )


def worst_first(robot: RobotDescription, error: np.ndarray) -> list[int]:
    """Joints by their error (n,) over nominal torque, the largest first; by the error itself where one has none."""
    nominal = robot.nominal_torque
    size = error / nominal if np.isfinite(nominal).all() else error
    return [int(k) for k in np.argsort(-size, kind="stable")]


def torque_plot(data: TorqueData, caption: str) -> Plot:
    """Plot measured and predicted torque with its parts stacked, next to the residual with its bounds."""
    panels = []
    for k in data.order:
        joint, unit = data.joints[k], data.units[k]
        parts = [
            Series(name, values[:, k], "part", SERIES[_PARTS[name]])
            for name, values in data.parts.items()
            if np.abs(values[:, k]).max() > 1e-3 * np.abs(data.predicted[:, k]).max()
        ]
        torque = (*parts, Series("measured", data.measured[:, k], colour=_INK))
        torque += (Series("predicted", data.predicted[:, k], "dashed", SERIES[1]),)
        left = (
            Series("95 % bounds", data.half_width[:, k], colour=SERIES[2], low=-data.half_width[:, k]),
            Series("left over", data.measured[:, k] - data.predicted[:, k], colour=SERIES[1]),
        )
        panels.append(Panel(joint, unit, torque, joint=joint))
        panels.append(Panel(f"{joint}, measured less predicted", unit, left, joint=joint))
    return Plot("prediction", caption, "time", tuple(panels), data.time, "s", columns=2)
