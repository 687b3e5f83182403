"""Tests whether a series of runs changed, given a known covariate: least-squares fits, t-tests against no change.

Three kinds of change are tried: a drift along time, a drift along the number of runs, and a step after every run. The
likeliest is reported; its p-value is corrected for the number of alternatives (Bonferroni). The variance of a test is
widened by (1 + ρ) / (1 - ρ) where residuals are autocorrelated. The caller decides what is significant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

_SIGNIFICANT = 4.0  # standard deviations by which the covariate's power must exceed its noise
_SEGMENT = 3  # fewest runs on either side of a step


@dataclass(frozen=True, eq=False)
class Background:
    """The covariate (R,) of a series, with the prior `coefficient` and its standard deviation `std`.

    `noise` is the variance of the covariate's own noise.
    """

    covariate: np.ndarray
    coefficient: float = 0.0
    std: float = np.inf
    noise: float = 0.0

    @property
    def varies(self) -> bool:
        """Whether the covariate changes at all."""
        return bool(np.ptp(self.covariate) > 0)


@dataclass(frozen=True, eq=False)
class SeriesChange:
    """The likeliest change of a series.

    `kind` is drift or step; a step comes after run number `place`. `size` is the change over the whole window, with its
    `deviation`; `shape` (R,) changes by 1 from end to end. `probability` is that of an equal change by chance. `drift`
    and `drift_deviation` are the linear change with time, also if another kind is the likeliest.
    """

    kind: str
    place: int
    size: float
    deviation: float
    probability: float
    shape: np.ndarray
    drift: float
    drift_deviation: float


def line(values: np.ndarray) -> np.ndarray:
    """(R,) centred, and 1 from end to end."""
    return (values - values.mean()) / max(float(np.ptp(values)), 1e-300)


def find_change(y: np.ndarray, times: np.ndarray, background: Background) -> SeriesChange:
    """The likeliest change of y (R,) after removing the covariate."""
    number = np.arange(len(y))
    places = np.arange(_SEGMENT, len(y) - _SEGMENT + 1)
    # age wears, and so does use
    shapes = np.vstack([line(times), line(number), (number >= places[:, None]) - 0.5])
    sizes, deviations, p_values = sizes_of_change(y, background, shapes)
    paid = p_values * 2 * np.repeat([2, len(places)], [2, len(places)])
    best = int(np.argmin(paid))
    kind, place = ("drift", 1) if best < 2 else ("step", int(places[best - 2]))
    size, deviation, probability = float(sizes[best]), float(deviations[best]), min(1.0, float(paid[best]))
    shape = shapes[best].copy()  # a view would keep the shapes of all alternatives in memory
    return SeriesChange(kind, place, size, deviation, probability, shape, float(sizes[0]), float(deviations[0]))


def fit_course(y: np.ndarray, background: Background, shape: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (p,) and design (R, p): a mean, the covariate if it varies, the shape if there is one.

    The prior of the covariate's coefficient is one more row, weighted by the noise of a fit without it.
    """
    columns = [np.ones(len(y))]
    if background.varies:
        columns.append(background.covariate - background.covariate.mean())
    if shape is not None:
        columns.append(shape)
    design = np.column_stack(columns)
    rows, right = design, y
    if background.varies and np.isfinite(background.std):
        free = np.linalg.lstsq(design, y, rcond=1e-9)[0]
        variance = float(np.sum((y - design @ free) ** 2)) / (len(y) - design.shape[1])
        knowledge = np.zeros(design.shape[1])
        knowledge[1] = np.sqrt(max(variance, 1e-12)) / background.std
        rows, right = np.vstack([design, knowledge]), np.append(y, knowledge[1] * background.coefficient)
    return np.linalg.lstsq(rows, right, rcond=1e-9)[0], design


def sizes_of_change(
    y: np.ndarray, background: Background, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sizes, their deviations and their probabilities by chance, (K,) each, of `shapes` (K, R) in y (R,).

    If the covariate is nearly collinear with the shape, mostly noise remains to estimate its coefficient, which would
    be biased towards zero. So the noise is subtracted from its power, and the prior decides.
    """
    y = y - y.mean()
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    power, degrees_of_freedom = np.sum(shapes**2, axis=1), len(y) - 2 - background.varies
    raw = shapes @ y / power
    coefficient, std, along = np.zeros((3, len(shapes)))
    common = np.zeros(len(y))
    if background.varies:
        common = background.covariate - background.covariate.mean()
        along = shapes @ common / power
        remainder, common_rest = y - raw[:, None] * shapes, common - along[:, None] * shapes
        coefficient, std = _coefficients(remainder, common_rest, background)
    known = np.isfinite(std)
    coefficient, std = np.where(known, coefficient, 0.0), np.where(known, std, 0.0)
    sizes = raw - coefficient * along
    residual = y - coefficient[:, None] * common - sizes[:, None] * shapes
    variance = _widened(residual, degrees_of_freedom) / power + (along * std) ** 2
    deviations = np.sqrt(np.maximum(variance, 1e-30))
    p_values = 2 * stdtr(degrees_of_freedom, -np.abs(sizes) / deviations)
    return np.where(known, sizes, 0.0), np.where(known, deviations, np.inf), np.where(known, p_values, 1.0)


def _coefficients(y: np.ndarray, common: np.ndarray, background: Background) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (K,) of the covariate in y (K, R), with the shapes projected out of both, and their deviations."""
    runs = y.shape[1]
    noise = runs * background.noise
    information = np.sum(common**2, axis=1) - noise
    clear = (information >= _SIGNIFICANT * np.sqrt(2 / runs) * noise) & (
        information > 1e-12 * runs * np.ptp(background.covariate) ** 2
    )
    information = np.where(clear, information, 1.0)
    slope = np.sum(common * y, axis=1) / information
    variance = _widened(y - slope[:, None] * common, runs - 3)
    precision, before = information / np.maximum(variance, 1e-30), background.std**-2
    total = precision + before
    posterior = (precision * slope + before * background.coefficient) / total
    return np.where(clear, posterior, background.coefficient), np.where(clear, total**-0.5, background.std)


def _widened(residual: np.ndarray, degrees_of_freedom: int) -> np.ndarray:
    """Variance (K,) of the noise from residuals (K, R), widened for their autocorrelation."""
    energy = np.sum(residual**2, axis=1)
    rho = np.clip(np.sum(residual[:, 1:] * residual[:, :-1], axis=1) / np.maximum(energy, 1e-300), 0.0, 0.9)
    return energy / degrees_of_freedom * (1 + rho) / (1 - rho)
