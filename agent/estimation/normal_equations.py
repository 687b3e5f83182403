"""Second moments of regressor and torque: all that weighting, cross-validation and resampling need of the data.

For Z = [X y], the sums Zᵀ Z are additive over rows: fitting without a fold, under other weights or with fewer columns
is arithmetic on small matrices, whatever the length of the logs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from agent.core import symmetric_eigen
from agent.estimation.partition import Partition
from agent.estimation.prior import Prior
from agent.estimation.signals.observation import Observation
from agent.model import FrictionTerm, standstill_speed

_SURELY_SLIDES = 0.005  # of the highest speed: more than where a diagnosis leaves the torque open

Cells = np.ndarray | slice
ALL_CELLS = slice(None)


@dataclass(frozen=True, eq=False)
class Moments:
    """Of p parameters on n joints. Weights and energies are (2, n): a joint's rows while it moves, then at standstill.

    index[i] (c_i,): which parameters act on joint i; sums[i] (cells, 2, c_i + 1, c_i + 1): Zᵀ Z of its rows;
    rows (cells, 2, n): their number.
    """

    parameters: int
    index: tuple[np.ndarray, ...]
    sums: tuple[np.ndarray, ...]
    rows: np.ndarray
    _totals: dict[tuple[int, bytes], np.ndarray] = field(default_factory=dict)

    def weighted(self, weights: np.ndarray, cells: Cells = ALL_CELLS) -> np.ndarray:
        """(p + 1, p + 1): sum over cells and rows, the last row and column are the torque's."""
        total = np.zeros((self.parameters + 1, self.parameters + 1))
        for joint, index in enumerate(self.index):
            columns = np.append(index, self.parameters)
            moving, still = self._over(joint, cells)
            total[columns[:, None], columns] += weights[0, joint] * moving + weights[1, joint] * still
        return total

    def _over(self, joint: int, cells: Cells) -> np.ndarray:
        """(2, c_i + 1, c_i + 1) sum over cells; the same few sums are asked for again and again."""
        key = joint, b"" if isinstance(cells, slice) else cells.tobytes()
        if key not in self._totals:
            self._totals[key] = self.sums[joint][cells].sum(axis=0)
        return self._totals[key]

    def energy(self, parameters: np.ndarray, cells: Cells = ALL_CELLS) -> np.ndarray:
        """(2, n) squared residual left by parameters (p,), not below the round-off of this difference."""
        energy = np.empty((2, len(self.index)))
        for joint, index in enumerate(self.index):
            extended = np.append(parameters[index], -1.0)
            total = self._over(joint, cells)
            energy[:, joint] = np.maximum(total @ extended @ extended, 1e-15 * total[:, -1, -1])
        return energy

    def torque_energy(self) -> np.ndarray:
        """(2, n) squared measured torque."""
        return np.stack([self._over(joint, ALL_CELLS)[:, -1, -1] for joint in range(len(self.sums))], axis=1)

    def select(self, chosen: np.ndarray) -> Moments:
        """The moments of some of the parameters, in the order given."""
        position = np.full(self.parameters, -1)
        position[chosen] = np.arange(len(chosen))
        index, sums, places = [], [], []
        for old, old_sums in zip(self.index, self.sums, strict=True):
            keep = np.flatnonzero(position[old] >= 0)
            keep = keep[np.argsort(position[old[keep]])]
            columns = np.append(keep, len(old))
            index.append(position[old[keep]])
            places.append((slice(None), columns[:, None], columns))
            sums.append(old_sums[:, *places[-1]])
        known = {(joint, cells): total[places[joint]] for (joint, cells), total in self._totals.items()}
        return Moments(len(chosen), tuple(index), tuple(sums), self.rows, known)


