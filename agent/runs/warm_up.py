"""The part of an axle's friction that follows the warm-up of the whole arm, so that it is not taken for wear."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.runs.changes import Background

#: Fewest runs that say anything.
FEWEST = 8
_UNKNOWN_RESPONSE = 1.0  # prior deviation of an axle's response, as a multiple of the others'
_SIGNIFICANT = 4.0  # standard deviations by which the shared warm-up must exceed the noise of the rates
_SPEEDS_DIFFER = 0.15  # share by which the response at one speed may differ from that along the whole motion


def warm_up_backgrounds(
    axles: Sequence[int], values: np.ndarray, deviations: np.ndarray, rates: np.ndarray, rate_stds: np.ndarray
) -> Iterator[tuple[int, Background]]:
    """The warm-up that all axles share, as the covariate of every friction level that is positive in all runs.

    Parameters
    ----------
    axles: number of the axle of every level (K).
    values, deviations: friction (R, K) [N·m], and its deviation from run to run.
    rates, rate_stds: relative change of friction while a run lasted (R, n) [1/s] and its deviation, NaN where unknown.
    """
    levels: list[int] = np.flatnonzero(np.all(values > 0, axis=0)).tolist()
    logs = np.log(np.where(values > 0, values, 1.0))
    centred = logs - np.median(logs, axis=0)
    backgrounds: dict[int, Background] = {}
    for k in levels:
        axle = axles[k]
        if axle not in backgrounds:
            others = [m for m in levels if axles[m] != axle]
            if len({axles[m] for m in others}) < 3:  # wear of one would be half of the others' median
                backgrounds[axle] = Background(common_rate(rates, rate_stds))
            else:
                scatter = np.median(deviations[:, others] / values[:, others])
                noise = np.pi / 2 * float(scatter) ** 2 / len(others)  # of a median
                response = _warm_up_response(rates, axle)
                backgrounds[axle] = Background(np.median(centred[:, others], axis=1), *response, noise)
        yield k, backgrounds[axle]


def common_rate(rates: np.ndarray, rate_stds: np.ndarray) -> np.ndarray:
    """(R,) median over the axles, 0 where nothing is known."""
    known = np.isfinite(rates) & np.isfinite(rate_stds)
    return np.array([np.median(row[good]) if good.any() else 0.0 for row, good in zip(rates, known, strict=True)])


def _warm_up_response(rates: np.ndarray, axle: int) -> tuple[float, float]:
    """How an axle's friction responds to warm-up, as a multiple of the others, from rates (R, n); and its deviation.

    It is the slope of the axle's rate over the others' shared rate, from run to run. What is the same in all runs of a
    loop is no warm-up but, for example, the settling of the first cycle. Both coordinates are noisy, so the noise is
    subtracted from the power of the shared rate.
    """
    known = rates[np.isfinite(rates).all(axis=1)]
    if len(known) < FEWEST:
        return 1.0, _UNKNOWN_RESPONSE
    known = known - known.mean(axis=0)
    common, noise = _shared(np.delete(known, axle, axis=1))
    power = float(common @ common) - len(known) * noise
    if power < _SIGNIFICANT * noise * (2 * len(known)) ** 0.5:  # its scatter from noise alone
        return 1.0, _UNKNOWN_RESPONSE
    ratio = float(common @ known[:, axle]) / power
    residual = known[:, axle] - ratio * common
    precision = power / max(float(residual @ residual) / (len(known) - 2) + ratio**2 * noise, 1e-300)
    total = precision + _UNKNOWN_RESPONSE**-2
    ratio = (precision * ratio + _UNKNOWN_RESPONSE**-2) / total
    return ratio, float(np.hypot(total**-0.5, _SPEEDS_DIFFER * abs(ratio)))


def _shared(rates: np.ndarray) -> tuple[np.ndarray, float]:
    """The common factor (R,) of centred rates (R, n), scaled like the median axle, and the variance of its noise.

    Each axle is a multiple of the factor plus noise of its own; multiples and factor are fitted in turn.
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
