"""What a search for causes comes to, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.diagnosis.candidate import Candidate, HeldOutScore, Where
from agent.diagnosis.fit import Fit
from agent.diagnosis.limits import LIMITS, DecisionLimits


@dataclass(frozen=True, eq=False)
class Step:
    """One scan: what was chosen before it, the best score of every place, and which of them could be named."""

    chosen: tuple[Candidate, ...]
    error: float
    scores: tuple[HeldOutScore, ...]
    eligible: tuple[HeldOutScore, ...]


@dataclass(frozen=True, eq=False)
class Finding:
    """The outcome: the fit with its causes, who equals whom, how much of the excess is closed, and the steps.

    `rivals[k]` are places that the data cannot tell from cause k, `p_value[k]` is how often anything gains as much as
    it where there is nothing (see `evidence`), `margin_ratio[k]` how many margins the best place outside its class
    falls behind. `least` is the gain that a cause has to have, and `null_gain` the one that the whole search exceeds in
    one of a hundred cases where there is nothing. `runners` are the next best places beside the first cause: they equal
    it where it turns out to close too little. `matters`: whether without any cause there is a gap that has to be said.
    `ruled_out` are places that another test than motion excluded; `zero_known`: there was a log with the drives off.
    """

    verdict: str
    fit: Fit
    causes: tuple[Candidate, ...]
    rivals: tuple[tuple[tuple[str, tuple[int, ...]], ...], ...]
    p_value: tuple[float, ...]
    margin_ratio: tuple[float, ...]
    closed: float
    steps: tuple[Step, ...]
    least: float
    null_gain: float
    runners: tuple[tuple[str, tuple[int, ...]], ...] = ()
    matters: bool = True
    ruled_out: tuple[Where, ...] = ()
    zero_known: bool = False
    limits: DecisionLimits = LIMITS

    def with_uncertain_form(self) -> Finding:
        """The same causes, where the first closes so little that another may do as well: the next best."""
        named = {candidate.place for candidate in self.causes}
        others = [score.candidate.place for score in self.steps[0].scores if score.candidate.place not in named]
        rivals = self.rivals[0] or self.runners or tuple(others[:1])
        return replace(self, verdict="ambiguous", rivals=(rivals, *self.rivals[1:]))

    def with_rival(self, number: int, place: Where) -> Finding:
        """The same where a place equals one of the causes, by number."""
        rivals = tuple((place, *r) if k == number and place not in r else r for k, r in enumerate(self.rivals))
        return replace(self, verdict="ambiguous" if rivals[0] else self.verdict, rivals=rivals)

    def only(self, kept: Sequence[int], fit: Fit) -> Finding:
        """The same with some of its causes, by number; `fit` is the one without effects."""
        causes = tuple(self.causes[k] for k in kept)
        return replace(
            self,
            fit=fit.with_chosen(causes),
            causes=causes,
            rivals=tuple(self.rivals[k] for k in kept),
            p_value=tuple(self.p_value[k] for k in kept),
            margin_ratio=tuple(self.margin_ratio[k] for k in kept),
        )

    def without_causes(self, verdict: str, fit: Fit) -> Finding:
        """The same search with nothing named, and the fit that has no effects."""
        return replace(self, verdict=verdict, fit=fit, causes=(), rivals=(), p_value=(), margin_ratio=())

    @property
    def likely(self) -> bool:
        """Whether the first cause may be named. One that happens once, and is put where it gains, has to be surer."""
        once = self.causes[0].effect.once
        return self.probability[0] > (self.limits.sure_probability if once else self.limits.least_probability)

    @property
    def probability(self) -> tuple[float, ...]:
        """Of each cause's class."""
        return tuple(class_probability(margin_ratio, self.closed, self.limits) for margin_ratio in self.margin_ratio)


def class_probability(margin_ratio: float, closed: float, limits: DecisionLimits = LIMITS) -> float:
    """Of a cause's class, from its margin ratio and the part of the excess closed: a logistic, three coefficients.

    They were fitted to runs of another simulation (docs/decisions/diagnosis-probability.md).
    """
    constant, by_margin, by_closed = limits.probability
    still_open = max(1 - closed, limits.least_open)
    score = constant + by_margin * np.log1p(min(margin_ratio, limits.most_margin)) - by_closed * np.log(still_open)
    return float(1 / (1 + np.exp(-score)))
