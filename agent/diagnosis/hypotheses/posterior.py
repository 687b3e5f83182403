"""From log evidence to posterior probabilities, and to classes of what cannot be distinguished.

- The posterior of a hypothesis is its evidence times a prior: none or some, which effect on which joint, how many, and
  which of them are faults: the healthy arm may have more than usual of what it has already.
- Hypotheses that differ by effects too small to matter say the same; the likeliest statement is taken.
- The class of a cause is what replaces it in other hypotheses with a tenth of its probability or more, and what
  equals it by definition and explains about as much.

Whether causes are named is decided in `agent.diagnosis.verdict`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import compress, product

import numpy as np
from scipy.special import gammaln

from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.score import EvaluatedHypothesis
from agent.diagnosis.hypotheses.selected_causes import Hypothesis, SelectedCauses, share_joints
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import EffectKey
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE

_LISTED = 100  # numerical: hypotheses that a finding keeps
_RIVALS = 2  # that a class lists next to its cause

#: Log likelihood of something else that was observed, given a hypothesis.
Observed = Callable[[Evidence, EvaluatedHypothesis], float]


def compare(
    fit: Fit,
    evidence: Evidence,
    evaluated: Sequence[EvaluatedHypothesis],
    observed: Observed | None = None,
    ignored: Collection[str] = (),
) -> SelectedCauses:
    """Return the likeliest causes with their classes, largest first, and all hypotheses that were evaluated.

    `fit` is the one without effects; `observed` counts with the evidence of the logs; effects that were `ignored` are
    in no hypothesis.
    """
    hypotheses = posterior(evidence, evaluated, observed)
    statements = _statements(hypotheses)
    statement = max(statements, key=lambda names: round(statements[names], 2))  # first: fewest parameterisations
    leader, (faults, _) = max(hypotheses, key=lambda h: _shares(h).get(statement, 0.0)), statement
    plain = next(h for h in hypotheses if not h.effects and not h.uncatalogued_joints)
    size = dict(zip(leader.effect_keys, leader.largest_torque, strict=True))
    effect_keys = sorted(faults, key=lambda key: (-size[key], key))
    causes = tuple(next(c for c in leader.effects if c.key == key) for key in effect_keys)
    equal = [_equal_by_definition(key, leader, hypotheses) for key in effect_keys]
    classes = [_class_of(key, faults, statements, names) for key, names in zip(effect_keys, equal, strict=True)]
    return SelectedCauses(
        fit,
        fit.with_chosen(causes) if causes else fit,
        causes,
        tuple(rivals for rivals, _ in classes),
        tuple(probability for _, probability in classes),
        leader.explained_share,
        tuple({id(h): h for h in (*hypotheses[:_LISTED], plain)}.values()),
        evidence,
        statements[frozenset(), frozenset()],
        frozenset(ignored),
    )


def posterior(
    evidence: Evidence, evaluated: Sequence[EvaluatedHypothesis], observed: Observed | None = None
) -> list[Hypothesis]:
    """Return hypotheses with their probabilities, likeliest first."""
    nothing = evidence.null_hypothesis
    log = np.array([e.log_evidence for e in evaluated])
    alone = nothing.log_evidence
    if observed is not None:
        log += [observed(evidence, e) for e in evaluated]
        alone += observed(evidence, nothing)
    priors = [_priors(evidence, e) for e in evaluated]
    highest = max(log_evidence + max(prior.values()) for log_evidence, prior in zip(log, priors, strict=True))
    weights = [
        {faults: float(np.exp(log_evidence + prior - highest)) for faults, prior in each.items()}
        for log_evidence, each in zip(log, priors, strict=True)
    ]
    total = sum(sum(each.values()) for each in weights)
    before = max(float(nothing.unexplained.sum()), 1e-12)
    hypotheses = [
        Hypothesis(
            tuple(evidence.pool.candidate(k) for k in e.effects),
            tuple(sorted(e.uncatalogued_sizes)),
            float(factor),
            {faults: weight / total for faults, weight in each.items()},
            e.largest_torque,
            1 - float(e.unexplained.sum()) / before,
            float(e.scales.max()),
        )
        for e, factor, each in zip(evaluated, log - alone, weights, strict=True)
    ]
    # of equals the effect that has fewer parameterisations to choose from
    choices = evidence.pool.count_parameterisations
    return sorted(hypotheses, key=lambda h: (-round(h.probability, 6), sum(map(choices, h.effect_keys))))


def _priors(evidence: Evidence, hypothesis: EvaluatedHypothesis) -> dict[frozenset[EffectKey], float]:
    """Log prior over no fault's, as likely as some, by which effects are faults; others are more than usual."""
    priors = {}
    effect_keys = [evidence.pool.candidate(k).key for k in hypothesis.effects]
    sizes = zip(effect_keys, hypothesis.largest_torque, strict=True)
    healthy = [
        _log_healthy(size, evidence.usual.get(key), evidence.distance_from_baseline(hypothesis, k))
        for k, (key, size) in enumerate(sizes)
    ]
    each = float(np.log((1 - LAW.unlikely) / len(CATALOGUE)))
    for faulty in product((True, False), repeat=len(effect_keys)):
        faults = frozenset(compress(effect_keys, faulty))
        log = sum(h for h, fault in zip(healthy, faulty, strict=True) if not fault)
        log += sum(each - (np.log(evidence.dof) if joints else 0.0) for _, joints in sorted(faults))
        log += len(hypothesis.uncatalogued_sizes) * np.log(LAW.unlikely / evidence.dof)
        log += max(len(faults) + len(hypothesis.uncatalogued_sizes) - 1, 0) * np.log(LAW.unlikely)
        if np.isfinite(log):
            priors[faults] = float(log)
    return priors


