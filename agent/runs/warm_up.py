"""How arms warm up from run to run: what friction of an axle follows that is no wear of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.runs.changes import Background

#: Fewest runs that say anything.
FEWEST = 8
_UNKNOWN_RESPONSE = 1.0  # deviation of how an axle warms, as a multiple of the others
_SIGNIFICANT = 4.0  # deviations by which a warm-up in the rates must stand out from their noise to tell anything
_SPEEDS_DIFFER = 0.15  # of it: at one speed friction may answer so much more or less than along the whole motion


def warm_up_backgrounds(
    axles: Sequence[int], values: np.ndarray, deviations: np.ndarray, rates: np.ndarray, rate_stds: np.ndarray
) -> Iterator[tuple[int, Background]]:
    """What every friction level that has a logarithm follows besides its own change: the warm-up all axles share.

    Parameters
    ----------
    axles: number of the axle of every level (K).
    values, deviations: friction (R, K) [N·m], and its deviation from run to run.
    rates, rate_stds: relative change of friction while a run lasted (R, n) [1/s] and its deviation, NaN where unknown.
    """
    levels: list[int] = np.flatnonzero(np.all(values > 0, axis=0)).tolist()
    logs = np.log(np.where(values > 0, values, 1.0))
    centred = logs - np.median(logs, axis=0)
    found: dict[int, Background] = {}
    for k in levels:
        axle = axles[k]
        if axle not in found:
            others = [m for m in levels if axles[m] != axle]
            if len({axles[m] for m in others}) < 3:  # wear of one would be half of the others' median
                found[axle] = Background(common_rate(rates, rate_stds))
            else:
                scatter = np.median(deviations[:, others] / values[:, others])
                noise = np.pi / 2 * float(scatter) ** 2 / len(others)  # of a median
                response = _warm_up_response(rates, axle)
                found[axle] = Background(np.median(centred[:, others], axis=1), *response, noise)
        yield k, found[axle]


def common_rate(rates: np.ndarray, rate_stds: np.ndarray) -> np.ndarray:
    """(R,) median over the axles, 0 where nothing is known."""
    known = np.isfinite(rates) & np.isfinite(rate_stds)
    return np.array([np.median(row[good]) if good.any() else 0.0 for row, good in zip(rates, known, strict=True)])


def _warm_up_response(rates: np.ndarray, axle: int) -> tuple[float, float]:
    """How an axle's friction responds to warm-up, as a multiple of the others, from rates (R, n); and its deviation.

    It is the slope of the axle's rate over what the others' rates share, from run to run. What all runs of a loop have
    alike is no warm-up: bristles that settle in the first cycle, what the model lacks. Both coordinates are noisy, so
    the power of what is shared is taken without its noise.
    """
    known = rates[np.isfinite(rates).all(axis=1)]
    if len(known) < FEWEST:
        return 1.0, _UNKNOWN_RESPONSE
    known = known - known.mean(axis=0)
    common, noise = _shared(np.delete(known, axle, axis=1))
    power = float(common @ common) - len(known) * noise
    if power < _SIGNIFICANT * noise * (2 * len(known)) ** 0.5:  # what noise alone makes of it scatters by that root
        return 1.0, _UNKNOWN_RESPONSE
    ratio = float(common @ known[:, axle]) / power
    left = known[:, axle] - ratio * common
    precision = power / max(float(left @ left) / (len(known) - 2) + ratio**2 * noise, 1e-300)
    total = precision + _UNKNOWN_RESPONSE**-2
    ratio = (precision * ratio + _UNKNOWN_RESPONSE**-2) / total
    return ratio, float(np.hypot(total**-0.5, _SPEEDS_DIFFER * abs(ratio)))


def _shared(rates: np.ndarray) -> tuple[np.ndarray, float]:
    """What centred rates (R, n) of several axles share, (R,), scaled like the median axle; the variance of its noise.

    One common factor: each axle is a multiple of it and noise of its own, by turns fitted and averaged.
    """
    common = np.median(rates, axis=1)
    for _ in range(10):
        size = max(float(common @ common), 1e-300)
        multiples = rates.T @ common / size
        multiples = multiples / (np.median(multiples) or 1.0)
        noise = np.mean((rates - np.outer(common, multiples)) ** 2, axis=0)
        weights = multiples / np.maximum(noise, 1e-3 * noise.mean() + 1e-300)
        common = rates @ weights / (weights @ multiples)
    return common, float(1 / np.sum(multiples * weights))