def collect_moments(
    observation: Observation,
    partition: Partition,
    terms: tuple[FrictionTerm, ...],
    friction: Iterable[np.ndarray],
    trusted: Sequence[np.ndarray] | None = None,
) -> Moments:
    """Moments of the base parameters and these terms, whose columns `friction` (S', T) gives segment by segment.

    `trusted`, per segment (S', n), weights single rows between 0 and 1.
    """
    n = observation.robot.dof
    cells = len(partition.cluster)
    index: list[np.ndarray] = []
    sums: list[np.ndarray] = []
    rows = np.zeros((cells, 2, n), dtype=int)
    still = standstill(observation)
    for number, (segment, columns) in enumerate(zip(observation.segments, friction, strict=True)):
        labels, stopped, held = partition.labels[number], still[number], segment.held
        for joint, (acting, block) in enumerate(observation.joint_rows(segment, terms, columns)):
            if len(sums) == joint:
                index.append(acting)
                sums.append(np.zeros((cells, 2, block.shape[1], block.shape[1])))
            if trusted is not None:
                block *= np.sqrt(trusted[number][:, joint, None])
            keys = 2 * labels + stopped[:, joint]
            edges = [0, *(np.flatnonzero(np.diff(keys)) + 1).tolist(), len(keys)]
            for first, stop in pairwise(edges):
                cell, group = divmod(int(keys[first]), 2)
                sums[joint][cell, group] += block[first:stop].T @ block[first:stop]
                rows[cell, group, joint] += stop - first - np.count_nonzero(held[first:stop, joint])
    return Moments(observation.rigid.count + len(terms), tuple(index), tuple(sums), rows)


def standstill(observation: Observation) -> list[np.ndarray]:
    """Per segment (S', n) bool: where a joint stands still, so that its friction is anything within stiction.

    Not where it is held: these rows have a share that makes them comparable to those of the sliding joint.
    """
    slowest = observed_standstill_speed(observation)
    return [(np.abs(segment.speed) <= slowest) & ~segment.held for segment in observation.segments]


def observed_standstill_speed(observation: Observation) -> np.ndarray:
    """Speed (n,) [rad/s] up to which a joint counts as stationary: friction is fitted only to sliding joints."""
    speeds = [segment.speed for segment in observation.segments]
    return standstill_speed(speeds, observation.robot.max_velocity, _SURELY_SLIDES)


_RANK = 1e-12  # eigenvalue of a scaled normal matrix, relative: a singular value of 1e-6
CERTAIN = 2.0  # standard errors, of a gain that decides


def solve_sum(total: np.ndarray, prior: Prior, prior_weight: float) -> np.ndarray:
    """(p,) estimate from a weighted sum of moments (p + 1, p + 1), with the prior's precision times `prior_weight`."""
    matrix = total[:-1, :-1] + prior_weight * prior.precision
    right = total[:-1, -1] + prior_weight * prior.precision @ prior.mean
    return solve_scaled(matrix, right)


def log_evidence(total: np.ndarray, prior: Prior, prior_weight: float) -> float:
    """Logarithm of the probability of the torques under a prior, up to a constant that all priors share.

    Of N(y; X θ, 1/w), rows counting 1/k each, and θ from N(θ₀, Λ⁻¹): -½ (r² / k + |θ̂ - θ₀|²_Λ + ln |A/k + Λ| - ln |Λ|).
    """
    estimate = solve_sum(total, prior, prior_weight)
    extended, deviation = np.append(estimate, -1.0), estimate - prior.mean
    scale = 1 / np.sqrt(np.diag(prior.precision))
    before = prior.precision * np.outer(scale, scale)
    after = before + total[:-1, :-1] * np.outer(scale, scale) / prior_weight
    misfit = extended @ total @ extended / prior_weight + deviation @ prior.precision @ deviation
    return float(-0.5 * (misfit + np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]))


