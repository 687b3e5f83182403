"""A torque channel that stays where it is while the arm moves on: a sensor that holds its value or is cut off.

A sensor that follows shows a change of torque within what noise and the model's error leave open. One that does not
is flat, no more restless than its noise from sample to sample, over half a window and the other half, between which
the model's torque has gone elsewhere. No law of an arm does that for a moment and follows again; fitted all the same
it is taken for a push, or for friction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.fit import Fit
from agent.model import known_effects

_WINDOWS = tuple(LIMITS.row_correlation_time * 2.0**k for k in range(-1, 4))  # numerical: s
_QUARTILE = float(ndtri(3 / 4))  # derived: half of normal errors are smaller, in standard deviations


@dataclass(frozen=True)
class StuckTorque:
    """Stretches in which a joint's torque was constant although it should have changed: their count, longest duration
    [s], torque [N·m] if always the same, and share of the arm's whole gap (energy over the noise model)."""

    joint: str
    times: int
    longest: float
    limit: float | None
    share: float

    @property
    def text(self) -> str:
        """Warning text."""
        value, how = "", "holds its value"
        if self.limit is not None:
            value, how = f" at {self.limit:.4g} N·m", "cuts it off there"
        times = f"{self.times} times" if self.times > 1 else "once"
        return (
            f"the torque of {self.joint} stands still{value} {times}, for up to {self.longest:.2g} s, where it should "
            f"change: its sensor or recorder {how}; {100 * min(self.share, 1.0):.0f} % of the gap is there, so no "
            "cause is named"
        )

    @property
    def motion(self) -> str:
        """Next motion to record."""
        return f"the same motions again, after you repair the torque measurement of {self.joint}"


def stuck_torque(dataset: Dataset, fitted: Fit) -> StuckTorque | None:
    """The joint whose torque stands still where most of the gap is; None where none does, or there is hardly a gap.

    It should change where the model and the effects of `fitted` say so: a coupled axis may leave a motor at one speed.
    What happens once does not count, as a push can be fitted to any torque that is held once.
    """
    fit = dataset.fit
    excess = (dataset.residual / fit.sigma) ** 2 - 1
    whole = float(np.sum(np.maximum(excess.sum(axis=0), 0.0)))
    if whole <= 0:
        return None
    effects = np.zeros_like(dataset.residual)
    for cause, values in zip(fitted.chosen, fitted.values, strict=True):
        for joint, block in ({} if cause.transient else cause.blocks).items():
            effects[:, joint] += block @ values * fit.sigma[:, joint]
    predicted = [
        s.low_pass(s.predicted) + known_effects(dataset.model, s) + more
        for s, more in zip(fit.signals, np.split(effects, fit.cuts), strict=True)
    ]
    largest: StuckTorque | None = None
    for joint, name in enumerate(dataset.robot.joint_names):
        background = float(fit.sigma[:, joint].min())
        by_model = [torque[:, joint] for torque in predicted]
        error = float(np.hypot(background, dataset.open_error[joint]))
        stretches = _of_joint(dataset, joint, by_model, excess[:, joint], error)
        energy = sum(stretch.energy for stretch in stretches)
        torque = np.sqrt(max(energy, 0.0) / len(excess)) * background / fit.reference.scale[joint]
        if torque < LAW.least_named_torque or energy < LIMITS.majority * whole:
            continue
        large = [s for s in stretches if s.energy > LIMITS.negligible * max(s.energy for s in stretches)]
        if sum(stretch.duration for stretch in large) < 2 * LIMITS.row_correlation_time:  # less may be chance
            continue
        if largest is None or energy / whole > largest.share:
            largest = _held(name, large, energy / whole)
    return largest


@dataclass(frozen=True)
class _Stretch:
    """Duration [s], torque [N·m], distance below the largest torque of its log, and energy."""

    duration: float
    size: float
    below: float
    energy: float


def _held(joint: str, stretches: Sequence[_Stretch], share: float) -> StuckTorque:
    """Text about the stretches that matter."""
    at_limit = all(stretch.below < LIMITS.negligible * stretch.size for stretch in stretches)
    limit = float(np.median([stretch.size for stretch in stretches])) if at_limit else None
    return StuckTorque(joint, len(stretches), max(stretch.duration for stretch in stretches), limit, share)


