"""Weighted least squares with a prior, on moments.

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
    """Weights from residuals, after a first fit in which every joint counts alike; refined against round-off."""
    found = problem.estimate(problem.weights())
    prior, joints = problem.prior, np.arange(found.weights.shape[1])
    rows = [
        residual * found.weights[still.astype(int), joints]
        for residual, still in zip(problem.residuals(found.parameters), standstill(problem.observation), strict=True)
    ]
    slope = problem.correlation(rows) + problem.prior_weight * prior.precision @ (prior.mean - found.parameters)
    matrix = found.moments.weighted(found.weights)[:-1, :-1] + problem.prior_weight * prior.precision
    return replace(found, parameters=found.parameters + solve_scaled(matrix, slope))
