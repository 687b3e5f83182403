"""Second moments of one joint under a hypothesis, with the noise model integrated out, and their linear algebra."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtrtrs

from agent.diagnosis.hypotheses.noise_model import scaled_cholesky


@dataclass(frozen=True, eq=False)
class NoiseRoot:
    """L of the noise model's precision L Lᵀ, without what each log has for itself, which is diagonal, in full.

    Of columns that all logs share, with a variance v, and others with 1: [[1 / v + Q_cc / s, Q_co / s], [·, 1 + Q_oo /
    s]] with Q_oo diagonal (`noise_model`). Eliminating the latter first leaves a matrix whose size no log adds to.
    """

    own: np.ndarray
    cross: np.ndarray
    lower: np.ndarray

    @classmethod
    def of(cls, square: np.ndarray, common: int, scale: float, variance: float) -> NoiseRoot:
        """Of products (m, m) of the columns, the first `common` of which all logs share."""
        own = np.sqrt(1 + np.diag(square)[common:] / scale)
        cross = square[:common, common:] / (scale * own)
        inner = square[:common, :common] / scale - cross @ cross.T
        inner.flat[:: common + 1] += 1 / variance
        return cls(own, cross, np.linalg.cholesky(inner))

    @property
    def log_det(self) -> float:
        """Of the precision."""
        return 2 * float(np.log(np.diag(self.lower)).sum() + np.log(self.own).sum())

    def solved(self, side: np.ndarray) -> np.ndarray:
        """L⁻¹ of (m, k) or (m,)."""
        common = len(self.lower)
        own = (side[common:].T / self.own).T
        return np.concatenate([solved_lower(self.lower, side[:common] - self.cross @ own), own])

    def solved_transposed(self, side: np.ndarray) -> np.ndarray:
        """L⁻ᵀ of (m,)."""
        common = len(self.lower)
        first = solved_lower(self.lower, side[:common], transposed=True)
        return np.concatenate([first, (side[common:] - self.cross.T @ first) / self.own])


@dataclass(frozen=True, eq=False)
class JointMoments:
    """One joint under a hypothesis, over [X, Z, r].

    `reduced`: moments with the noise model integrated out; `root` of the noise model's precision; `half`: its solution
    with the cross moments; `moments`: B of [X, Z, r], V of U with these, Q of U; `at`: indices of X and Z among all
    parameters; `effects`: which effects act here.
    """

    reduced: np.ndarray
    log_det: float
    root: NoiseRoot
    half: np.ndarray
    moments: tuple[np.ndarray, np.ndarray, np.ndarray]
    at: np.ndarray
    effects: tuple[int, ...]


def solved(matrix: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, float]:
    """Solution and log determinant of a positive definite system whose units differ widely."""
    unit = 1 / np.sqrt(np.diag(matrix))
    lower = scaled_cholesky(matrix, unit)
    half = solved_lower(lower, unit * side)
    log_det = 2 * float(np.log(np.diag(lower)).sum() - np.log(unit).sum())
    return unit * solved_lower(lower, half, transposed=True), log_det


def remaining_energy(joint: JointMoments, mean: np.ndarray) -> float:
    """Energy that model, effects and noise model leave on a joint at parameters (k,)."""
    own, cross, square = joint.moments
    weights = np.append(mean, -1.0)
    pull, background = cross @ weights, -joint.root.solved_transposed(joint.half @ weights)
    return max(float(weights @ own @ weights + 2 * background @ pull + background @ square @ background), 0.0)


def solved_lower(lower: np.ndarray, side: np.ndarray, transposed: bool = False) -> np.ndarray:
    """Solution of L x = side, or of Lᵀ x = side; as `scipy.linalg.solve_triangular`, whose checks take longer."""
    return np.asarray(dtrtrs(lower.T, side, lower=0, trans=int(not transposed))[0])
