"""The friction ladder: which terms each axle gets, decided by held-out error.

Every axle starts with the paper's three terms. How its sliding reverses is learned: from a grid of transition speeds
and of presliding travels, then from a finer one around the best. Further terms come one at a time per axle, where
leaving folds out shows that they predict better: by at least 2 % of the joint's squared error, and by more than the
scatter of that gain between folds.

Trying a column is cheap: with A the normal matrix of the terms taken, the candidate c changes the estimate along
d = [-A⁻¹ a_c, 1] only, and the held-out error is a parabola in that step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.blocks import Partition
from agent.estimation.friction_terms import FrictionTerm, Reversal
from agent.estimation.least_squares import iterate_weights, solve
from agent.estimation.moments import Moments, collect
from agent.estimation.observation import Observation
from agent.estimation.prior import Prior, physical_prior

_SPEEDS = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 3e-2)  # of the highest speed of the axle
_TRAVELS = (1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # of the range the axle moves over
_FADINGS = (3e-3, 1e-2, 3e-2, 0.1, 0.3)  # of the highest speed
_FINER = (0.55, 0.75, 1.0, 1.35, 1.8)
_LEAST_GAIN = 0.02


def paper_terms(reversals: Sequence[Reversal]) -> tuple[FrictionTerm, ...]:
    """The seed paper's three terms for every axle, with a reversal each."""
    return tuple(
        term
        for axle, reversal in enumerate(reversals)
        for term in (
            FrictionTerm(axle, "coulomb", reversal),
            FrictionTerm(axle, "viscous"),
            FrictionTerm(axle, "quadratic"),
        )
    )


def select_terms(observation: Observation, partition: Partition, trust: float) -> tuple[FrictionTerm, ...]:
    """Climb the ladder."""
    n = observation.robot.dof
    coupling = observation.robot.coupling
    motion = [stretch.motion for stretch in observation.stretches]
    fastest = np.max([np.abs(m.qd @ coupling.T).max(axis=0) for m in motion], axis=0)
    fastest = np.maximum(fastest, 1e-6 * observation.robot.max_velocity)
    path = np.concatenate([m.q @ coupling.T for m in motion])
    travelled = np.maximum(np.ptp(path, axis=0), 1e-6)
    grids = [
        [
            Reversal(),
            *(Reversal("speed", float(speed * fastest[axle])) for speed in _SPEEDS),
            *(Reversal("travel", float(travel * travelled[axle])) for travel in _TRAVELS),
        ]
        for axle in range(n)
    ]
    reversals = _learn_reversals(observation, partition, grids, trust)
    finer = [[Reversal(r.kind, r.scale * factor) for factor in _FINER] if r.scale else [r] for r in reversals]
    reversals = _learn_reversals(observation, partition, finer, trust)

    terms = paper_terms(reversals)
    candidates = [term for axle in range(n) for term in _candidates(axle, reversals[axle], float(fastest[axle]))]
    everything = (*terms, *candidates)
    prior = physical_prior(observation, everything)
    base = observation.rigid.count
    taken = np.arange(base + len(terms))
    first = collect(observation, partition, terms)
    weights = iterate_weights(first, prior.select(taken), trust)
    rigid = solve(first, weights, prior.select(taken), trust)[:base]
    moments = collect(observation, partition, everything, rigid)
    axles = np.array([-1] * base + [term.axle for term in everything])
    kinds = np.array([""] * base + [term.name for term in everything])
    taken = _climb(moments, partition, prior, weights, trust, taken, axles, kinds)
    chosen = [everything[k - base] for k in sorted(taken) if k >= base]
    return tuple(sorted(chosen, key=lambda term: term.axle))


def _candidates(axle: int, reversal: Reversal, fastest: float) -> list[FrictionTerm]:
    return [
        FrictionTerm(axle, "offset"),
        FrictionTerm(axle, "viscous_asymmetry"),
        FrictionTerm(axle, "load", reversal),
        *(FrictionTerm(axle, "stribeck", reversal, fastest * fading) for fading in _FADINGS),
    ]


