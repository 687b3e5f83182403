"""Which forms are alike: by kind, by what they equal, and by how simple they are."""

from __future__ import annotations

from collections.abc import Sequence

from agent.diagnosis.candidate import Candidate, HeldOutScore, Where


def plausible(score: HeldOutScore) -> bool:
    """Whether the fitted parameters can be true."""
    candidate = score.candidate
    effect, settings = candidate.effect, candidate.settings
    values = dict(zip(candidate.names, score.values, strict=True))
    return effect.plausible(settings, values) and effect.possible(
        candidate.reference, candidate.joints, settings, values
    )


def structurally_equivalent(candidate: Candidate, score: HeldOutScore) -> bool:
    """Whether a score is of a form that equals a cause's unless the data tell them apart, and possible."""
    other = score.candidate
    there = other.joints == candidate.joints or () in (other.joints, candidate.joints)
    return there and other.effect.name in candidate.effect.structurally_equivalent and plausible(score)


def imitates(chosen: Sequence[Candidate], score: HeldOutScore) -> bool:
    """Whether one of the chosen effects has a shape of the same kind on the same joint."""
    other = score.candidate
    return any(c.joints == other.joints and set(c.effect.shapes) & set(other.effect.shapes) for c in chosen)


def best_by_place(scores: Sequence[HeldOutScore]) -> dict[Where, HeldOutScore]:
    """Of every place the settings that gain most, possible ones first."""
    best: dict[Where, HeldOutScore] = {}
    for score in scores:
        place = score.candidate.place
        rank = (plausible(score), score.gain)
        if place not in best or rank > (plausible(best[place]), best[place].gain):
            best[place] = score
    return best


def complexity(candidate: Candidate) -> int:
    """Number of parameters, with a penalty for what could be anything."""
    return candidate.effect.n_parameters(candidate.settings) + candidate.effect.complexity_penalty
