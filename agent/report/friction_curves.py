"""Friction of every axle over its speed: the identified curve with its band, and what the data say there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.model import steady_columns
from agent.report.page import Section
from agent.report.plots import SERIES, UNLINKED, Panel, Plot, Series
from agent.report.torque_section import worst_first
from agent.robot import axle_motion, torque_units

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.robot import RobotDescription
    from agent.validation import Prediction

_GRID = 120
_BINS = 60
_FEWEST = 10  # samples of a bin


def friction_section(predictions: Sequence[Prediction]) -> Section:
    """Curves of all axles, the joint with the largest error first, over measured torque less that of the bodies."""
    text = (
        "Line: friction of the model, with the 95 % band of its parameters, without load-dependent terms. Dots: "
        "measured torque minus the torque of the links, averaged over narrow ranges of speed.",
    )
    return Section("Friction", text, (friction_plot(predictions),))


def friction_plot(predictions: Sequence[Prediction]) -> Plot:
    """A panel an axle: curve and band over its speed, and the means of the data."""
    from agent.validation import pooled_rmse

    model = predictions[0].model
    robot = model.robot
    speed = np.concatenate([axle_motion(robot, prediction.velocity) for prediction in predictions])
    rest = np.concatenate([p.measured - p.predicted + p.friction for p in predictions]) @ np.linalg.inv(robot.coupling)
    panels = []
    for axle in worst_first(robot, pooled_rmse(predictions)):
        top = float(np.abs(speed[:, axle]).max())
        if top <= 0:
            continue
        middle, mean = _means(speed[:, axle], rest[:, axle], top)
        x = np.unique(np.concatenate([top * np.linspace(-1, 1, _GRID), [0.0], middle]))
        curve, half = friction_curve(model, axle, x)
        dots = np.full(len(x), np.nan)
        dots[np.searchsorted(x, middle)] = mean
        series = (
            Series("95 % band", curve + half, colour=SERIES[0], low=curve - half),
            Series("model", curve, colour=SERIES[0]),
            Series("data", dots, "points", SERIES[1]),
        )
        name = robot.joint_names[axle]
        panels.append(Panel(name, torque_units(robot)[axle], series, x, joint=name))
    caption = "Friction over the speed of the axle: model and data."
    return Plot("friction", caption, "speed", tuple(panels), x_unit=speed_unit(robot), link=UNLINKED, columns=2)


def speed_unit(robot: RobotDescription) -> str:
    """Of the speeds of all joints on one axis."""
    return "m/s" if all(joint.prismatic for joint in robot.joints) else "rad/s"


def friction_curve(model: IdentifiedModel, axle: int, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S,) torque of an axle's friction at speeds (S,) held, and (S,) half of its 95 % band [N·m].

    Each point is that of long sliding one way: what a reversal does along a path has no place over speed.
    """
    own = [k for k, term in enumerate(model.terms) if term.axle == axle and term.form != "load"]
    columns = steady_columns([model.terms[k] for k in own], speed)
    places = len(model.independent) + np.array(own, dtype=int)
    covariance = model.covariance[np.ix_(places, places)]
    variance = np.einsum("sk,kl,sl->s", columns, covariance, columns)
    return columns @ model.values[places], 1.96 * np.sqrt(np.maximum(variance, 0))


def _means(speed: np.ndarray, torque: np.ndarray, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean speed and torque of narrow ranges of speed that hold enough samples, standstill left out."""
    edges = top * np.linspace(-1, 1, _BINS + 1)
    moving = np.abs(speed) > 0.01 * top
    place = np.clip(np.digitize(speed[moving], edges) - 1, 0, _BINS - 1)
    count = np.bincount(place, minlength=_BINS)
    enough = count >= _FEWEST
    with np.errstate(invalid="ignore", divide="ignore"):
        means = [np.bincount(place, weights=values[moving], minlength=_BINS) / count for values in (speed, torque)]
    return means[0][enough], means[1][enough]
