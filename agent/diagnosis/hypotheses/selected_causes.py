"""What a search for causes found: hypotheses with their probabilities, and the causes that lead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate, EffectKey
from agent.diagnosis.rows.fit import Fit


def share_joints(key: EffectKey, other: EffectKey) -> bool:
    """Whether two hypotheses have a joint in common, or one of them is on the whole arm."""
    return not key[1] or not other[1] or not set(key[1]).isdisjoint(other[1])


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects that may act together, and joints with something else that is not in the catalogue.

    `log_bayes_factor` is that against no effect. `shares` are posterior probabilities by which of the effects are
    faults: the healthy arm has the others. `largest_torque[k]` is that of effect k, over nominal.
    `explained_share` is that of the torque beyond the noise model. `largest_error_ratio` is the largest squared error
    left on a joint, divided by its noise variance.
    """

    effects: tuple[Candidate, ...]
    uncatalogued_joints: tuple[int, ...]
    log_bayes_factor: float
    shares: Mapping[frozenset[EffectKey], float]
    largest_torque: tuple[float, ...]
    explained_share: float
    largest_error_ratio: float

    @property
    def probability(self) -> float:
        """The posterior probability that it is true, and all its effects are faults."""
        return self.shares.get(frozenset(self.effect_keys), 0.0)

    @property
    def effect_keys(self) -> tuple[EffectKey, ...]:
        """Effects and joints."""
        return tuple(candidate.key for candidate in self.effects)


@dataclass(frozen=True, eq=False)
class SelectedCauses:
    """Causes, and the evidence for them; `agent.diagnosis.verdict` names some of them, and says what verdict that is.

    `fit` has the causes as part of the model, `plain` has no effects. `rivals[k]` are hypotheses that these motions
    cannot distinguish from cause k, and `probability[k]` is that of cause k or one of them. `explained_share`, of the
    torque beyond the noise model, is what the likeliest hypothesis explains. `hypotheses` are sorted by probability;
    `healthy` is the probability of no effect that matters. `ignored`: effects that were not tried. `leaves_gap`:
    whether there is a gap also if no cause may be named. `zero_known`: there was a log with the drives off.
    `rejected`: likely effects that do not explain the gap, and why.
    """

    plain: Fit
    fit: Fit
    causes: tuple[Candidate, ...]
    rivals: tuple[tuple[EffectKey, ...], ...]
    probability: tuple[float, ...]
    explained_share: float
    hypotheses: tuple[Hypothesis, ...]
    evidence: Evidence
    healthy: float = 0.0
    ignored: frozenset[str] = frozenset()
    leaves_gap: bool = False
    zero_known: bool = False
    rejected: tuple[tuple[EffectKey, str], ...] = ()

    @property
    def largest_error_ratio(self) -> float:
        """Largest squared error of a joint without effects, over its noise variance."""
        return next(h for h in self.hypotheses if not h.effects and not h.uncatalogued_joints).largest_error_ratio

    @property
    def errs_beyond_usual(self) -> bool:
        """Whether a joint errs without effects by twice what a model usually does, in the scales of the evidence."""
        return self.largest_error_ratio >= LIMITS.usual_error**2

    def irreplaceable(self, number: int) -> bool:
        """Whether a cause in the gear of one joint, by number, is needed next to anything smooth there."""
        cause, pool = self.causes[number], self.evidence.pool
        of_gear = len(cause.joints) == 1 and cause.effect.family == "transmission"
        return of_gear and self.evidence.irreplaceable(pool.numbers(self.causes), number)

    def keeping(self, kept: Sequence[int], leaves_gap: bool | None = None) -> SelectedCauses:
        """The same selection with some of the causes, by number, and whether there is a gap without them.

        Causes take the parameterisations that they have without the others, if that was evaluated.
        """
        if leaves_gap is not None:
            return replace(self, leaves_gap=leaves_gap).keeping(kept)
        if len(kept) == len(self.causes):
            return self
        causes = tuple(self.causes[k] for k in kept)
        effect_keys = {cause.key for cause in causes}
        catalogued = (h for h in self.hypotheses if not h.uncatalogued_joints)
        by_themselves = next((h for h in catalogued if effect_keys == set(h.effect_keys)), None)
        if by_themselves is not None:
            evaluated = dict(zip(by_themselves.effect_keys, by_themselves.effects, strict=True))
            causes = tuple(evaluated[cause.key] for cause in causes)
        return replace(
            self,
            fit=self.plain.with_chosen(causes) if causes else self.plain,
            causes=causes,
            rivals=tuple(self.rivals[k] for k in kept),
            probability=tuple(self.probability[k] for k in kept),
        )

    def without_causes(self, leaves_gap: bool) -> SelectedCauses:
        """The same selection with no cause, and whether there is a gap nevertheless."""
        return replace(self.keeping(()), leaves_gap=leaves_gap)

    def with_rejected(self, why: Sequence[str]) -> SelectedCauses:
        """The same selection with causes that do not explain the gap among what is rejected; `why` of every cause."""
        new = tuple((cause.key, reason) for cause, reason in zip(self.causes, why, strict=True) if reason)
        return replace(self, rejected=(*self.rejected, *new))

    def with_rival(self, number: int, key: EffectKey) -> SelectedCauses:
        """The same selection with one more hypothesis that equals a cause, by number."""
        rivals = tuple((key, *r) if k == number and key not in r else r for k, r in enumerate(self.rivals))
        return replace(self, rivals=rivals)

    def with_runner_up(self, number: int = 0) -> SelectedCauses:
        """The same selection with the likeliest replacement of a cause in another hypothesis as its equal."""
        key, named = self.causes[number].key, {cause.key for cause in self.causes}
        others = (other for h in self.hypotheses if key not in h.effect_keys for other in h.effect_keys)
        likely = next((other for other in others if share_joints(key, other) and other not in named), None)
        return self if likely is None else self.with_rival(number, likely)
