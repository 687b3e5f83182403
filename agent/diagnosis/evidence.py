"""What forms gain where there is nothing to gain, and the smallest effect that stands out against it.

The background is the model's own error. It is no noise: it follows the motion, comes back with every cycle, and is
correlated over whole moves. So its signs are drawn anew for segments of a second of the motion, the same for all
cycles of it: size, correlation and repetition stay, and any correlation with an effect is chance (wild bootstrap: Liu,
Annals of Statistics 16, 1988; by blocks: Shao, J. American Statistical Association 105, 2010). Every form is then
fitted and scored out of fold as on the real residual. The highest gain of all forms in all places, over all values of
their nonlinear parameters, is one draw. So its 99 % point holds for the whole search, and for parameters that mean
nothing where the effect is absent: a delay, a gap, the speed of a Stribeck curve (Davies, Biometrika 74, 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.core import symmetric_eigen
from agent.diagnosis.candidate import Candidate
from agent.diagnosis.fit import Fit
from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.diagnosis.stacked import forms, side_by_side

_AT_ONCE = 50  # candidates whose sums are worked out together: their rows take as much memory as the columns


@dataclass(frozen=True, eq=False)
class Null:
    """Gains Σ e² / σ² under drawn signs: `highest` (draws,) of all candidates, `own` (draws,) of each.

    An effect of `size` practical sizes changes a candidate's gain by cross (draws,) · size + square · size².
    """

    highest: np.ndarray
    own: dict[Candidate, np.ndarray]
    cross: dict[Candidate, np.ndarray]
    square: dict[Candidate, float]
    limits: DecisionLimits = LIMITS

    @property
    def threshold(self) -> float:
        """Gain that the search as a whole exceeds in one of a hundred cases where there is nothing."""
        return float(np.quantile(self.highest, 1 - self.limits.false_alarms))

    def p_value(self, gain: float) -> float:
        """Share of draws in which anything anywhere gains as much, at least 1 / (draws + 1)."""
        return float((1 + np.sum(self.highest >= gain)) / (len(self.highest) + 1))

    def minimum_detectable_size(self, candidate: Candidate, threshold: float) -> float:
        """Size, in practical sizes, from which on a share `power` of the draws gain more than a threshold."""
        a, b, c = self.square[candidate], self.cross[candidate], self.own[candidate] - threshold
        if a <= 0:
            return float("inf")
        return float(np.quantile((-b + np.sqrt(np.maximum(b * b - 4 * a * c, 0))) / (2 * a), self.limits.power))


def null_gains(
    fit: Fit, candidates: Sequence[Candidate], limits: DecisionLimits = LIMITS, beside: Fit | None = None
) -> Null:
    """Gains of candidates on the background of a fit without effects; those that happen once are left out.

    `beside`: the fit with effects that are known, whose error is the background instead.

    With X, Z the columns of model and candidate, R = H⁻¹ XᵀZ and Z̃ = Z − X R what the model cannot follow, an error e
    of the model alone becomes e − Z̃ β on rows held out, which gains 2 βᵀ Z̃ᵀe − βᵀ Z̃ᵀZ̃ β. All of it is linear or
    quadratic in sums over blocks of rows, so a draw costs their signs only.
    """
    wanted = [c for c in candidates if not c.once]
    if not wanted:
        return Null(np.zeros(limits.draws), {}, {}, {}, limits)
    ends = np.cumsum([0, *(len(c.names) for c in wanted)])
    spans = dict(zip(wanted, (slice(a, b) for a, b in pairwise(ends)), strict=True))
    unit, fold_of, block_of = _units(fit)
    background = _background(fit if beside is None else beside)
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (limits.draws, int(block_of.max()) + 1))[:, block_of]
    model, effects = np.zeros((len(fold_of), fit.size)), np.zeros((len(fold_of), int(ends[-1])))
    for joint, (rows, index) in enumerate(zip(fit.rows, fit.index, strict=True)):
        target = background[:, joint, None]
        model[:, index] += _sums(fit.rests.whitened(joint, rows[:, :-1]) * target, unit)
        here = [c for c in wanted if joint in c.blocks]
        for some in (here[first : first + _AT_ONCE] for first in range(0, len(here), _AT_ONCE)):
            places = np.concatenate([np.arange(ends[-1])[spans[c]] for c in some])
            blocks = fit.rests.whitened(joint, np.hstack([c.blocks[joint] for c in some]))
            effects[:, places] += _sums(blocks * target, unit)
    moments = list(fit.moments(wanted))
    together = np.concatenate([both[:, :-1] for _, (both, _) in moments], axis=2)  # (cells, p, all parameters)
    groups = []
    for numbers, _, alone in side_by_side(moments):
        alike = [wanted[k] for k in numbers]
        ridge = fit.ridges(alike, np.diagonal(alone.sum(axis=1), axis1=1, axis2=2))
        direction = np.stack([practical_parameters(fit, c) for c in alike])
        groups.append((numbers, np.array([np.arange(ends[k], ends[k + 1]) for k in numbers]), alone, ridge, direction))
    own, cross = np.zeros((2, len(wanted), limits.draws))
    square = np.zeros(len(wanted))
    for number, fold in enumerate(fit.folds):
        test, train = fold_of == number, fold_of != number
        x_test, x_train = signs[:, test] @ model[test], signs[:, train] @ model[train] / fit.repeat
        z_test, z_train = signs[:, test] @ effects[test], signs[:, train] @ effects[train] / fit.repeat
        inverse = fit.solve(fold.train)[0]
        change = x_train @ inverse
        gram = fit.gram[fold.test].sum(axis=0)[:-1, :-1]
        x_z, x_z_test = together[fold.train].sum(axis=0) / fit.repeat, together[fold.test].sum(axis=0)
        follows = inverse @ x_z
        beyond = x_z_test - gram @ follows
        side = z_train - x_train @ follows
        slope = 2 * (z_test - x_test @ follows - change @ beyond)
        for numbers, places, alone, ridge, direction in groups:
            with_model, with_model_test, past = (part.T[places] for part in (x_z, x_z_test, beyond))  # (N, k, p)
            followed = np.swapaxes(follows.T[places], 1, 2)
            schur = alone[:, fold.train].sum(axis=1) / fit.repeat - with_model @ followed + ridge
            values, slopes = np.linalg.solve(schur, side.T[places]), slope.T[places]  # (N, k, draws)
            energy = alone[:, fold.test].sum(axis=1) - np.swapaxes(with_model_test @ followed, 1, 2) - past @ followed
            own[numbers] += np.sum(values * (slopes - np.swapaxes(energy, 1, 2) @ values), axis=1)
            cross[numbers] += (direction[:, None] @ slopes)[:, 0]
            square[numbers] += forms(direction, energy, direction)
    of_own, of_cross, of_square = (dict(zip(wanted, values, strict=True)) for values in (own, cross, square.tolist()))
    return Null(own.max(axis=0), of_own, of_cross, of_square, limits)


def drawn_change(fit: Fit, train: np.ndarray, error: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(size,) what parameters fitted to the cells `train` may be wrong by: an error (S', n) over σ, zero on other rows,
    gets new signs for every segment of the motion, and the prior is drawn."""
    count, base = int(fit.block.max()) + 1, len(fit.precision)
    signs = rng.choice((-1.0, 1.0), count)[fit.block]
    side = np.zeros(fit.size)
    ends = base + np.cumsum([0, *(len(c.names) for c in fit.chosen)])
    for joint, (rows, index) in enumerate(zip(fit.rows, fit.index, strict=True)):
        drawn = fit.rests.whitened(joint, signs * error[:, joint])
        drawn = fit.rests.whitened(joint, drawn)  # once for the error and once for the columns
        side[index] += drawn @ rows[:, :-1]
        for candidate, (a, b) in zip(fit.chosen, pairwise(ends), strict=True):
            if joint in candidate.blocks:
                side[a:b] += drawn @ candidate.blocks[joint]
    deviation = np.sqrt(np.maximum(fit.prior.diagonal(), 1e-300))
    values, vectors = symmetric_eigen(fit.prior / np.outer(deviation, deviation))
    prior = deviation * (vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(fit.size)))
    return fit.solve(train)[0] @ (side / fit.repeat + prior)


