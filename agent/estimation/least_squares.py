"""Ordinary and weighted least squares with a prior, on moments.

With row groups g of weight w_g, the estimate minimises Σ w_g |y_g - X_g θ|² + k (θ - θ₀)ᵀ Λ (θ - θ₀). The paper's
weights are the inverse residual variance of each joint (AIM 2013, eq. 4); here the rows in which a joint stands still
form a group of their own, never weighted above its moving rows: what stiction leaves open counts for what it is worth.

Normal equations square the condition number; one step of refinement from the rows' own residuals gives that
back (corrected seminormal equations, Björck, Linear Algebra Appl. 88, 1987).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.estimation.moments import standstill
from agent.estimation.problem import Estimate, Problem
from agent.estimation.solving import solve_scaled


def weighted(problem: Problem) -> Estimate:
    """The paper's estimator: weights from residuals, after a first fit in which every joint counts alike."""
    return _refined(problem, problem.weights())


def reweighted(problem: Problem) -> Estimate:
    """Weights that agree with the residuals they leave."""
    return _refined(problem, problem.weights(rounds=20))


def ordinary(problem: Problem) -> Estimate:
    """Every row of every joint with the same weight."""
    rows = problem.moments.rows.sum(axis=0)
    variance = problem.moments.energy(problem.solve(problem.weights())).sum() / rows.sum()
    return _refined(problem, np.full(rows.shape, 1 / variance))


def _refined(problem: Problem, weights: np.ndarray) -> Estimate:
    """With one step from the rows' own residuals against round-off."""
    found = problem.estimate(weights)
    prior, joints = problem.prior, np.arange(found.weights.shape[1])
    rows = [
        residual * found.weights[still.astype(int), joints]
        for residual, still in zip(problem.residuals(found.parameters), standstill(problem.observation), strict=True)
    ]
    slope = problem.correlation(rows) + problem.prior_weight * prior.precision @ (prior.mean - found.parameters)
    matrix = found.moments.weighted(found.weights)[:-1, :-1] + problem.prior_weight * prior.precision
    return replace(found, parameters=found.parameters + solve_scaled(matrix, slope))