def _learn_reversals(
    observation: Observation, partition: Partition, grids: list[list[Reversal]], trust: float
) -> list[Reversal]:
    """One reversal per axle from its grid, by the residual it leaves, axle after axle, two rounds."""
    terms = tuple(
        term
        for axle, grid in enumerate(grids)
        for term in (
            FrictionTerm(axle, "viscous"),
            FrictionTerm(axle, "quadratic"),
            *(FrictionTerm(axle, "coulomb", reversal) for reversal in grid),
        )
    )
    base = observation.rigid.count
    prior = physical_prior(observation, terms)
    moments = collect(observation, partition, terms)
    fixed = [*range(base), *(base + k for k, term in enumerate(terms) if term.form != "coulomb")]
    options = {
        axle: np.array([base + k for k, t in enumerate(terms) if t.axle == axle and t.form == "coulomb"])
        for axle in range(len(grids))
    }
    choice = {axle: int(found[len(found) // 3]) for axle, found in options.items()}
    for _ in range(2):
        taken = np.array([*fixed, *choice.values()])
        weights = iterate_weights(moments.select(taken), prior.select(taken), trust)
        total = moments.weighted(weights)
        for axle, found in options.items():
            others = np.array([*fixed, *(k for a, k in choice.items() if a != axle)])
            choice[axle] = int(found[np.argmin(_trial(total, total, prior, trust, others, found)[1])])
    return [terms[choice[axle] - base].reversal or Reversal() for axle in range(len(grids))]


def _trial(
    train: np.ndarray, test: np.ndarray, prior: Prior, trust: float, taken: np.ndarray, candidates: np.ndarray
) -> tuple[float, np.ndarray]:
    """Squared error on `test` of the taken columns fitted on `train`, and with each candidate (c,) besides."""
    matrix = train[:-1, :-1] + trust * prior.precision
    right = train[:-1, -1] + trust * prior.precision @ prior.mean
    scale = 1 / np.sqrt(np.diag(matrix))
    a = matrix[np.ix_(taken, taken)] * np.outer(scale[taken], scale[taken])
    b = np.column_stack([matrix[np.ix_(taken, candidates)], right[taken]]) * scale[taken][:, None]
    solved = scale[taken][:, None] * np.linalg.solve(a, b)
    along, fit = solved[:, :-1], solved[:, -1]
    curvature = matrix[candidates, candidates] - np.sum(matrix[np.ix_(taken, candidates)] * along, axis=0)
    slope = right[candidates] - matrix[np.ix_(candidates, taken)] @ fit
    step = slope / np.maximum(curvature, 1e-9 * matrix[candidates, candidates])

    residual = test[:, taken] @ fit - test[:, -1]  # gradient of half the error in every column, the torque's included
    error = fit @ residual[taken] - residual[-1]
    inner = test[np.ix_(taken, taken)] @ along
    bend = np.sum(along * inner, axis=0) - 2 * np.sum(along * test[np.ix_(taken, candidates)], axis=0)
    bend = bend + test[candidates, candidates]
    lean = residual[candidates] - residual[taken] @ along
    return float(error), error + 2 * step * lean + step**2 * bend


def _climb(
    moments: Moments,
    partition: Partition,
    prior: Prior,
    weights: np.ndarray,
    trust: float,
    taken: np.ndarray,
    axles: np.ndarray,
    kinds: np.ndarray,
) -> np.ndarray:
    """Add candidates (indices not in `taken`) while held-out error falls; one per axle and round, each form once."""
    folds = range(partition.folds)
    train = [moments.weighted(weights, partition.training(fold)) for fold in folds]
    test = [moments.weighted(weights, partition.fold == fold) for fold in folds]
    while True:
        present = set(kinds[taken])
        free = np.array([k for k in range(moments.parameters) if kinds[k] not in present])
        if len(free) == 0:
            return taken
        trials = [_trial(a, b, prior, trust, taken, free) for a, b in zip(train, test, strict=True)]
        gains = np.array([before - after for before, after in trials])
        mean = gains.sum(axis=0)
        scatter = gains.std(axis=0, ddof=1) * np.sqrt(len(gains))
        least = _LEAST_GAIN * sum(before for before, _ in trials) / (1 + axles.max())
        worth = (mean > least) & (mean > scatter)
        added = []
        for axle in np.unique(axles[free[worth]]):
            options = np.flatnonzero(worth & (axles[free] == axle))
            added.append(int(free[options[np.argmax(mean[options])]]))
        if not added:
            return taken
        taken = np.append(taken, added)