def _units(fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(S',) unit of every row, and of each unit its fold and its block; rows in no fold get unit -1."""
    fold = np.full(len(fit.cell), -1)
    for number, entry in enumerate(fit.folds):
        fold[np.isin(fit.cell, np.flatnonzero(entry.test))] = number
    blocks = int(fit.block.max()) + 1
    found, unit = np.unique(np.where(fold < 0, -1, fold * blocks + fit.block), return_inverse=True)
    outside = int(found[0] < 0)
    return unit - outside, found[outside:] // blocks, found[outside:] % blocks


def _sums(rows: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """(U, k) sums of rows (S', k) over each unit."""
    order = np.argsort(unit, kind="stable")
    order = order[unit[order] >= 0]
    starts = np.flatnonzero(np.diff(unit[order], prepend=-1))
    return np.add.reduceat(rows[order], starts, axis=0)


def _background(fit: Fit) -> np.ndarray:
    """(S', n) held-out error over σ; where a gap is to be explained, scaled down to what a model usually gets wrong."""
    error = fit.rests.whitened_all(np.nan_to_num(fit.out_of_fold() / fit.sigma))
    size = np.sqrt(np.mean(error**2, axis=0))
    return error / np.maximum(size, 1.0)


def share_intervals(rows: np.ndarray, floor: np.ndarray, block: np.ndarray, confidence: float = 0.9) -> np.ndarray:
    """(n, 2) interval of each joint's share of Σ (B² − F²): blocks of the errors (S', n) drawn with replacement."""
    good = ~np.isnan(rows[:, 0])
    found, unit = np.unique(block[good], return_inverse=True)
    energy = _sums(rows[good] ** 2, unit)
    count = np.bincount(unit)
    drawn = np.random.default_rng(0).integers(len(found), size=(LIMITS.draws, len(found)))
    excess = np.maximum(energy[drawn].sum(axis=1) / count[drawn].sum(axis=1)[:, None] - floor**2, 0)
    share = excess / np.maximum(excess.sum(axis=1, keepdims=True), 1e-300)
    tail = 0.5 * (1 - confidence)
    return np.quantile(share, (tail, 1 - tail), axis=0).T


def practical_parameters(fit: Fit, candidate: Candidate) -> np.ndarray:
    """(k,) parameters at which the effect has its practical size and the model can follow it least."""
    (_, (cross, own)), *_ = fit.moments([candidate])
    b, a = cross.sum(axis=0)[:-1] / fit.repeat, own.sum(axis=0) / fit.repeat
    schur = a - b.T @ fit.solve(np.ones(fit.cells, dtype=bool))[0] @ b
    torque = np.zeros_like(a)
    for joint, block in candidate.blocks.items():
        part = block * (fit.sigma[:, joint, None] / fit.reference.scale[joint])
        torque += part.T @ part / len(part)
    size = np.sqrt(np.maximum(np.diag(torque), 1e-300))
    scaled = torque / np.outer(size, size) + 1e-9 * np.eye(len(size))
    half = np.linalg.inv(np.linalg.cholesky(scaled))
    vector = half.T @ symmetric_eigen(half @ (schur / np.outer(size, size)) @ half.T)[1][:, -1]
    return candidate.effect.practical * vector / np.sqrt(vector @ scaled @ vector) / size
