"""Residuals by joint and regime, and over time, angle, speed and frequency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.model import REGIMES, regime_masks, standstill_speed
from agent.pages.elements import Section, Table, shaded_table
from agent.pages.plots import SERIES, UNLINKED, Panel, Plot, Series, joint_series, worst_first
from agent.robot import torque_units
from agent.validation import Prediction

#: Ranges of the abscissa, and the fewest samples of one that is shown.
_BINS, _FEWEST = 60, 10
_SPECTRUM = 300  # points


def residual_section(predictions: Sequence[Prediction]) -> Section:
    """RMSE by joint and regime, over nominal torque or in N·m, then over time, angle, speed and frequency."""
    text = (
        "RMS error of the model by regime of the joint. A larger value points to an effect that the model lacks.",
        "At standstill, friction can have any value within stiction: that column is the largest on a healthy arm too.",
    )
    return Section("Residuals", text, (regime_table(predictions), *_plots(predictions)))


def regime_table(
    predictions: Sequence[Prediction],
    name: str = "residuals",
    caption: str = "RMSE by joint (rows) and regime (columns), in % of nominal joint torque if known.",
) -> Table:
    """RMSE of every joint and regime, over nominal torque where there is one."""
    robot = predictions[0].model.robot
    values, nominal = residual_map(predictions), np.isfinite(robot.nominal_torque)
    units = ["%" if has else unit for has, unit in zip(nominal, torque_units(robot), strict=True)]
    return shaded_table(
        name, caption, np.where(nominal[:, None], 100 * values, values), REGIMES, robot.joint_names, units
    )


def residual_map(predictions: Sequence[Prediction]) -> np.ndarray:
    """(n, regimes) RMSE over nominal torque, or [N·m] where a joint has none; NaN where a joint is never in one."""
    robot = predictions[0].model.robot
    slowest = standstill_speed([prediction.velocity for prediction in predictions], robot.max_velocity)
    total, count = np.zeros((2, robot.dof, len(REGIMES)))
    for prediction in predictions:
        rate = 1 / float(np.median(np.diff(prediction.time)))
        q, qd, qdd, load = prediction.position, prediction.velocity, prediction.acceleration, prediction.predicted
        for joint, square in enumerate(prediction.error.T**2):
            masks = regime_masks(q[:, joint], qd[:, joint], qdd[:, joint], load[:, joint], float(slowest[joint]), rate)
            total[joint] += [square[inside].sum() for inside in masks.values()]
            count[joint] += [inside.sum() for inside in masks.values()]
    with np.errstate(divide="ignore", invalid="ignore"):
        rmse = np.sqrt(total / count)
    nominal = robot.nominal_torque
    return rmse / np.where(np.isfinite(nominal), nominal, 1.0)[:, None]


def _plots(predictions: Sequence[Prediction]) -> list[Plot]:
    """Four plots over all samples of the motions, the joint with the largest error first."""
    robot = predictions[0].model.robot
    nominal = robot.nominal_torque
    shares = bool(np.isfinite(nominal).all())
    scale, unit = (100 / nominal, "% of nominal") if shares else (np.ones(robot.dof), "N·m")
    error = [prediction.error * scale for prediction in predictions]
    order = worst_first(robot, np.mean([p.rmse(moving=True) for p in predictions], axis=0))
    return [
        _over_time(predictions, error, order, unit),
        _binned("position", predictions, np.concatenate(error), order, unit),
        _binned("velocity", predictions, np.concatenate(error), order, unit),
        _spectrum(predictions, error, order, unit),
    ]


def _over_time(predictions: Sequence[Prediction], error: Sequence[np.ndarray], order: Sequence[int], unit: str) -> Plot:
    """All motions one after the other."""
    names = predictions[0].model.robot.joint_names
    ends = np.cumsum([0.0, *(float(np.ptp(p.time)) + 0.5 for p in predictions)])
    time = np.concatenate([p.time - p.time[0] + start for p, start in zip(predictions, ends, strict=False)])
    series = joint_series(names, np.concatenate(error), order)
    motions = f"all {len(predictions)} motions, one after the other" if len(predictions) > 1 else "the motion"
    caption = f"Error of the model over time: {motions}."
    return Plot("residual-time", caption, "time", (Panel("left over", unit, series),), time, "s")


def _binned(over: str, predictions: Sequence[Prediction], error: np.ndarray, order: Sequence[int], unit: str) -> Plot:
    """A panel a joint: median, and the band of the middle 90 %, in narrow ranges of position or velocity."""
    robot = predictions[0].model.robot
    what = "position" if over == "position" else "speed"
    panels = []
    for k in order:
        slides = robot.joints[k].prismatic
        scale = 180 / np.pi if over == "position" and not slides else 1.0
        values = scale * np.concatenate([getattr(prediction, over)[:, k] for prediction in predictions])
        edges = np.linspace(values.min(), values.max(), _BINS + 1)
        if edges[-1] <= edges[0]:
            continue
        bin_of_sample = np.clip(np.digitize(values, edges) - 1, 0, _BINS - 1)
        rows = [error[bin_of_sample == b, k] for b in range(_BINS)]
        known = [b for b in range(_BINS) if len(rows[b]) >= _FEWEST]
        if not known:
            continue
        low, middle, high = np.array([[*np.quantile(rows[b], (0.05, 0.5, 0.95))] for b in known]).T
        colour = SERIES[k % len(SERIES)]
        series = (Series("middle 90 %", high, colour=colour, low=low), Series("median", middle, colour=colour))
        title = robot.joint_names[k] + (" (slides: m, m/s)" if slides else "")
        panels.append(Panel(title, unit, series, (edges[:-1] + edges[1:])[known] / 2, joint=robot.joint_names[k]))
    sliding = all(joint.prismatic for joint in robot.joints)
    x_unit = {"position": "m" if sliding else "deg", "speed": "m/s" if sliding else "rad/s"}[what]
    caption = f"Error of the model over the {what} of each joint."
    return Plot(f"residual-{what}", caption, what, tuple(panels), x_unit=x_unit, link=UNLINKED, columns=2)


def _spectrum(predictions: Sequence[Prediction], error: Sequence[np.ndarray], order: Sequence[int], unit: str) -> Plot:
    """Amplitude of the residual over frequency: root of the mean power of all motions, under Hann windows."""
    names = predictions[0].model.robot.joint_names
    frequency = np.linspace(0.0, 1.5 * predictions[0].cutoff, _SPECTRUM)
    power = np.zeros((_SPECTRUM, len(names)))
    for prediction, values in zip(predictions, error, strict=True):
        window = np.hanning(len(values))[:, None]
        period = float(np.median(np.diff(prediction.time)))
        spectrum = np.abs(np.fft.rfft((values - values.mean(axis=0)) * window, axis=0)) * 2 / window.sum()
        frequencies = np.fft.rfftfreq(len(values), period)
        power += np.stack([np.interp(frequency, frequencies, column**2) for column in spectrum.T], axis=1)
    amplitude = joint_series(names, np.sqrt(power / len(predictions)), order)
    caption = "Error of the model over frequency. The torque filter removes what lies above its cut-off."
    panel = Panel("amplitude", unit, amplitude, from_zero=True)
    return Plot("residual-frequency", caption, "frequency", (panel,), frequency, "Hz")
