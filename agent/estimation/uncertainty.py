"""How far the parameters may be off, honestly.

Two views, of which the wider one counts for each parameter:

* Residuals of a model are autocorrelated, so S samples are worth S / T independent ones, T the integrated
  autocorrelation time of the joint's residual. The covariance is the inverse of Σ w_g / T_g X_gᵀ X_g + Λ.
* What the model gets wrong repeats with the place in the motion rather than with time. The delete-one jackknife over
  clusters (stretches of the motion, all cycles together) sees it: (C - 1) / C Σ (θ₍c₎ - θ̄)², whatever the form of the
  residuals (Efron and Stein, Annals of Statistics 9, 1981).
"""

from __future__ import annotations

import numpy as np

from agent.estimation.blocks import Partition
from agent.estimation.moments import Moments
from agent.estimation.prior import Prior
from agent.estimation.problem import Estimate, Problem
from agent.estimation.solving import solve_sum


def covariance(problem: Problem, found: Estimate, times: np.ndarray) -> np.ndarray:
    """(p, p) covariance of an estimate whose residuals have autocorrelation times (n,)."""
    prior, partition = problem.prior, problem.partition
    information = problem.moments.weighted(found.weights / times)[:-1, :-1] + prior.precision
    scale = 1 / np.sqrt(np.diag(information))
    stationary = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    total = found.moments.weighted(found.weights)
    estimates = np.array(
        [
            found.solver(total - found.moments.weighted(found.weights, partition.cluster == cluster))
            for cluster in range(partition.clusters)
        ]
    )
    count = len(estimates)
    jackknife = (count - 1) / count * np.sum((estimates - estimates.mean(axis=0)) ** 2, axis=0)
    widen = np.sqrt(np.maximum(1.0, jackknife / np.diag(stationary))) if count > 1 else np.ones(len(scale))
    return stationary * np.outer(widen, widen)


def held_out_energy(
    moments: Moments, partition: Partition, weights: np.ndarray, prior: Prior, trust: float
) -> np.ndarray:
    """(2, n) squared residual of every row when its fold is left out of the fit."""
    total = np.zeros((2, len(moments.index)))
    for fold in range(partition.folds):
        train, test = partition.training(fold), partition.fold == fold
        if test.any() and train.any():
            total += moments.energy(solve_sum(moments.weighted(weights, train), prior, trust), test)
    return total


def silent_directions(moments: Moments, weights: np.ndarray, prior: Prior, times: np.ndarray) -> np.ndarray:
    """(d, p) directions in which the data say less than the prior, in units of the prior's standard deviation."""
    information = moments.weighted(weights / times)[:-1, :-1]
    root = np.linalg.cholesky(np.linalg.inv(prior.precision))
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    return vectors[:, values < 1].T
