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

    diagonal: np.ndarray
    cross: np.ndarray
    lower: np.ndarray

    @classmethod
    def of(cls, products: np.ndarray, shared: int, scale: float, variance: float) -> NoiseRoot:
        """Of products (m, m) of the columns, the first `shared` of which all logs have in common."""
        diagonal = np.sqrt(1 + np.diag(products)[shared:] / scale)
        cross = products[:shared, shared:] / (scale * diagonal)
        inner = products[:shared, :shared] / scale - cross @ cross.T
        inner.flat[:: shared + 1] += 1 / variance
        return cls(diagonal, cross, np.linalg.cholesky(inner))

    @property
    def log_det(self) -> float:
        """Of the precision."""
        return 2 * float(np.log(np.diag(self.lower)).sum() + np.log(self.diagonal).sum())

    def solved(self, side: np.ndarray) -> np.ndarray:
        """L⁻¹ of (m, k) or (m,)."""
        shared = len(self.lower)
        of_logs = (side[shared:].T / self.diagonal).T
        return np.concatenate([solved_lower(self.lower, side[:shared] - self.cross @ of_logs), of_logs])

    def solved_transposed(self, side: np.ndarray) -> np.ndarray:
        """L⁻ᵀ of (m,)."""
        shared = len(self.lower)
        first = solved_lower(self.lower, side[:shared], transposed=True)
        return np.concatenate([first, (side[shared:] - self.cross.T @ first) / self.diagonal])


@dataclass(frozen=True, eq=False)
class JointMoments:
    """One joint under a hypothesis, over [X, Z, r].

    `reduced`: moments with the noise model integrated out; `root` of the noise model's precision; `half`: its solution
    with the cross moments; `own`: B of [X, Z, r], `cross`: V of U with these, `noise`: Q of U; `parameter_index`: of X
    and Z among all parameters; `effects`: which effects act here.
    """

    reduced: np.ndarray
    log_det: float
    root: NoiseRoot
    half: np.ndarray
    own: np.ndarray
    cross: np.ndarray
    noise: np.ndarray
    parameter_index: np.ndarray
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
    weights = np.append(mean, -1.0)
    side, noise = joint.cross @ weights, -joint.root.solved_transposed(joint.half @ weights)
    return max(float(weights @ joint.own @ weights + 2 * noise @ side + noise @ joint.noise @ noise), 0.0)


def solved_lower(lower: np.ndarray, side: np.ndarray, transposed: bool = False) -> np.ndarray:
    """Solution of L x = side, or of Lᵀ x = side; as `scipy.linalg.solve_triangular`, whose checks take longer."""
    return np.asarray(dtrtrs(lower.T, side, lower=0, trans=int(not transposed))[0])
