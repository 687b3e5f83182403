"""Friction of every axle over its speed: the identified curve with its band, and what the data say there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from agent.core import NORMAL_95
from agent.model import IdentifiedModel, steady_columns
from agent.pages.elements import Section
from agent.pages.plots import SERIES, UNLINKED, Panel, Plot, Series, worst_first
from agent.robot import RobotDescription, axle_motion, torque_units
from agent.validation import Prediction, pooled_rmse

_GRID = 121
#: Ranges of speed, and the fewest samples of one that is shown.
_BINS, _FEWEST = 60, 10


def friction_section(predictions: Sequence[Prediction]) -> Section:
    """Curves of all axles, the joint with the largest error first, over measured torque minus that of the links."""
    text = (
        "Line: friction of the model, with the 95 % band of its parameters, without load-dependent terms. Dots: "
        "measured torque minus the torque of the links, averaged over narrow ranges of speed.",
    )
    model = predictions[0].model
    robot = model.robot
    speed = np.concatenate([axle_motion(robot, prediction.velocity) for prediction in predictions])
    axle_torque = np.concatenate([p.measured - p.predicted + p.friction for p in predictions]) @ np.linalg.inv(
        robot.coupling
    )
    panels = []
    for axle in worst_first(robot, pooled_rmse(predictions)):
        top = float(np.abs(speed[:, axle]).max())
        if top <= 0:
            continue
        middle, mean = _means(speed[:, axle], axle_torque[:, axle], top)
        x = np.unique(np.concatenate([top * np.linspace(-1, 1, _GRID), middle]))
        dots = np.full(len(x), np.nan)
        dots[np.searchsorted(x, middle)] = mean
        series = [*_curve("model", model, axle, x, SERIES[0]), Series("data", dots, "points", SERIES[1])]
        panels.append(
            Panel(robot.joint_names[axle], torque_units(robot)[axle], series, x, joint=robot.joint_names[axle])
        )
    caption = "Friction over the speed of the axle: model and data."
    return Section("Friction", text, (_plot("friction", caption, panels, robot),))


def compared_friction(models: Mapping[str, IdentifiedModel]) -> Plot:
    """The curves of several models of one robot, by name."""
    robot = next(iter(models.values())).robot
    panels = []
    for axle, joint in enumerate(robot.joint_names):
        x = robot.max_velocity[axle] * np.linspace(-1, 1, _GRID)
        series = [
            curve
            for k, (name, model) in enumerate(models.items())
            for curve in _curve(name, model, axle, x, SERIES[k % len(SERIES)], f"{name}, ")
        ]
        panels.append(Panel(joint, torque_units(robot)[axle], series, x, joint=joint))
    return _plot("friction-curves", "Friction of each axle over its speed, as each run has it.", panels, robot)


def friction_curve(model: IdentifiedModel, axle: int, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S,) torque of an axle's friction at constant speeds (S,), and (S,) half of its 95 % band [N·m].

    Each point is that of long sliding in one direction: the path after a reversal cannot be shown over speed.
    """
    own = [k for k, term in enumerate(model.terms) if term.axle == axle and term.form != "load"]
    columns = steady_columns([model.terms[k] for k in own], speed)
    places = len(model.independent) + np.array(own, dtype=int)
    covariance = model.covariance[np.ix_(places, places)]
    variance = np.einsum("sk,kl,sl->s", columns, covariance, columns)
    return columns @ model.values[places], NORMAL_95 * np.sqrt(np.maximum(variance, 0))


def _curve(
    name: str, model: IdentifiedModel, axle: int, x: np.ndarray, colour: str, before: str = ""
) -> tuple[Series, Series]:
    curve, half = friction_curve(model, axle, x)
    band = Series(f"{before}95 % band", curve + half, colour=colour, low=curve - half)
    return band, Series(name, curve, colour=colour)


def _plot(name: str, caption: str, panels: Sequence[Panel], robot: RobotDescription) -> Plot:
    unit = "m/s" if all(joint.prismatic for joint in robot.joints) else "rad/s"
    return Plot(name, caption, "speed", panels, x_unit=unit, link=UNLINKED, columns=2)


def _means(speed: np.ndarray, torque: np.ndarray, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean speed and torque of narrow ranges of speed that hold enough samples, standstill left out."""
    moving = np.abs(speed) > 0.01 * top
    weights = (None, speed[moving], torque[moving])
    count, *sums = (np.histogram(speed[moving], _BINS, (-top, top), weights=values)[0] for values in weights)
    middle, mean = (values[count >= _FEWEST] / count[count >= _FEWEST] for values in sums)
    return middle, mean