def _of_joint(
    dataset: Dataset, joint: int, predicted: Sequence[np.ndarray], excess: np.ndarray, error: float
) -> list[_Stretch]:
    """All stretches in which a joint's torque is constant. The torque by the model is given per motion, (S',) [N·m],
    with its `error`; `excess` (S'total,) is its energy over the noise model."""
    stretches, row = [], 0
    for signals, by_model in zip(dataset.fit.signals, predicted, strict=True):
        log, time = dataset.logs[signals.log_index], signals.time[signals.kept]
        rows = slice(row, row := row + len(time))
        assert log.effort is not None
        inside = (log.t >= time[0]) & (log.t <= time[-1])
        stamps, torque = log.t[inside], log.effort[inside, joint]
        if len(stamps) < LIMITS.min_samples:
            continue
        rests = np.interp(stamps, time, dataset.fit.near_rest[rows, joint].astype(float)) > 0
        flags = _stands_still(stamps, torque, np.interp(stamps, time, by_model), rests, error)
        highest = np.sqrt(2 * np.log(len(torque))) * _noise(torque)  # of as many samples of normal noise
        largest = float(np.abs(torque).max() - highest)
        for first, last in _runs(flags):
            begin, end = stamps[first], stamps[last - 1]
            energy = float(excess[rows][(time >= begin) & (time <= end)].sum())
            size = float(np.abs(np.median(torque[first:last])))
            stretches.append(_Stretch(float(end - begin), size, largest - size, energy))
    return stretches


def _stands_still(
    time: np.ndarray, torque: np.ndarray, predicted: np.ndarray, rests: np.ndarray, background: float
) -> np.ndarray:
    """(T,) samples of a torque (T,) [N·m] that is flat while the predicted one changes; `rests` are no evidence."""
    noise = _noise(torque)
    rate = 1 / float(np.median(np.diff(time)))
    starts = np.zeros(len(time) + 1, dtype=int)
    moving = (~rests).astype(float)
    of_torque, of_square, of_moving, of_predicted = (
        np.concatenate([[0.0], np.cumsum(column)])
        for column in (torque - torque.mean(), (torque - torque.mean()) ** 2, moving, moving * predicted)
    )
    for half in sorted({int(window * rate / 2) for window in _WINDOWS}):
        if 2 * half < LIMITS.min_samples or 2 * half >= len(time):
            continue
        a = np.arange(len(time) + 1 - 2 * half)
        b, c = a + half, a + 2 * half
        first, second = of_moving[b] - of_moving[a], of_moving[c] - of_moving[b]
        enough = (first > LIMITS.majority * half) & (second > LIMITS.majority * half)
        expected = (of_predicted[c] - of_predicted[b]) / np.maximum(second, 1) - (
            of_predicted[b] - of_predicted[a]
        ) / np.maximum(first, 1)
        change = (of_torque[c] - 2 * of_torque[b] + of_torque[a]) / half
        mean = (of_torque[c] - of_torque[a]) / (2 * half)
        spread = (of_square[c] - of_square[a]) / (2 * half) - mean**2
        error = noise * np.sqrt(2 / half)
        should = enough & (np.abs(expected) > LIMITS.significant_deviations * max(2 * error, background))
        flat = spread <= noise**2 * (1 + LIMITS.significant_deviations / np.sqrt(half)) + 1e-12 * of_square[-1] / len(
            time
        )
        flat_here = (
            should
            & flat
            & (np.abs(change) < LIMITS.negligible * np.abs(expected) + LIMITS.significant_deviations * error)
        )
        np.add.at(starts, a[flat_here], 1)
        np.add.at(starts, c[flat_here], -1)
    return np.cumsum(starts)[:-1] > 0


def _noise(torque: np.ndarray) -> float:
    """Standard deviation [N·m] from sample to sample; most of them may be equal, as of a torque in coarse steps."""
    change = np.abs(np.diff(torque))
    median = float(np.median(change))
    if median > 0:
        return median / (_QUARTILE * np.sqrt(2))
    usual = change[change <= LIMITS.significant_deviations * np.quantile(change, LAW.confidence)]
    return float(np.sqrt(np.mean(usual**2) / 2))


def _runs(flags: np.ndarray) -> Iterator[tuple[int, int]]:
    """First and one past the last of every stretch that is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
