"""Weighted least squares without a prior: the paper's own (AIM 2013, section III), and the plain one of most tools.

    θ = (W X)⁺ W y,   W = diag(1 / σ_j) over the rows of joint j,

with σ_j the residual deviation of joint j under ordinary least squares (eq. 4). The columns are base parameters and
the three friction terms of eq. 2, or, for `plain`, Coulomb and viscous friction and an offset. There is no prior: what
the motion does not excite is left to the pseudo-inverse, which takes the solution of minimum norm (columns scaled to
unit length, so that units do not matter).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.estimation.moments import Moments
from agent.estimation.problem import Estimate, Problem
from agent.estimation.solving import pseudo_inverse, scaled_rank

_PLAIN_ROUNDS = 4


def paper(problem: Problem) -> Estimate:
    """Weighted least squares of minimum norm, weights from one fit in which every joint counts alike."""
    return _without_prior(
        problem,
        1,
        "The paper's own estimator: Coulomb, viscous and quadratic friction, the weights of its eq. 4, no prior.",
    )


def plain(problem: Problem) -> Estimate:
    """Weighted least squares of minimum norm, its weights in keeping with the residuals."""
    return _without_prior(
        problem,
        _PLAIN_ROUNDS,
        "Plain weighted least squares: Coulomb and viscous friction and an offset per axle, no prior.",
    )


def _without_prior(problem: Problem, rounds: int, note: str) -> Estimate:
    moments = problem.moments
    weights = np.ones((2, problem.observation.robot.dof))
    for _ in range(rounds):
        weights = _eq_4(moments, _minimum_norm(moments.weighted(weights)))
    silent = moments.parameters - scaled_rank(moments.weighted(weights)[:-1, :-1])
    if silent:
        note += (
            f" {silent} of {moments.parameters} parameter directions are not in these data: the solution of minimum "
            "norm is taken, and their standard deviations are what such an arm could have."
        )
    return replace(problem, prior_weight=0.0).estimate(weights, note, _minimum_norm)


def _minimum_norm(total: np.ndarray) -> np.ndarray:
    return pseudo_inverse(total[:-1, :-1]) @ total[:-1, -1]


def _eq_4(moments: Moments, parameters: np.ndarray) -> np.ndarray:
    """(2, n) inverse residual variance of each joint, the same in motion and at standstill."""
    variance = moments.energy(parameters).sum(axis=0) / moments.rows.sum(axis=(0, 1))
    floor = 1e-30 + 1e-20 * moments.torque_energy().sum() / moments.rows.sum()
    return np.tile(1 / np.maximum(variance, floor), (2, 1))
