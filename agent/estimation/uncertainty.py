"""Uncertainty of the parameters.

The estimate is θ̂ = A⁻¹ (Xᵀ W y + k Λ θ₀) with A = Xᵀ W X + k Λ, so its covariance is A⁻¹ (M + k² Λ) A⁻¹ with
M = Xᵀ W E[e eᵀ] W X: the second term is what the prior may be wrong by, M what the noise does. Two views of M:

* Residuals are autocorrelated. With their power spectrum S(f), M = Σ_f S(f) X(f)ᴴ X(f): what counts for a parameter is
  the noise at the frequencies its column has. A fit has eaten part of the noise in its own residuals and adds as much
  on rows held out, so S is scaled by the geometric mean of both over the former.
* The model's error depends on the position in the motion rather than on time. The delete-one jackknife over
  clusters (segments of the motion, all cycles together) sees it: (C - 1) / C Σ (θ₍c₎ - θ̄)², whatever the form of the
  residuals (Efron and Stein, Annals of Statistics 9, 1981). Deviations are widened to it where it is larger by more
  than its own scatter.
"""

from __future__ import annotations

import numpy as np

from agent.core import symmetric_eigen
from agent.estimation.normal_equations import Moments, inverse, pseudo_inverse, scaled_rank, standstill
from agent.estimation.prior import Prior
from agent.estimation.problem import Estimate, Problem
from agent.model import ParameterPrior

_SPECTRUM = 256  # rows in one piece of the estimate of a spectrum


def covariance(problem: Problem, fit: Estimate) -> np.ndarray:
    """(p, p) covariance of an estimate; of directions that one without prior leaves open, the prior's."""
    prior, count = problem.prior, problem.partition.clusters
    total = fit.moments.weighted(fit.weights)
    if fit.prior_weight > 0:
        bread = inverse(total[:-1, :-1] + fit.prior_weight * prior.precision)
        stationary = bread @ (_noise(problem, fit) + fit.prior_weight**2 * prior.precision) @ bread.T
    else:
        bread = pseudo_inverse(total[:-1, :-1])
        stationary = bread @ _noise(problem, fit) @ bread.T + _left_open(total[:-1, :-1], prior)
    if count < 2:
        return stationary
    ratio = jackknife(problem, fit) / np.diag(stationary)
    widen = np.sqrt(np.where(ratio > 1 + 2 * np.sqrt(2 / (count - 1)), ratio, 1.0))
    return stationary * np.outer(widen, widen)


def jackknife(problem: Problem, fit: Estimate) -> np.ndarray:
    """(p,) variances by leaving out one cluster after the other; zero where there is one only."""
    total, cells = fit.moments.weighted(fit.weights), problem.partition
    left_out = (fit.moments.weighted(fit.weights, cells.cluster == cluster) for cluster in range(cells.clusters))
    estimates = np.array([fit.solver(total - part) for part in left_out])
    count = len(estimates)
    return np.asarray((count - 1) / count * np.sum((estimates - estimates.mean(axis=0)) ** 2, axis=0))


def parameter_prior(problem: Problem, fit: Estimate) -> ParameterPrior | None:
    """What was held before the data, and how much of its variance they took away; None for an estimate without prior.

    The share is 1 - diag(A⁻¹) / diag((k Λ)⁻¹), a prior that counts as much as rows that are not independent do.
    """
    if fit.prior_weight == 0:
        return None
    precision = fit.prior_weight * problem.prior.precision
    before = np.diag(inverse(precision))
    after = np.diag(inverse(problem.moments.weighted(fit.weights)[:-1, :-1] + precision))
    deviation = np.sqrt(fit.prior_weight * before)
    return ParameterPrior(problem.prior.mean, deviation, np.clip(1 - after / before, 0.0, 1.0))


def _left_open(matrix: np.ndarray, prior: Prior) -> np.ndarray:
    """(p, p) second moment of what a solution of minimum norm lacks: N θ, N = 1 - A⁺ A, with θ as in the prior."""
    if scaled_rank(matrix) == len(matrix):
        return np.zeros_like(matrix)
    null = np.eye(len(matrix)) - pseudo_inverse(matrix) @ matrix
    return null @ (inverse(prior.precision) + np.outer(prior.mean, prior.mean)) @ null.T


def _noise(problem: Problem, fit: Estimate) -> np.ndarray:
    """(p, p) M = Xᵀ W E[e eᵀ] W X for stationary noise with the spectrum of the residuals."""
    observation = problem.observation
    joints = np.arange(observation.robot.dof)
    root = [np.sqrt(fit.weights)[still.astype(int), joints] for still in standstill(observation)]
    residuals = problem.free_residuals(fit.parameters)
    scaled = [rows * scale for rows, scale in zip(residuals, root, strict=True)]
    spectra = _spectra(scaled)
    within = np.sum(fit.weights * problem.moments.energy(fit.parameters), axis=0)
    without = np.sum(fit.weights * fit.held_out.sum(axis=0), axis=0)
    spectra = spectra * np.sqrt(np.maximum(without / np.maximum(within, 1e-300), 1.0))
    total = np.zeros((problem.moments.parameters,) * 2)
    for segment, friction, scale in zip(observation.segments, problem.friction(), root, strict=True):
        size = len(segment.time)
        grid = np.linspace(0, len(spectra) - 1, size // 2 + 1)
        for joint, (index, rows) in enumerate(observation.joint_rows(segment, problem.terms, friction)):
            density = np.interp(grid, np.arange(len(spectra)), spectra[:, joint])
            spectrum = np.fft.rfft(rows[:, :-1] * scale[:, joint, None], axis=0) * np.sqrt(density)[:, None]
            coloured = np.fft.irfft(spectrum, size, axis=0)
            total[np.ix_(index, index)] += coloured.T @ coloured
    return total


def _spectra(rows: list[np.ndarray]) -> np.ndarray:
    """(F, n) power spectrum of (S', n) series, 1 at all frequencies for independent rows of variance 1 (Welch's).

    Zeros do not count: they are rows of held joints.
    """
    length = min(_SPECTRUM, min(len(part) for part in rows))
    window = np.hanning(length + 2)[1:-1, None]
    power, energy = np.zeros(1), np.zeros(1)
    for part in rows:
        for first in range(0, len(part) - length + 1, max(1, length // 2)):
            piece = part[first : first + length]
            power = power + np.abs(np.fft.rfft(piece * window, axis=0)) ** 2
            energy = energy + np.sum(window**2 * (piece != 0), axis=0)
    return np.asarray(power / np.maximum(energy, 1e-300))


def unobserved_directions(moments: Moments, weights: np.ndarray, prior: Prior, times: np.ndarray) -> np.ndarray:
    """(d, p) directions in which the data say less than the prior, in units of the prior's standard deviation."""
    information = moments.weighted(weights / times)[:-1, :-1]
    root = np.linalg.cholesky(np.linalg.inv(prior.precision))
    values, vectors = symmetric_eigen(root.T @ information @ root)
    return vectors[:, values < 1].T
