"""Weighted least squares with a prior, on moments and on rows.

With row groups g of weight w_g, the estimate minimises Σ w_g |y_g - X_g θ|² + (θ - θ₀)ᵀ Λ (θ - θ₀). The paper's weights
are the inverse residual variance of each joint (AIM 2013, eq. 4); here the rows in which a joint stands still form a
group of their own, never weighted above its moving rows: what stiction leaves undetermined counts for what it is worth.
"""

from __future__ import annotations

import numpy as np

from agent.estimation.friction_terms import FrictionTerm
from agent.estimation.moments import ALL_CELLS, Cells, Moments, standstill
from agent.estimation.observation import Observation
from agent.estimation.prior import Prior


def solve(moments: Moments, weights: np.ndarray, prior: Prior, trust: float, cells: Cells = ALL_CELLS) -> np.ndarray:
    """(p,) estimate from moments, with weights (2, n) and the prior's precision times `trust`."""
    return solve_sum(moments.weighted(weights, cells), prior, trust)


def solve_sum(total: np.ndarray, prior: Prior, trust: float) -> np.ndarray:
    """(p,) estimate from a weighted sum (p + 1, p + 1)."""
    matrix = total[:-1, :-1] + trust * prior.precision
    right = total[:-1, -1] + trust * prior.precision @ prior.mean
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right)


def reweight(moments: Moments, parameters: np.ndarray) -> np.ndarray:
    """(2, n) inverse residual variance of each group at parameters (p,)."""
    rows = moments.rows.sum(axis=0)
    energy = moments.energy(parameters)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = energy / rows
    moving = np.where(rows[0] > 0, variance[0], variance[1])
    still = np.where(rows[1] > 0, np.maximum(variance[1], moving), moving)
    floor = 1e-30 + 1e-20 * moments.torque_energy().sum() / rows.sum()
    return 1 / np.maximum(np.stack([moving, still]), floor)


def ordinary_weights(moments: Moments) -> np.ndarray:
    """(2, n) equal weights, of the size of the inverse torque variance so that the prior keeps its meaning."""
    variance = moments.torque_energy().sum() / moments.rows.sum()
    return np.full((2, len(moments.index)), 1e4 / max(variance, 1e-30))


def iterate_weights(moments: Moments, prior: Prior, trust: float, rounds: int = 4) -> np.ndarray:
    """(2, n) weights consistent with the residuals they leave."""
    energy = moments.torque_energy().sum(axis=0) / np.maximum(moments.rows.sum(axis=(0, 1)), 1)
    weights = np.tile(1 / np.maximum(energy, 1e-30), (2, 1))
    for _ in range(rounds):
        weights = reweight(moments, solve(moments, weights, prior, trust))
    return weights


def solve_rows(
    observation: Observation,
    terms: tuple[FrictionTerm, ...],
    weights: np.ndarray,
    prior: Prior,
    trust: float,
    rigid_parameters: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The same estimate (p,) by orthogonal triangularisation of the rows, which does not square the condition number.

    Also the triangle (p + 1, p + 1): R of the weighted rows [X y], without the prior.
    """
    size = observation.rigid.count + len(terms) + 1
    triangle = np.zeros((0, size))
    for stretch, still in zip(observation.stretches, standstill(observation), strict=True):
        rows = np.zeros((stretch.torque.size, size))
        length = len(stretch.torque)
        for joint, (index, columns) in enumerate(observation.joint_columns(stretch, terms, rigid_parameters)):
            part = slice(joint * length, (joint + 1) * length)
            rows[part, index] = columns
            rows[part, -1] = stretch.torque[:, joint]
            rows[part] *= np.sqrt(weights[still[:, joint].astype(int), joint])[:, None]
        triangle = np.linalg.qr(np.vstack([triangle, rows]), mode="r")
    root = np.linalg.cholesky(trust * prior.precision + 1e-300 * np.eye(size - 1)).T
    stacked = np.vstack([triangle, np.column_stack([root, root @ prior.mean])])
    scale = 1 / np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
    full = np.linalg.qr(stacked * scale, mode="r")
    parameters = scale[:-1] * np.linalg.solve(full[:-1, :-1], full[:-1, -1]) / scale[-1]
    return parameters, triangle


def residuals(
    observation: Observation,
    terms: tuple[FrictionTerm, ...],
    parameters: np.ndarray,
    rigid_parameters: np.ndarray | None = None,
) -> list[np.ndarray]:
    """Per stretch (S', n) [N·m]: filtered measured torque minus what parameters (p,) explain."""
    result = []
    for stretch in observation.stretches:
        error = stretch.torque.copy()
        for joint, (index, columns) in enumerate(observation.joint_columns(stretch, terms, rigid_parameters)):
            error[:, joint] -= columns @ parameters[index]
        result.append(error)
    return result
