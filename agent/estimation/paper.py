"""The paper's own estimator, to compare with: AIM 2013, section III, and nothing else.

    θ = (W X)⁺ W y,   W = diag(1 / σ_j) over the rows of joint j,

with σ_j the residual deviation of joint j under ordinary least squares (eq. 4). The columns are base parameters and
the three friction terms of eq. 2. There is no prior: what the motion does not excite is left to the pseudo-inverse,
which takes the solution of minimum norm (columns scaled to unit length, so that units do not matter).
"""

from __future__ import annotations

import numpy as np

from agent.estimation.moments import Moments
from agent.estimation.problem import Estimate, Problem, cross_validate
from agent.estimation.solving import pseudo_inverse, scaled_rank


def paper(problem: Problem) -> Estimate:
    """Weighted least squares of minimum norm, weights from one fit in which every joint counts alike."""
    moments = problem.moments
    equal = np.ones((2, problem.observation.robot.dof))
    weights = _eq_4(moments, _minimum_norm(moments.weighted(equal)))
    held_out = cross_validate(problem, moments, weights, _minimum_norm)
    total = moments.weighted(weights)
    silent = moments.parameters - scaled_rank(total[:-1, :-1])
    note = "The paper's own estimator: Coulomb, viscous and quadratic friction, the weights of its eq. 4, no prior."
    if silent:
        note += (
            f" {silent} of {moments.parameters} parameter directions are not in these data: the solution of minimum "
            "norm is taken, and their standard deviations are what such an arm could have."
        )
    return Estimate(_minimum_norm(total), weights, moments, held_out, _minimum_norm, 0.0, note)


def _minimum_norm(total: np.ndarray) -> np.ndarray:
    return pseudo_inverse(total[:-1, :-1]) @ total[:-1, -1]


def _eq_4(moments: Moments, parameters: np.ndarray) -> np.ndarray:
    """(2, n) inverse residual variance of each joint, the same in motion and at standstill."""
    variance = moments.energy(parameters).sum(axis=0) / moments.rows.sum(axis=(0, 1))
    floor = 1e-30 + 1e-20 * moments.torque_energy().sum() / moments.rows.sum()
    return np.tile(1 / np.maximum(variance, floor), (2, 1))
