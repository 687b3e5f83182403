"""Where in the motion a joint's gap lies."""

from __future__ import annotations

import numpy as np

from agent.diagnosis.dataset import Dataset

_LEAST = 0.05
_NEAR_REVERSAL = 0.15  # s


def regimes(dataset: Dataset, error: np.ndarray, joint: int) -> list[dict]:
    """Shares of Σ e² of one joint's (S',) error; regimes overlap. `of_samples` is the share of time spent there."""
    energy = error**2
    total = max(float(np.nansum(energy)), 1e-300)
    result = []
    for name, mask in masks(dataset, joint).items():
        share = float(np.nansum(energy[mask]) / total)
        if share >= _LEAST:
            result.append({"name": name, "share": share, "of_samples": float(np.mean(mask))})
    result += _bands(dataset, error)
    return sorted(result, key=lambda entry: -entry["share"])


def masks(dataset: Dataset, joint: int) -> dict[str, np.ndarray]:
    """(S',) bool of each regime of a joint."""
    speed = dataset.speed[:, joint]
    magnitude = np.abs(speed)
    fastest = max(float(magnitude.max()), 1e-9)
    q = np.concatenate([s.q[s.kept, joint] for s in dataset.fit.signals])
    load = np.abs(np.concatenate([s.rigid[s.kept, joint] for s in dataset.fit.signals]))
    acceleration = np.abs(np.concatenate([s.qdd[s.kept, joint] for s in dataset.fit.signals]))
    standing = magnitude < 0.005 * fastest
    turning = np.flatnonzero(np.diff(np.sign(speed)) != 0)
    near = np.zeros(len(speed), dtype=bool)
    reach = int(_NEAR_REVERSAL * dataset.rate)
    for at in turning:
        near[max(0, at - reach) : at + reach + 1] = True
    low, high = float(q.min()), float(q.max())
    third = (high - low) / 3
    found = {
        "standstill": standing,
        "reversal": near & ~standing,
        "low_speed": (magnitude < 0.1 * fastest) & ~standing,
        "high_speed": magnitude > 0.6 * fastest,
        "high_load": load > np.quantile(load, 0.75),
        "acceleration": acceleration > np.quantile(acceleration, 0.75),
        "position_low": q < low + third,
        "position_middle": (q >= low + third) & (q <= high - third),
        "position_high": q > high - third,
    }
    for number, log in enumerate(dataset.logs):
        here = dataset.log == number
        starts = [s for s in log.cycle_starts if s < dataset.time[here].max()]
        if len(starts) < 2:
            found[f"log {log.name}"] = here
            continue
        for cycle, start in enumerate(starts):
            end = starts[cycle + 1] if cycle + 1 < len(starts) else np.inf
            found[f"log {log.name} cycle {cycle + 1}"] = here & (dataset.time >= start) & (dataset.time < end)
    return found


def _bands(dataset: Dataset, error: np.ndarray) -> list[dict]:
    """Shares of frequency bands, from one spectrum a motion."""
    edges = (0.0, 1.0, 5.0, 15.0, np.inf)
    energy = np.zeros(len(edges) - 1)
    for part in np.split(error, dataset.fit.cuts):
        clean = np.nan_to_num(part)
        power = np.abs(np.fft.rfft(clean)) ** 2
        frequency = np.fft.rfftfreq(len(clean), 1 / dataset.rate)
        band = np.searchsorted(edges, frequency, side="right") - 1
        energy += np.bincount(np.minimum(band, len(energy) - 1), power, len(energy))
    names = ("below 1 Hz", "1-5 Hz", "5-15 Hz", "above 15 Hz")
    shares = energy / max(energy.sum(), 1e-300)
    return [
        {"name": f"frequency {name}", "share": float(share), "of_samples": 1.0}
        for name, share in zip(names, shares, strict=True)
        if share >= _LEAST
    ]