def _log_healthy(size: float, usual: float | None, apart: tuple[float, float] | None) -> float:
    """Log density of a torque of a healthy arm over that of a fault as large, which is normal with this size.

    Few logs tell what is usual: Student's t, less the normal density that the noise model has. `apart` is how far the
    effect is from the baseline's, and the standard deviation of that: a healthy arm has what it had.
    """
    if not usual:
        return -np.inf
    scale = usual * np.sqrt((LAW.nu - 2) / LAW.nu)
    density = _student(size / scale, LAW.nu) / scale - _normal(size / usual) / usual
    if apart is not None and apart[1] > 0:
        density = max(density, _normal(apart[0] / apart[1]) / apart[1])
    return float(np.log(density * size / _normal(1.0))) if density > 0 else -np.inf


def _normal(x: float) -> float:
    return float(np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi))


def _student(x: float, nu: float) -> float:
    """Density of Student's t. `scipy.stats` has it, and takes a third of a second to import."""
    log = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi)
    return float(np.exp(log - (nu + 1) / 2 * np.log1p(x**2 / nu)))


#: Effects that are faults and large enough to matter, and joints with something else.
Statement = tuple[frozenset[EffectKey], frozenset[int]]


def _shares(hypothesis: Hypothesis) -> dict[Statement, float]:
    """Probability of a hypothesis by statement."""
    large = {
        p
        for p, torque in zip(hypothesis.effect_keys, hypothesis.largest_torque, strict=True)
        if torque >= LAW.least_named_torque
    }
    shares: dict[Statement, float] = {}
    for faults, share in hypothesis.shares.items():
        statement = faults & large, frozenset(hypothesis.uncatalogued_joints)
        shares[statement] = shares.get(statement, 0.0) + share
    return shares


def _statements(hypotheses: Sequence[Hypothesis]) -> dict[Statement, float]:
    """Probability of every statement."""
    statements: dict[Statement, float] = {}
    for hypothesis in hypotheses:
        for statement, share in _shares(hypothesis).items():
            statements[statement] = statements.get(statement, 0.0) + share
    return statements


def _equal_by_definition(key: EffectKey, leader: Hypothesis, hypotheses: Sequence[Hypothesis]) -> tuple[EffectKey, ...]:
    """Hypotheses that equal a cause by definition unless the logs show otherwise, and explain about as much."""
    equivalent = CATALOGUE[key[0]].structurally_equivalent
    as_much = (1 - LIMITS.negligible) * leader.log_bayes_factor
    equal = {
        other: None
        for hypothesis in hypotheses
        if hypothesis.log_bayes_factor >= as_much and key not in hypothesis.effect_keys
        for other in hypothesis.effect_keys
        if other[0] in equivalent and share_joints(key, other)
    }
    return tuple(equal)


def _class_of(
    key: EffectKey,
    faults: frozenset[EffectKey],
    statements: Mapping[Statement, float],
    equal: tuple[EffectKey, ...],
) -> tuple[tuple[EffectKey, ...], float]:
    """Hypotheses that these motions do not distinguish from a cause, and the probability of any of them."""
    with_cause = sum(share for (effect_keys, _), share in statements.items() if key in effect_keys)
    replacing: dict[EffectKey, float] = {}
    for (effect_keys, _), share in statements.items():
        for other in sorted(effect_keys - faults) if key not in effect_keys else ():
            replacing[other] = replacing.get(other, 0.0) + share
    least = LAW.unlikely * with_cause
    likely = [other for other, share in replacing.items() if share >= least and share_joints(key, other)]
    rivals = list(dict.fromkeys([*sorted(likely, key=lambda other: -replacing[other]), *equal]))[:_RIVALS]
    return tuple(rivals), LAW.confidence * min(1.0, with_cause + sum(replacing.get(other, 0.0) for other in rivals))
