"""From log evidence to a verdict: posterior probabilities, classes of what cannot be distinguished, least loss.

- The posterior of a hypothesis is its evidence times a prior: none or some, which effect on which joint, how many, and
  which of them are faults: the healthy arm may have more than usual of what it has already.
- Hypotheses that differ by effects too small to matter are one answer; the likeliest answer is taken.
- The class of a cause is what replaces it in other hypotheses with a tenth of its probability or more, and what
  equals it by definition and explains about as much.
- A class is named if a wrong name costs less than an abstention and the causes together explain what the noise model
  does not. Otherwise the verdict is `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import compress, product

import numpy as np
from scipy.stats import norm, t

from agent.diagnosis.hypotheses.evidence import Evaluated, Evidence
from agent.diagnosis.hypotheses.finding import Finding, Hypothesis, near
from agent.diagnosis.hypotheses.law import EvidenceLaw
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Where
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE

_LISTED = 100  # hypotheses that a finding keeps
_RIVALS = 2  # that a class lists next to its cause

#: Log likelihood of something else that was observed, given a hypothesis.
Observed = Callable[[Evidence, Evaluated], float]


def decide(fit: Fit, evidence: Evidence, found: Sequence[Evaluated], observed: Observed | None = None) -> Finding:
    """Return the verdict over the hypotheses that were evaluated.

    `fit` is the one without effects; `observed` counts with the evidence of the logs.
    """
    law = evidence.law
    hypotheses = posterior(evidence, found, observed)
    answers = _answers(hypotheses, law)
    names, free = max(answers, key=lambda one: round(answers[one], 6))
    leader = max(hypotheses, key=lambda h: _shares(h, law).get((names, free), 0.0))

    def finding(verdict: str, kept: Sequence[tuple[Where, tuple[Where, ...], float]] = ()) -> Finding:
        causes = tuple(next(c for c in leader.effects if c.place == place) for place, *_ in kept)
        return Finding(
            verdict,
            fit.with_chosen(causes) if causes else fit,
            causes,
            tuple(rivals for _, rivals, _ in kept),
            tuple(probability for *_, probability in kept),
            tuple({id(h): h for h in (*hypotheses[:_LISTED], plain)}.values()),
            evidence,
            healthy,
        )

    plain = next(h for h in hypotheses if not h.effects and not h.free)
    healthy = answers.get((frozenset(), frozenset()), 0.0)
    if plain.scale < law.exceeded and healthy > 1 - law.certain:
        return finding("no_gap")
    size = dict(zip(leader.places, leader.torque, strict=True))
    ordered = sorted(names, key=lambda place: -size[place])
    classes = [
        (place, *_class_of(place, names, answers, _equal_by_definition(place, leader, hypotheses, law), law))
        for place in ordered
    ]
    kept = [one for one in classes if one[2] >= law.sure]
    if not kept or leader.explained < LIMITS.explained:
        return finding("unknown")
    return finding("ambiguous" if kept[0][1] else "explained", kept)


def posterior(evidence: Evidence, found: Sequence[Evaluated], observed: Observed | None = None) -> list[Hypothesis]:
    """Return hypotheses with their probabilities, likeliest first."""
    nothing = evidence.nothing
    log = np.array([e.log for e in found])
    alone = nothing.log
    if observed is not None:
        log += [observed(evidence, e) for e in found]
        alone += observed(evidence, nothing)
    gains = log - alone
    priors = [_priors(evidence, e) for e in found]
    highest = max(one + max(prior.values()) for one, prior in zip(log, priors, strict=True))
    weights = [
        {faults: float(np.exp(one + prior - highest)) for faults, prior in each.items()}
        for one, each in zip(log, priors, strict=True)
    ]
    total = sum(sum(each.values()) for each in weights)
    before = max(float(nothing.left.sum()), 1e-12)
    hypotheses = [
        Hypothesis(
            tuple(evidence.pool.candidate(k) for k in e.effects),
            tuple(sorted(e.free)),
            float(gain),
            {faults: weight / total for faults, weight in each.items()},
            e.largest,
            1 - float(e.left.sum()) / before,
            float(e.scales.max()),
        )
        for e, gain, each in zip(found, gains, weights, strict=True)
    ]
    # of equals the effect that has fewer forms to choose from
    return sorted(hypotheses, key=lambda h: (-round(h.probability, 6), sum(map(evidence.pool.kinds, h.places))))


def _priors(evidence: Evidence, hypothesis: Evaluated) -> dict[frozenset[Where], float]:
    """Log prior over no fault's, as likely as some, by which effects are faults; others are more than usual."""
    law, found = evidence.law, {}
    places = [evidence.pool.candidate(k).place for k in hypothesis.effects]
    sizes = zip(places, hypothesis.largest, strict=True)
    healthy = [_log_healthy(size, evidence.usual.get(place), law) for place, size in sizes]
    each = float(np.log((1 - law.rare) / len(CATALOGUE)))
    for faulty in product((True, False), repeat=len(places)):
        faults = frozenset(compress(places, faulty))
        log = sum(h for h, fault in zip(healthy, faulty, strict=True) if not fault)
        log += sum(each - (np.log(evidence.joints) if joints else 0.0) for _, joints in faults)
        log += len(hypothesis.free) * np.log(law.rare / evidence.joints)
        log += max(len(faults) + len(hypothesis.free) - 1, 0) * np.log(law.rare)
        if np.isfinite(log):
            found[faults] = float(log)
    return found


