"""The friction ladder: which terms each axle gets, decided by held-out error.

Every axle starts with the paper's three terms, the transition speed of its smooth sign learned from a grid and
refined. Further terms come one at a time per axle, where leaving folds out shows that they predict better: by at least
2 % of the joint's squared error, and by more than the scatter of that gain between folds.

Trying a column is cheap: with A the normal matrix of the terms taken, the candidate c changes the estimate along
d = [-A⁻¹ a_c, 1] only, and the held-out error is a parabola in that step.
"""

from __future__ import annotations

import numpy as np

from agent.estimation.blocks import Partition
from agent.estimation.friction_terms import FrictionTerm
from agent.estimation.least_squares import iterate_weights, solve
from agent.estimation.moments import Moments, collect
from agent.estimation.observation import Observation
from agent.estimation.prior import Prior, physical_prior

_TRANSITIONS = (0.0, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 3e-2)  # of the highest speed of the axle
_FADINGS = (3e-3, 1e-2, 3e-2, 0.1, 0.3)  # likewise
_LEAST_GAIN = 0.02


def paper_terms(transitions: np.ndarray) -> tuple[FrictionTerm, ...]:
    """The seed paper's three terms for every axle; transition speeds (n,) [rad/s]."""
    return tuple(
        term
        for axle, transition in enumerate(transitions)
        for term in (
            FrictionTerm(axle, "coulomb", (float(transition),)),
            FrictionTerm(axle, "viscous"),
            FrictionTerm(axle, "quadratic"),
        )
    )


def select_terms(observation: Observation, partition: Partition, trust: float) -> tuple[FrictionTerm, ...]:
    """Climb the ladder."""
    n = observation.robot.dof
    coupling = observation.robot.coupling
    fastest = np.max([np.abs(s.motion.qd @ coupling.T).max(axis=0) for s in observation.stretches], axis=0)
    fastest = np.maximum(fastest, 1e-6 * observation.robot.max_velocity)
    transitions = fastest * 1e-3
    grids = [fastest[axle] * np.array(_TRANSITIONS) for axle in range(n)]
    transitions = _learn_transitions(observation, partition, grids, transitions, trust)
    finer = [
        np.unique([t, *(t * np.array([0.6, 0.8, 1.25, 1.6]) if t > 0 else f * np.array([5e-5, 1e-4]))])
        for t, f in zip(transitions, fastest, strict=True)
    ]
    transitions = _learn_transitions(observation, partition, finer, transitions, trust)

    terms = paper_terms(transitions)
    candidates = [term for axle in range(n) for term in _candidates(axle, transitions[axle], fastest[axle])]
    everything = (*terms, *candidates)
    prior = physical_prior(observation, everything)
    base = observation.rigid.count
    taken = np.arange(base + len(terms))
    first = collect(observation, partition, terms)
    weights = iterate_weights(first, _select(prior, taken), trust)
    rigid = solve(first, weights, _select(prior, taken), trust)[:base]
    moments = collect(observation, partition, everything, rigid)
    axles = np.array([-1] * base + [term.axle for term in everything])
    kinds = np.array([""] * base + [term.name for term in everything])
    taken = _climb(moments, partition, prior, weights, trust, taken, axles, kinds)
    chosen = [everything[k - base] for k in sorted(taken) if k >= base]
    return tuple(sorted(chosen, key=lambda term: term.axle))


def _candidates(axle: int, transition: float, fastest: float) -> list[FrictionTerm]:
    return [
        FrictionTerm(axle, "offset"),
        FrictionTerm(axle, "viscous_asymmetry"),
        FrictionTerm(axle, "coulomb_asymmetry", (float(transition),)),
        FrictionTerm(axle, "load", (float(transition),)),
        *(FrictionTerm(axle, "stribeck", (float(transition), float(fastest * f))) for f in _FADINGS),
    ]


def _select(prior: Prior, chosen: np.ndarray) -> Prior:
    """Friction terms are independent of all else in the prior, so leaving some out is dropping rows."""
    return Prior(prior.mean[chosen], prior.precision[np.ix_(chosen, chosen)])


def _learn_transitions(
    observation: Observation,
    partition: Partition,
    grids: list[np.ndarray],
    start: np.ndarray,
    trust: float,
) -> np.ndarray:
    """(n,) transition speeds from grids, by the residual they leave, axle after axle, two rounds."""
    terms = tuple(
        term
        for axle, grid in enumerate(grids)
        for term in (
            FrictionTerm(axle, "viscous"),
            FrictionTerm(axle, "quadratic"),
            *(FrictionTerm(axle, "coulomb", (float(value),)) for value in grid),
        )
    )
    base = observation.rigid.count
    prior = physical_prior(observation, terms)
    moments = collect(observation, partition, terms)
    choice = {
        axle: base + k
        for axle, value in enumerate(start)
        for k, term in enumerate(terms)
        if term.axle == axle
        and term.form == "coulomb"
        and term.constants[0] == grids[axle][np.argmin(np.abs(grids[axle] - value))]
    }
    fixed = [*range(base), *(base + k for k, term in enumerate(terms) if term.form != "coulomb")]
    taken = np.array([*fixed, *choice.values()])
    weights = iterate_weights(moments.select(taken), _select(prior, taken), trust)
    total = moments.weighted(weights)
    for _ in range(2):
        for axle in choice:
            others = np.array([*fixed, *(k for a, k in choice.items() if a != axle)])
            options = np.array(
                [base + k for k, term in enumerate(terms) if term.axle == axle and term.form == "coulomb"]
            )
            error = _trial(total, total, prior, trust, others, options)[1]
            choice[axle] = int(options[np.argmin(error)])
    return np.array([terms[choice[axle] - base].constants[0] for axle in range(len(grids))])


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
