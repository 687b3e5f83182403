"""The search for causes: single effects first, then what is left, then pairs; abstention where nothing fits."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.candidate import Candidate, HeldOutScore, Where
from agent.diagnosis.evidence import Null, null_gains
from agent.diagnosis.excess import (
    closed_excess,
    exact_but_for_more,
    joint_energy,
    noticed,
    over_background,
    possible_together,
)
from agent.diagnosis.finding import Finding, Step
from agent.diagnosis.fit import Fit
from agent.diagnosis.isolability import best_by_place, complexity, imitates, structurally_equivalent
from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.diagnosis.nameable import Nameable
from agent.diagnosis.needs import Excursions
from agent.diagnosis.refinement import refined
from agent.diagnosis.rivals import (
    as_good,
    equals_by_definition,
    gain_at_best,
    gain_by_form,
    only_steps,
    trusted,
)
from agent.diagnosis.standstill import at_rest
from agent.diagnosis.verdict import abstained, named
from agent.model import CATALOGUE

_SCORED = 3  # of the forms of an effect at a place, held out: those that gain most where nothing is


class Search:
    """A catalogue tried on a fit; `given`: to a model from elsewhere, whose error without an effect is known.

    `moved`: the model's numbers were chosen and fitted to these very logs before. They may hide an effect on its own
    joint and show it on others, and the choice would have been another one beside a rival. `worth`: whether what the
    first effects tried leave is so little that the search goes on. `only` these places are tried.
    """

    def __init__(
        self,
        fit: Fit,
        without: Sequence[str] = (),
        given: bool = True,
        progress: Callable[[str], None] = lambda text: None,
        limits: DecisionLimits = LIMITS,
        moved: bool = False,
        worth: Callable[[Fit], bool] = lambda fit: True,
        only: Collection[Where] | None = None,
    ):
        self.fit, self.given, self._progress, self.limits = fit, given and not moved, progress, limits
        self._worth, self.moved, self._only = worth, moved, only
        self._alike = limits.equal_gain if moved else limits.indistinguishable_gain
        self.allowed = {name for name in CATALOGUE if name not in without}
        self.rows = float(fit.count.sum())
        self.pool: list[Candidate] = []
        self.tried: list[Candidate] = []
        self.null: Null | None = None
        self.least = self.limits.least_gain * self.rows
        self._scanned: dict[frozenset[Candidate], Step] = {}
        self._at_rest = at_rest(fit.signals, limits)
        self.excursions = Excursions.of(fit.signals, limits)
        self._nameable = Nameable(limits, self.allowed, self.given, self._at_rest, self.excursions)

    def run(self) -> Finding:
        """Search until nothing worth naming is left."""
        base = self.fit
        steps = [first := self.scan(base)]
        reported = noticed(self.limits, self._at_rest, base, self.limits.unexplained_torque)
        matters = bool(np.any(reported & noticed(self.limits, self._at_rest, base, allow_stiction=True)))
        if not first.eligible and not matters:
            return self._nothing(abstained(False), steps)
        best: tuple[float, tuple[Candidate, ...]] | None = None
        for start in self._starts(first):
            chosen = self._forward((start,), steps)
            error = base.with_chosen(chosen)
            result = self._total(error)
            if best is None and not self._worth(error):
                break
            if best is None or best[0] - result > self._clearly_less(best[0]):
                best = result, chosen
            if closed_excess(self.limits, base, error) > self.limits.single_effect_closure and len(chosen) == 1:
                break
            if best[0] <= self._clearly_less(best[0]):
                break  # even nothing is not clearly less
        nothing = abstained(matters)
        if best is None:
            return self._nothing(nothing, steps)
        fit = base.with_chosen(self._pruned(self._smaller(best[1], steps) if self.moved else best[1]))
        closed = closed_excess(self.limits, base, fit)
        if closed < self.limits.explained:
            return self._nothing(nothing, steps, closed)
        finding = self._verdict(fit, closed, steps)
        alone = not finding.rivals[0] and exact_but_for_more(self.limits, base, finding.fit, finding.causes[0])
        return (
            replace(finding, matters=matters) if finding.likely and not alone else self._nothing(nothing, steps, closed)
        )

    def _clearly_less(self, error: float) -> float:
        """By so much less has another start to leave than an `error`, to be the better one."""
        least, share = self.limits.equal_gain_floor * self.rows, self.limits.equal_gain
        return max(least, share * (self.fit.error() - error))

    def _nothing(self, verdict: str, steps: list[Step], closed: float = 0.0) -> Finding:
        return Finding(verdict, self.fit, (), (), (), (), closed, tuple(steps), *self._bounds, limits=self.limits)

    @property
    def _bounds(self) -> tuple[float, float]:
        assert self.null is not None
        return self.least, self.null.threshold

    def scan(self, fit: Fit) -> Step:
        """Every effect everywhere, added to what is chosen; done once for the same choice."""
        key = frozenset(fit.chosen)
        if key not in self._scanned:
            self._scanned[key] = self._scan(fit)
        return self._scanned[key]

    def _scan(self, fit: Fit) -> Step:
        taken = {c.place for c in fit.chosen}
        fixed = not self.pool
        wanted = []
        for effect in CATALOGUE.values():
            for joints in effect.places(fit.reference.robot):
                asked = self._only is None or (effect.name, joints) in self._only
                if not asked or (effect.name, joints) in taken or self.excursions.lacking(effect, joints):
                    continue
                if fixed or effect.residual_driven:
                    wanted += [(effect, joints, settings) for settings in effect.settings(fit, joints)]
        beside = " and ".join(c.effect.name for c in fit.chosen) or "the model alone"
        self._progress(f"scan {len(self._scanned) + 1}, beside {beside}: {len(wanted)} forms are made")
        new = fit.candidates(wanted)
        self._progress(f"scan {len(self._scanned) + 1}, beside {beside}: {len(self.pool) + len(new)} forms are tried")
        if fixed:
            self.pool = [c for c in new if not c.effect.residual_driven]
            pool = self.tried = new
        else:
            pool = [c for c in self.pool if c.place not in taken] + new
        tried = fit.score(fit.promising(pool, _SCORED))
        steps = [s for s in tried if s.gain > self.least and only_steps(self.limits, fit, s)]
        best = best_by_place([s for s in tried if s not in steps])
        if fixed:
            self._progress(f"what {len(self.tried)} forms gain by chance")
            self.null = null_gains(fit, self.tried, self.limits)
            self.least = max(self.least, self.null.threshold)
        self._progress(f"scan {len(self._scanned) + 1}, beside {beside}: the leading forms are refined")
        best = self._refined(fit, best)
        scores = tuple(sorted(best.values(), key=lambda s: -s.gain))
        return Step(fit.chosen, fit.error(), scores, self._eligible(fit, best))

    def _refined(self, fit: Fit, best: dict[Where, HeldOutScore]) -> dict[Where, HeldOutScore]:
        """Search the nonlinear parameters of the leading places more finely."""
        least = 0.5 * self.limits.least_gain * self.rows
        over, clear = over_background(fit), noticed(self.limits, self._at_rest, fit)
        large = [s for s in best.values() if s.gain > least and self._nameable.over(s, over, clear)]
        best, made = refined(fit, best, sorted(large, key=lambda s: -s.gain)[:6], self.limits)
        self.pool += [c for c in made if not c.effect.residual_driven]
        return best

    def _eligible(self, fit: Fit, best: dict[Where, HeldOutScore]) -> tuple[HeldOutScore, ...]:
        """Scores that could be named: plausible, allowed, large enough, and better than their own simpler limits."""
        possible = self._nameable.possible(fit, best.values(), self.least)
        result = [score for score in possible if not self._nameable.limit_as_good(fit, score, best, self.tried)]
        if all(score.candidate.effect.once for score in result):
            result = [score for score in result if not self._nameable.repeats_better(fit, score, best.values())]
        return tuple(sorted(result, key=lambda s: -s.gain))

    def _starts(self, step: Step) -> list[Candidate]:
        """The simplest of the best, then the runners-up."""
        if not step.eligible:
            return []
        leader = self._simplest(step)
        rest = [s for s in step.eligible if s is not leader and s.gain > 0.1 * step.eligible[0].gain]
        return [leader.candidate, *(s.candidate for s in rest[: self.limits.starts - 1])]

    def _near(self, step: Step) -> list[HeldOutScore]:
        """Forms that do as well as the best, as far as that one fits: what it leaves is how uncertain it is."""
        best = step.eligible[0]
        left = self._excess(self.fit.with_chosen((*step.chosen, best.candidate)), tuple(best.candidate.blocks))
        least = max(self.limits.equal_gain_floor * self.rows, min(self.limits.equal_gain * best.gain, left))
        places = best_by_place(step.scores)
        return [score for score in step.eligible if as_good(self.limits, score, best, least, places)]

    def _simplest(self, step: Step) -> HeldOutScore:
        return min(self._near(step), key=lambda s: (complexity(s.candidate), -s.gain))

    def _forward(self, chosen: tuple[Candidate, ...], steps: list[Step]) -> tuple[Candidate, ...]:
        """Add effects while they explain a good part of what is left."""
        while len(chosen) < self.limits.most_effects:
            fit = self.fit.with_chosen(chosen)
            step = self.scan(fit)
            steps.append(step)
            worth = [s for s in step.eligible if s.gain > self._further(fit, s) and not imitates(chosen, s)]
            worth = [s for s in worth if possible_together(self.fit.with_chosen((*chosen, s.candidate)))]
            if not worth:
                return chosen
            step = Step(step.chosen, step.error, step.scores, tuple(worth))
            chosen = (*chosen, self._simplest(step).candidate)
        return chosen

    def _smaller(self, chosen: tuple[Candidate, ...], steps: list[Step]) -> tuple[Candidate, ...]:
        """With the effects that stand out once those found are no longer part of what chance is judged by."""
        while len(chosen) < self.limits.most_effects:
            self._progress("what forms gain by chance beside the effects found")
            null = null_gains(self.fit, self.tried, self.limits, self.fit.with_chosen(chosen))
            least = max(self.limits.least_gain * self.rows, null.threshold)
            if least >= self.least:
                break
            self.null, self.least = null, least
            self._scanned = {key: self._again(step) for key, step in self._scanned.items()}
            more = self._forward(chosen, steps)
            if more == chosen:
                break
            chosen = more
        return chosen

    def _again(self, step: Step) -> Step:
        """A scan, with what may be named by `least` as it is now."""
        best = {score.candidate.place: score for score in step.scores}
        return replace(step, eligible=self._eligible(self.fit.with_chosen(step.chosen), best))

    def _further(self, fit: Fit, score: HeldOutScore) -> float:
        """Gain from which on an effect counts beside those chosen: a misfit on another joint does not hide it."""
        joints = list(score.candidate.joints or score.candidate.blocks)
        least = max(2 * self.least, self.limits.further_effect * self._excess(fit, joints))
        if any(set(joints) & set(c.blocks) for c in fit.chosen):
            least = max(least, self.limits.gain_beside * self._excess(self.fit, joints))
        return least

    def _excess(self, fit: Fit, joints: Sequence[int] | None = None) -> float:
        """Energy over the background that is left, joint by joint, on all joints or some."""
        over = np.maximum(joint_energy(fit) - 1, 0)
        return float(np.sum(over if joints is None else over[list(joints)]) * self.rows / len(fit.rows))

    def _total(self, fit: Fit) -> float:
        return fit.error(fit.once) + self.fit.error() - self.fit.error(fit.once)

    def _pruned(self, chosen: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
        """Without what the others explain as well; beside numbers that were moved, of what its own joints had."""
        total = self._total(self.fit.with_chosen(chosen))
        for candidate in chosen:
            others = tuple(c for c in chosen if c is not candidate)
            had = self._excess(self.fit, list(candidate.blocks)) if self.moved else self.fit.error()
            least = max(self.least, self.limits.redundant_gain * had)
            if others and self._total(self.fit.with_chosen(others)) - total < least:
                return self._pruned(others)
        return chosen

    def _unfit(self, fit: Fit) -> HeldOutScore | None:
        """A shape of the same kind on the same joint that explains half of what a cause leaves."""
        least = max(2 * self.least, self.limits.rival_energy * self._excess(fit))
        return next((s for s in self.scan(fit).eligible if s.gain > least and imitates(fit.chosen, s)), None)

    def _verdict(self, fit: Fit, closed: float, steps: list[Step]) -> Finding:
        """Order causes by what is lost without each, and look for places that would do as well."""
        total = self._total(fit)
        ranked = []
        for candidate in fit.chosen:
            others = tuple(c for c in fit.chosen if c is not candidate)
            without = self.fit.with_chosen(others)
            step = self.scan(without)
            lost = self._total(without) - total
            least = max(self.limits.equal_gain_floor * self.rows, self._excess(fit, tuple(candidate.blocks)))
            places = best_by_place(step.scores)
            trust = {there: gain_by_form(self.limits, lost, places, candidate.place, there) for there in places}
            shares = {there: trusted(self.limits, candidate, there, self._alike) for there in trust}
            margins = {there: max(least, shares[there] * by_form) for there, by_form in trust.items()}
            level: list[Where] = []
            runners: list[Where] = []
            behind = np.inf
            equals = equals_by_definition(self.limits, without, self.tried, candidate, lost, margins, places)
            for score in step.eligible:
                if score.candidate.place == candidate.place:
                    continue
                short = lost - gain_at_best(self.limits, score, places, candidate.place)
                margin = margins[score.candidate.place]
                better = short < -self.limits.equal_gain_floor * self.rows
                equal = better or complexity(score.candidate) <= complexity(candidate) + 1
                if structurally_equivalent(candidate, score):
                    equal = better or score.candidate.place in equals
                if short <= margin and equal:
                    level.append(score.candidate.place)
                elif short > margin:
                    behind = min(behind, short / margin)
                    if score.candidate.once <= candidate.once and score.gain > self.limits.runner_up_gain * lost:
                        runners.append(score.candidate.place)  # what comes back is no string of pushes
            known = [place for place in equals if place[0] in self.allowed]
            fuller = self._nameable.fuller(without, step, candidate, lost, self.least, self.pool)
            beside = tuple(dict.fromkeys([*known, *level, *fuller]))[:2]
            ranked.append((lost, candidate, beside, behind, bool(equals), tuple(runners[:2])))
        ranked.sort(key=lambda entry: -entry[0])
        causes = tuple(entry[1] for entry in ranked)
        rivals = [entry[2] for entry in ranked]
        odd = self._unfit(fit)
        if odd is not None:
            at = next(k for k, c in enumerate(causes) if imitates((c,), odd))
            rivals[at] = tuple(dict.fromkeys((odd.candidate.place, *rivals[at])))[:2]
        assert self.null is not None
        uncertain_form = closed < self.limits.good_fit[len(causes) - 1]
        if uncertain_form and not rivals[0]:
            rivals[0] = ranked[0][5]
        return Finding(
            named(bool(rivals[0] or ranked[0][4])),
            self.fit.with_chosen(causes),
            causes,
            tuple(rivals),
            tuple(self.null.p_value(entry[0]) for entry in ranked),
            tuple(float(entry[3]) for entry in ranked),
            closed,
            tuple(steps),
            *self._bounds,
            runners=ranked[0][5],
            limits=self.limits,
        )
