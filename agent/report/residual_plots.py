"""What the model leaves, over time, angle, speed and frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.report.plots import SERIES, UNLINKED, Panel, Plot, Series, joint_series
from agent.report.torque_section import worst_first

if TYPE_CHECKING:
    from agent.validation import Prediction

_BINS = 60
_FEWEST = 10
_SPECTRUM = 300  # points


def residual_plots(predictions: Sequence[Prediction]) -> list[Plot]:
    """Four plots over all samples of the motions, the joint with the largest error first."""
    robot = predictions[0].model.robot
    nominal = robot.nominal_torque
    shares = bool(np.isfinite(nominal).all())
    scale = 100 / nominal if shares else np.ones(robot.dof)
    unit = "% of nominal" if shares else "N·m"
    error = [prediction.error * scale for prediction in predictions]
    together = np.concatenate(error)
    order = worst_first(robot, np.concatenate([p.rmse(moving=True)[None] for p in predictions]).mean(axis=0))
    angle, speed = (np.concatenate([getattr(p, what) for p in predictions]) for what in ("position", "velocity"))
    return [
        _over_time(predictions, error, order, unit),
        _binned("position", angle, together, order, predictions[0], unit),
        _binned("speed", speed, together, order, predictions[0], unit),
        _spectrum(predictions, error, order, unit),
    ]


def _over_time(predictions: Sequence[Prediction], error: Sequence[np.ndarray], order: Sequence[int], unit: str) -> Plot:
    """All motions one after the other."""
    names = predictions[0].model.robot.joint_names
    ends = np.cumsum([0.0, *(float(np.ptp(p.time)) + 0.5 for p in predictions)])
    time = np.concatenate([p.time - p.time[0] + start for p, start in zip(predictions, ends, strict=False)])
    together = np.concatenate(error)
    series = joint_series(names, together, order)
    motions = f"all {len(predictions)} motions, one after the other" if len(predictions) > 1 else "the motion"
    caption = f"Error of the model over time: {motions}."
    return Plot("residual-time", caption, "time", (Panel("left over", unit, series),), time, "s")


def _binned(
    what: str, abscissa: np.ndarray, error: np.ndarray, order: Sequence[int], prediction: Prediction, unit: str
) -> Plot:
    """A panel a joint: median, and the band of the middle 90 %, in narrow ranges of the abscissa (S, n)."""
    robot = prediction.model.robot
    panels = []
    for k in order:
        slides = robot.joints[k].prismatic
        scale = 180 / np.pi if what == "position" and not slides else 1.0
        values = scale * abscissa[:, k]
        edges = np.linspace(values.min(), values.max(), _BINS + 1)
        if edges[-1] <= edges[0]:
            continue
        place = np.clip(np.digitize(values, edges) - 1, 0, _BINS - 1)
        rows = [error[place == b, k] for b in range(_BINS)]
        known = [b for b in range(_BINS) if len(rows[b]) >= _FEWEST]
        if not known:
            continue
        low, middle, high = np.array([[*np.quantile(rows[b], (0.05, 0.5, 0.95))] for b in known]).T
        x = (edges[:-1] + edges[1:])[known] / 2
        series = (
            Series("middle 90 %", high, colour=SERIES[k % len(SERIES)], low=low),
            Series("median", middle, colour=SERIES[k % len(SERIES)]),
        )
        title = robot.joint_names[k] + (" (slides: m, m/s)" if slides else "")
        panels.append(Panel(title, unit, series, x, joint=robot.joint_names[k]))
    caption = f"Error of the model over the {what} of each joint."
    units = {"position": "deg", "speed": "rad/s"}
    if all(joint.prismatic for joint in robot.joints):
        units = {"position": "m", "speed": "m/s"}
    return Plot(f"residual-{what}", caption, what, tuple(panels), x_unit=units[what], link=UNLINKED, columns=2)


def _spectrum(predictions: Sequence[Prediction], error: Sequence[np.ndarray], order: Sequence[int], unit: str) -> Plot:
    """Amplitude of the residual over frequency: root of the mean power of all motions, under Hann windows."""
    names = predictions[0].model.robot.joint_names
    top = 1.5 * predictions[0].cutoff
    frequency = np.linspace(0.0, top, _SPECTRUM)
    power = np.zeros((_SPECTRUM, len(names)))
    for prediction, values in zip(predictions, error, strict=True):
        window = np.hanning(len(values))[:, None]
        period = float(np.median(np.diff(prediction.time)))
        found = np.abs(np.fft.rfft((values - values.mean(axis=0)) * window, axis=0)) * 2 / window.sum()
        place = np.fft.rfftfreq(len(values), period)
        power += np.stack([np.interp(frequency, place, column**2) for column in found.T], axis=1)
    amplitude = np.sqrt(power / len(predictions))
    panel = Panel("amplitude", unit, joint_series(names, amplitude, order), from_zero=True)
    caption = "Error of the model over frequency. The torque filter removes what lies above its cut-off."
    return Plot("residual-frequency", caption, "frequency", (panel,), frequency, "Hz")
