"""Whether a series of runs changed, beside what it follows anyway: least-squares courses, t-tests against no change.

The variance of a test is widened by (1 + ρ) / (1 - ρ) where residuals are autocorrelated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_CLEAR = 4.0  # deviations by which a background must stand out from its noise to tell its coefficient


def line(values: np.ndarray) -> np.ndarray:
    """(R,) centred, and 1 from end to end."""
    return (values - values.mean()) / max(float(np.ptp(values)), 1e-300)


@dataclass(frozen=True, eq=False)
class Background:
    """What a series follows besides its own change: a covariate (R,), and what is known of its coefficient.

    `noise` is the variance of the covariate's own noise.
    """

    covariate: np.ndarray
    coefficient: float = 0.0
    doubt: float = np.inf
    noise: float = 0.0

    @property
    def varies(self) -> bool:
        """Whether there is anything to follow."""
        return bool(np.ptp(self.covariate) > 0)


def fit_course(y: np.ndarray, background: Background, shape: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (p,) and design (R, p): a mean, the background where it varies, the shape where there is one.

    What is known of the background's coefficient is one more row; it weighs what the noise of a fit without it says.
    """
    columns = [np.ones(len(y))]
    if background.varies:
        columns.append(background.covariate - background.covariate.mean())
    if shape is not None:
        columns.append(shape)
    design = np.column_stack(columns)
    rows, right = design, y
    if background.varies and np.isfinite(background.doubt):
        free = np.linalg.lstsq(design, y, rcond=1e-9)[0]
        variance = float(np.sum((y - design @ free) ** 2)) / (len(y) - design.shape[1])
        knowledge = np.zeros(design.shape[1])
        knowledge[1] = np.sqrt(max(variance, 1e-12)) / background.doubt
        rows, right = np.vstack([design, knowledge]), np.append(y, knowledge[1] * background.coefficient)
    return np.linalg.lstsq(rows, right, rcond=1e-9)[0], design


def size_of_change(y: np.ndarray, background: Background, shape: np.ndarray) -> tuple[float, float, float]:
    """Size of `shape` in y beside the background, its deviation, and the probability of as much by chance.

    Where the background goes along with the shape, little but its own noise is left to tell its coefficient by, which
    would come out as zero. So that noise is taken from what the data say of it, and what was known before decides.
    """
    from scipy.special import stdtr

    y, shape = y - y.mean(), shape - shape.mean()
    power, freedom = float(shape @ shape), len(y) - 2 - background.varies
    coefficient, doubt, along = 0.0, 0.0, 0.0
    common = np.zeros(len(y))
    if background.varies:
        common = background.covariate - background.covariate.mean()
        along = float(shape @ common) / power
        coefficient, doubt = _coefficient(y - shape * float(shape @ y) / power, common - along * shape, background)
        if not np.isfinite(doubt):
            return 0.0, np.inf, 1.0
    size = float(shape @ (y - coefficient * common)) / power
    left = y - coefficient * common - size * shape
    deviation = float(np.sqrt(max(_widened(left, freedom) / power + (along * doubt) ** 2, 1e-30)))
    return size, deviation, float(2 * stdtr(freedom, -abs(size) / deviation))


def _coefficient(y: np.ndarray, common: np.ndarray, background: Background) -> tuple[float, float]:
    """Coefficient of the background in y (R,), both without the shape, and its deviation."""
    noise = len(y) * background.noise
    seen = float(common @ common) - noise
    if seen < _CLEAR * np.sqrt(2 / len(y)) * noise or seen <= 1e-12 * len(y) * np.ptp(background.covariate) ** 2:
        return background.coefficient, background.doubt
    told = float(common @ y) / seen
    variance = _widened(y - told * common, len(y) - 3)
    precision, before = seen / max(variance, 1e-30), background.doubt**-2
    total = precision + before
    return (precision * told + before * background.coefficient) / total, float(total**-0.5)


def _widened(left: np.ndarray, freedom: int) -> float:
    """Variance of the noise from residuals (R,), for what their autocorrelation makes of a mean."""
    energy = float(left @ left)
    rho = float(np.clip(left[1:] @ left[:-1] / max(energy, 1e-300), 0.0, 0.9))
    return energy / freedom * (1 + rho) / (1 - rho)
