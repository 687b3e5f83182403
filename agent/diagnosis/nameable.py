"""Which forms may be named at all, and which are only known not to be ruled out."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from agent.diagnosis.band import gain_in_band
from agent.diagnosis.candidate import Candidate, HeldOutScore, Where
from agent.diagnosis.excess import largest_torque, noticed, over_background, put_elsewhere
from agent.diagnosis.finding import Step
from agent.diagnosis.fit import Fit
from agent.diagnosis.isolability import complexity, plausible
from agent.diagnosis.limits import DecisionLimits
from agent.diagnosis.needs import Excursions
from agent.diagnosis.rivals import Places, may_follow_position, offset_and_friction_as_good, special_case_as_good


@dataclass(frozen=True, eq=False)
class Nameable:
    """The rules of point 7 of docs/diagnosis.md for one search.

    `allowed` are names of effects, `given` says that the model is of other data, `at_rest` (S', n) are rows that are no
    motion.
    """

    limits: DecisionLimits
    allowed: Collection[str]
    given: bool
    at_rest: np.ndarray
    excursions: Excursions

    def possible(self, fit: Fit, scores: Iterable[HeldOutScore], least: float) -> list[HeldOutScore]:
        """Those that are plausible, allowed and large enough (`least` [Σ e²/σ²]), and put their torque where it was
        measured."""
        result = []
        over, clear = over_background(fit), noticed(self.limits, self.at_rest, fit)
        for score in scores:
            effect = score.candidate.effect
            if effect.name not in self.allowed or not plausible(score) or score.gain < least:
                continue
            if largest_torque(fit, score) < self.limits.practical_torque or not self.over(score, over, clear):
                continue
            if effect.fast_torque and gain_in_band(fit, score) < self.limits.in_band_gain:
                continue  # it takes noise out of the prediction
            if put_elsewhere(fit, score) > least:
                continue  # what it explains is on one joint, and its torque on others is not there
            if not (effect.once and may_follow_position(self.limits, fit, score, self.excursions)):
                result.append(score)
        return result

    def over(self, score: HeldOutScore, over: np.ndarray, clear: np.ndarray) -> bool:
        """Whether an error over the background may be its own; a model fitted with it would look the same below."""
        joints = list(score.candidate.blocks)
        if not self.given or score.candidate.effect.once:
            return True
        return bool(np.any(clear[joints]) and np.sum(over[joints]) >= self.limits.own_excess * score.gain)

    def limit_as_good(self, fit: Fit, score: HeldOutScore, best: Places, tried: Sequence[Candidate]) -> bool:
        """Whether a form has nothing to show for itself, as a simpler limit of it does as well."""
        effect, rows = score.candidate.effect, float(fit.count.sum())
        limits = effect.simpler(score.candidate.settings, fit.reference.robot)
        simpler = [limit for limit in limits if not (effect.rivals_special_cases and limit in self.allowed)]
        return any(
            special_case_as_good(self.limits, rows, score, limit, best) for limit in simpler
        ) or offset_and_friction_as_good(self.limits, fit, score, tried, best)

    def repeats_better(self, fit: Fit, score: HeldOutScore, scores: Iterable[HeldOutScore]) -> bool:
        """Whether the best form that repeats, held out alike, takes away more than one that happens once.

        Where it may not be named, as it may be the model's own, what happens once is no better known.
        """
        repeated = [other for other in scores if plausible(other) and not other.candidate.once]
        if not repeated:
            return False
        best = max(repeated, key=lambda other: other.gain)
        left = (fit.with_chosen((*fit.chosen, one.candidate)).error(True) for one in (best, score))
        return next(left) < next(left)

    def fuller(
        self, fit: Fit, step: Step, cause: Candidate, lost: float, least: float, forms: Sequence[Candidate]
    ) -> list[Where]:
        """Laws that a cause, which loses `lost`, is a simple limit of, and that do better: too little to be named, as
        no form is trusted that far, but by too much to be ruled out. Where one of their `forms` has no more parameters
        than the cause, it is not ruled out by doing better at all: there is no more of it to fit with."""
        robot, floor = fit.reference.robot, self.limits.equal_gain_floor * float(fit.count.sum())

        def as_simple(place: Where) -> bool:
            simple = [one for one in forms if one.place == place and complexity(one) <= complexity(cause)]
            return any(score.gain > lost and plausible(score) for score in fit.score(simple))

        laws = [
            score
            for score in step.scores
            if score.gain > lost and score not in step.eligible and score.candidate.joints == cause.joints
            if cause.effect.name in score.candidate.effect.simpler(score.candidate.settings, robot)
            if score.gain > lost + floor or as_simple(score.candidate.place)
        ]
        return [score.candidate.place for score in self.possible(fit, laws, least)]
