"""The result of a search for causes, and its probability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.rows.candidate import Candidate, Where
from agent.diagnosis.rows.fit import Fit


def near(place: Where, other: Where) -> bool:
    """Whether two hypotheses are on the same joints, or one of them is on the whole arm."""
    return place[1] == other[1] or not place[1] or not other[1]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects that may act together, and joints with something else that is not in the catalogue.

    `gain` is the log Bayes factor against no effect. `shares` are posterior probabilities by which of the effects are
    faults: the healthy arm has the others. `torque[k]` is the largest torque
    of effect k over nominal. `explained` is the share explained of the torque beyond the noise model. `scale` is the
    largest squared error left on a joint, divided by its noise variance.
    """

    effects: tuple[Candidate, ...]
    free: tuple[int, ...]
    gain: float
    shares: Mapping[frozenset[Where], float]
    torque: tuple[float, ...]
    explained: float
    scale: float

    @property
    def probability(self) -> float:
        """The posterior probability that it is true, and all its effects are faults."""
        return self.shares.get(frozenset(self.places), 0.0)

    @property
    def places(self) -> tuple[Where, ...]:
        """Effects and joints."""
        return tuple(candidate.place for candidate in self.effects)


@dataclass(frozen=True, eq=False)
class Finding:
    """The verdict of a search, and the evidence for it.

    `fit` has the causes as part of the model. `rivals[k]` are hypotheses that these motions cannot distinguish from
    cause k, and `probability[k]` is that of cause k or one of them. `hypotheses` are sorted by probability; `healthy`
    is the probability of no effect that matters. `zero_known`: there was a log with the drives off.
    """

    verdict: str
    fit: Fit
    causes: tuple[Candidate, ...]
    rivals: tuple[tuple[Where, ...], ...]
    probability: tuple[float, ...]
    hypotheses: tuple[Hypothesis, ...]
    evidence: Evidence
    healthy: float = 0.0
    zero_known: bool = False

    @property
    def exceeded(self) -> bool:
        """Whether a joint's error exceeds the noise model enough that some cause, known or not, must exist."""
        return next(h for h in self.hypotheses if not h.effects and not h.free).scale >= self.evidence.law.exceeded

    def only(self, kept: Sequence[int], fit: Fit) -> Finding:
        """Keep some of the causes, by number; `fit` is the one without effects."""
        causes = tuple(self.causes[k] for k in kept)
        return replace(
            self,
            fit=fit.with_chosen(causes),
            causes=causes,
            rivals=tuple(self.rivals[k] for k in kept),
            probability=tuple(self.probability[k] for k in kept),
        )

    def without_causes(self, verdict: str, fit: Fit) -> Finding:
        """The same search with nothing named, and the fit that has no effects."""
        return replace(self, verdict=verdict, fit=fit, causes=(), rivals=(), probability=())

    def with_rival(self, number: int, place: Where) -> Finding:
        """The same finding with one more hypothesis that equals a cause, by number."""
        rivals = tuple((place, *r) if k == number and place not in r else r for k, r in enumerate(self.rivals))
        return replace(self, verdict="ambiguous" if rivals[0] else self.verdict, rivals=rivals)

    def with_runner_up(self) -> Finding:
        """The same finding with the likeliest replacement of the first cause in another hypothesis as its equal."""
        place = self.causes[0].place
        others = (other for h in self.hypotheses if place not in h.places for other in h.places)
        likely = next((other for other in others if near(place, other)), None)
        return self if likely is None else self.with_rival(0, likely)
