"""Where in the motion a joint's gap lies."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from agent.diagnosis.document import RegimeShare
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.joined import joined
from agent.model import regime_masks, standstill_speed

BANDS = ((0.0, 1.0), (1.0, 5.0), (5.0, 15.0), (15.0, np.inf))  # Hz

_RESAMPLED = 200  # numerical: draws of a bootstrap
_REPEATS = 3  # turns of a motor that show its phase, and parts of a log without cycles
_PHASES = 12  # numerical: of a motor's turn


def regimes(dataset: Dataset, error: np.ndarray, joint: int, floor: float = 0.0) -> tuple[RegimeShare, ...]:
    """Shares of Σ (e² − f²) of one joint's (S,) held-out error above its repeatability f (`floor`); regimes overlap.

    `interval` is 90 % of a bootstrap over blocks of a second, as errors last (Künsch, Annals of Statistics 17, 1989);
    `of_samples` is the share of time spent there.
    """
    excess = np.where(np.isfinite(error), error**2 - floor**2, 0.0)
    blocks = _block_numbers(dataset)
    shares = [
        RegimeShare(name, *_share(excess, mask, blocks), float(np.mean(mask)))
        for name, mask in masks(dataset, joint).items()
    ]
    shares += [
        RegimeShare(f"frequency {_band_name(*band)}", float(share), None, 1.0)
        for band, share in zip(BANDS, band_shares(dataset, error), strict=True)
    ]
    phase = motor_phase_share(dataset, error, joint)
    if phase is not None:
        shares.append(RegimeShare("motor_phase", phase, None, 1.0))
    return tuple(
        sorted((entry for entry in shares if entry.share >= LIMITS.negligible), key=lambda entry: -entry.share)
    )


def share_intervals(rows: np.ndarray, floor: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(n, 2) 90 % interval of each joint's share of Σ (B² − F²): blocks of errors (S', n) drawn with replacement."""
    good = ~np.isnan(rows[:, 0])
    unit = np.unique(block[good], return_inverse=True)[1]
    energy = np.stack([np.bincount(unit, column) for column in (rows[good] ** 2).T], axis=1)
    draws = resampled(len(energy))
    excess = np.maximum(draws @ energy / (draws @ np.bincount(unit))[:, None] - floor**2, 0)
    share = excess / np.maximum(excess.sum(axis=1, keepdims=True), 1e-300)
    return np.quantile(share, LAW.interval, axis=0).T


def masks(dataset: Dataset, joint: int) -> dict[str, np.ndarray]:
    """(S,) bool of each regime of a joint: those of `REGIMES`, then logs or their cycles."""
    q, load, acceleration = (joined(dataset.fit.signals, name)[:, joint] for name in ("q", "rigid", "qdd"))
    slowest = standstill_speed([dataset.speed], dataset.robot.max_velocity)[joint]
    of_state = regime_masks(q, dataset.speed[:, joint], acceleration, load, float(slowest), dataset.rate)
    return of_state | dict(_in_time(dataset))


def band_shares(dataset: Dataset, error: np.ndarray) -> np.ndarray:
    """(4,) shares of Σ e² in `BANDS`, from one spectrum a motion of one joint's (S,) error."""
    energy = np.zeros(len(BANDS))
    edges = [low for low, _ in BANDS]
    for part in np.split(error, dataset.fit.cuts):
        clean = np.nan_to_num(part)
        power = np.abs(np.fft.rfft(clean)) ** 2
        frequency = np.fft.rfftfreq(len(clean), 1 / dataset.rate)
        band = np.searchsorted(edges, frequency, side="right") - 1
        energy += np.bincount(band, power, len(BANDS))
    return energy / max(energy.sum(), 1e-300)


def motor_phase_share(dataset: Dataset, error: np.ndarray, joint: int) -> float | None:
    """Share of Σ e² that goes with the angle of the joint's own motor within a turn, where it turns slowly enough.

    Slowly: two periods a turn stay below the cut-off. What one value a phase and turn would explain of noise is taken
    off. None where the motor makes less than three such turns, or moves a slide.

    Args:
        dataset: logs with their filtered motion.
        error: (S,) [N·m] of the joint, NaN on guards.
        joint: from 0.
    """
    robot = dataset.robot
    if robot.joints[joint].prismatic:
        return None
    gear = abs(float(robot.gear_ratios[joint]))
    angle = gear * np.concatenate([s.axles.position[s.kept, joint] for s in dataset.fit.signals])
    speed = gear * np.abs(np.concatenate([s.axles.speed[s.kept, joint] for s in dataset.fit.signals]))
    slow = np.isfinite(error) & (speed < np.pi * dataset.cutoff) & (speed > 0)
    turns = float(np.sum(speed[slow])) / dataset.rate / (2 * np.pi)
    if turns < _REPEATS:
        return None
    phase = (np.mod(angle[slow], 2 * np.pi) / (2 * np.pi) * _PHASES).astype(int) % _PHASES
    deviation = error[slow] - np.mean(error[slow])
    count = np.bincount(phase, minlength=_PHASES)
    mean = np.bincount(phase, deviation, _PHASES) / np.maximum(count, 1)
    total = float(np.sum(deviation**2))
    predicted = float(np.sum(count * mean**2)) / max(total, 1e-300) - 1 / turns
    return max(predicted, 0.0) * total / max(float(np.nansum(error**2)), 1e-300)


def _in_time(dataset: Dataset) -> Iterator[tuple[str, np.ndarray]]:
    """Each log's cycles; thirds of a log without cycles."""
    for number, log in enumerate(dataset.logs):
        here = dataset.log == number
        if not here.any():
            continue
        last = dataset.time[here].max()
        starts = [start for start in log.cycle_starts if start < last]
        part = "cycle"
        if len(starts) < 2:
            first = dataset.time[here].min()
            starts, part = np.linspace(first, last, _REPEATS, endpoint=False).tolist(), "third"
        for k, (start, end) in enumerate(zip(starts, [*starts[1:], np.inf], strict=True)):
            yield f"{part} {k + 1} of {log.name}", here & (dataset.time >= start) & (dataset.time < end)


def _block_numbers(dataset: Dataset) -> np.ndarray:
    """(S,) number of the second of its log that each row lies in."""
    within = (dataset.time / LIMITS.segment_duration).astype(int)
    return np.unique(np.column_stack([dataset.log, within]), axis=0, return_inverse=True)[1].ravel()


def _share(excess: np.ndarray, mask: np.ndarray, blocks: np.ndarray) -> tuple[float, tuple[float, float] | None]:
    inside, total = np.bincount(blocks, excess * mask), np.bincount(blocks, excess)
    if total.sum() <= 0:
        return 0.0, None
    draws = resampled(len(total))
    of_draws = draws @ inside / np.maximum(draws @ total, 1e-9 * total.sum())
    low, high = np.clip(np.quantile(of_draws, LAW.interval), 0, 1)
    return float(np.clip(inside.sum() / total.sum(), 0, 1)), (float(low), float(high))


@cache
def resampled(count: int) -> np.ndarray:
    """How often each of `count` blocks is drawn, (draws, count)."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), _RESAMPLED).astype(float)


def _band_name(low: float, high: float) -> str:
    if low == 0:
        return f"below {high:g} Hz"
    return f"above {low:g} Hz" if np.isinf(high) else f"{low:g}-{high:g} Hz"