def _log_healthy(size: float, usual: float | None, law: EvidenceLaw) -> float:
    """Log density of a torque of a healthy arm over that of a fault as large, which is normal with this size.

    Few logs tell what is usual: Student's t, less the normal density that the noise model has.
    """
    if usual is None:
        return -np.inf
    scale = usual * np.sqrt((law.nu - 2) / law.nu)
    density = t.pdf(size / scale, law.nu) / scale - norm.pdf(size / usual) / usual
    return float(np.log(density * size / norm.pdf(1.0))) if density > 0 else -np.inf


Answer = tuple[frozenset[Where], frozenset[int]]


def _shares(hypothesis: Hypothesis, law: EvidenceLaw) -> dict[Answer, float]:
    """Probability of a hypothesis by answer: which effects are faults and large enough to matter."""
    large = {p for p, torque in zip(hypothesis.places, hypothesis.torque, strict=True) if torque >= law.practical}
    found: dict[Answer, float] = {}
    for faults, share in hypothesis.shares.items():
        answer = faults & large, frozenset(hypothesis.free)
        found[answer] = found.get(answer, 0.0) + share
    return found


def _answers(hypotheses: Sequence[Hypothesis], law: EvidenceLaw) -> dict[Answer, float]:
    """Probability of every answer."""
    answers: dict[Answer, float] = {}
    for hypothesis in hypotheses:
        for answer, share in _shares(hypothesis, law).items():
            answers[answer] = answers.get(answer, 0.0) + share
    return answers


def _equal_by_definition(
    place: Where, leader: Hypothesis, hypotheses: Sequence[Hypothesis], law: EvidenceLaw
) -> tuple[Where, ...]:
    """Hypotheses that equal a cause by definition unless the logs show otherwise, and explain about as much."""
    known = CATALOGUE[place[0]].structurally_equivalent
    found = {
        other: None
        for hypothesis in hypotheses
        if hypothesis.gain >= (1 - law.form) * leader.gain and place not in hypothesis.places
        for other in hypothesis.places
        if other[0] in known and near(place, other)
    }
    return tuple(found)


def _class_of(
    place: Where, names: frozenset[Where], answers: Mapping[Answer, float], equal: tuple[Where, ...], law: EvidenceLaw
) -> tuple[tuple[Where, ...], float]:
    """Hypotheses that these motions do not distinguish from a cause, and the probability of any of them."""
    own = sum(share for (places, _), share in answers.items() if place in places)
    instead: dict[Where, float] = {}
    for (places, _), share in answers.items():
        for other in sorted(places - names) if place not in places else ():
            instead[other] = instead.get(other, 0.0) + share
    likely = [other for other, share in instead.items() if share >= law.rare * own and near(place, other)]
    alike = list(dict.fromkeys([*sorted(likely, key=lambda other: -instead[other]), *equal]))[:_RIVALS]
    return tuple(alike), law.certain * min(1.0, own + sum(instead.get(other, 0.0) for other in alike))