def solve_scaled(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(…, p) solutions of positive definite systems (…, p, p) whose unknowns have units of their own."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    unscaled = np.linalg.solve(matrix * (scale[..., :, None] * scale[..., None, :]), (scale * right)[..., None])
    return scale * unscaled[..., 0]


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a matrix whose unknowns have units of their own."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)


def pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse on what a normal matrix determines, zero on the rest; its unknowns have units of their own."""
    scale, values, vectors = _determined(matrix)
    return (vectors / values) @ vectors.T * np.outer(scale, scale)


def scaled_rank(matrix: np.ndarray) -> int:
    """How many directions of its unknowns a normal matrix determines."""
    return len(_determined(matrix)[1])


def _determined(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale (p,) of the unknowns, eigenvalues (r,) and vectors (p, r) of the scaled matrix in what it determines."""
    diagonal = np.diag(matrix)
    scale = np.where(diagonal > _RANK**2 * diagonal.max(), 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    values, vectors = symmetric_eigen(matrix * np.outer(scale, scale))
    determined = values > _RANK * values[-1]
    return scale, values[determined], vectors[:, determined]


def reweight(moments: Moments, parameters: np.ndarray) -> np.ndarray:
    """(2, n) inverse residual variance of each group at parameters (p,).

    A joint whose torque is always exactly zero is held by its brake, and its rows say nothing.
    """
    rows = moments.rows.sum(axis=0)
    energy = moments.energy(parameters)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = energy / rows
    moving = np.where(rows[0] > 0, variance[0], variance[1])
    still = np.where(rows[1] > 0, np.maximum(variance[1], moving), moving)
    mean = moments.torque_energy().sum() / rows.sum()
    floor = 1e-30 + np.where(moments.torque_energy().sum(axis=0) > 0, 1e-20, 1e12) * mean
    return 1 / np.maximum(np.stack([moving, still]), floor)


def autocorrelation_time(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """(n,) samples per independent one, at least 1, of residuals given segment by segment (S', n).

    1 + 2 Σ ρ_k up to where the sum of two neighbours turns negative (Geyer, Statistical Science 7, 1992).
    """
    n = residuals[0].shape[1]
    longest = max(len(part) for part in residuals)
    covariance = np.zeros((longest, n))
    for part in residuals:
        size = len(part)
        spectrum = np.abs(np.fft.rfft(part - part.mean(axis=0), 2 * size, axis=0)) ** 2
        covariance[:size] += np.fft.irfft(spectrum, axis=0)[:size]
    rho = covariance / np.maximum(covariance[0], 1e-300)
    pairs = rho[1:-1:2] + rho[2::2]
    positive = np.logical_and.accumulate(pairs > 0, axis=0)
    return np.asarray(1 + 2 * np.sum(pairs, axis=0, where=positive))


def clear_gain(gains: np.ndarray) -> np.ndarray | bool:
    """Whether gains (folds, …) add up to more than they scatter between folds."""
    return gains.sum(axis=0) > gains.std(axis=0, ddof=1) * np.sqrt(len(gains))


def predicts_better(before: np.ndarray, after: np.ndarray, weights: np.ndarray, least: float) -> bool:
    """Whether squared errors (folds, 2, n) fall clearly with the joints' weights (2, n), and do not rise without them.

    Weights are from residuals of a fit: a joint that more terms fit closely would outweigh all that they spoil.
    """
    was, now = (np.sum(weights * each, axis=(1, 2)) for each in (before, after))
    return clearly_better(was, now, least) and float(after.sum()) <= float(before.sum())


def clearly_better(before: np.ndarray, after: np.ndarray, least: float) -> bool:
    """Whether squared errors (folds,) fall by a share of `least`, geometric mean, and by two of its standard errors.

    In pairs and by their ratio, so that one fold in which all is bad does not decide, nor hide what the others say.
    """
    known = (before > 0) & (after > 0)
    if np.count_nonzero(known) < 2:
        return False
    gain = np.log(before[known] / after[known])
    return bool(gain.mean() > max(-np.log1p(-least), CERTAIN * gain.std(ddof=1) / np.sqrt(len(gain))))
