"""The search for causes: selects the hypotheses to evaluate, by forward selection from the leading ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

import numpy as np

from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.noise_model import Healthy
from agent.diagnosis.hypotheses.posterior import Observed, compare
from agent.diagnosis.hypotheses.score import EvaluatedHypothesis
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.rows.candidate import MADE_AT_ONCE, Candidate, EffectKey, Wanted
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.rows.needs import MotionCoverage
from agent.model import CATALOGUE

_LEADERS = 8  # hypotheses whose nonlinear parameters are refined
_FIRST, _THEN = 12, 6  # numerical: hypotheses that are evaluated after nothing, and after another hypothesis
_PARAMETERISATIONS = 3  # numerical: parameterisations per hypothesis
_EXTENDED = (3, 2)  # numerical: hypotheses that one more effect is tried with, by how many they have
_FACTORS = (1.25, 1.1, 1.04, 1.015)  # numerical: of nonlinear parameters, up and down

HypothesisKey = tuple[frozenset[EffectKey], frozenset[int]]


class Search:
    """A catalogue tried on a fit.

    Parameters
    ----------
    fit : Fit
        Residual and columns of the model on the logs.
    without : sequence of str, optional
        Effects that are left out of the catalogue.
    progress : callable, optional
        Told how far the search has come.
    only : collection of (effect, joints), optional
        Hypotheses that are tried; all if None.
    observed : callable, optional
        Log likelihood of something else that was observed, given a hypothesis.
    healthy : sequence of HealthyForm, optional
        Effects that the arm has already; None if that is not known.
    most : int, optional
        Effects in one hypothesis.
    """

    def __init__(
        self,
        fit: Fit,
        without: Sequence[str] = (),
        progress: Callable[[str], None] = lambda text: None,
        only: Collection[EffectKey] | None = None,
        observed: Observed | None = None,
        healthy: Healthy | None = None,
        most: int = LAW.max_effects,
    ):
        self.fit, self._progress, self._observed, self._healthy, self._most = fit, progress, observed, healthy, most
        self._ignored, self.allowed = without, {name for name in CATALOGUE if name not in without}
        self.coverage = MotionCoverage.of(fit.signals)
        self._effects_on_joints = [
            (effect, joints)
            for effect in CATALOGUE.values()
            if effect.shows_in == "torque" and effect.name in self.allowed
            for joints in effect.possible_joints(fit.reference.robot)
            if (only is None or (effect.name, joints) in only) and not self.coverage.lacking(effect, joints)
        ]
        self._made: set[Candidate] = set()
        self._best_by_key: dict[HypothesisKey, EvaluatedHypothesis] = {}
        self._tried: set[HypothesisKey] = set()

    def run(self) -> SelectedCauses:
        """Evaluate the promising hypotheses, and compare them."""
        wanted = self._grid()
        usual = {(effect, joints): (effect, joints, s) for effect, joints, s in reversed(wanted) if effect.usual}
        self.usual = first = self._stable_candidates(list(usual.values()))
        self.evidence = evidence = Evidence(self.fit, first, self._healthy)
        self._made.update(first)
        self._add(self.fit, wanted)
        self._progress(f"comparing {evidence.pool.size} parameterisations")
        self._keep_if_best(evidence.null_hypothesis)
        self._extend(evidence.null_hypothesis, _FIRST)
        for depth in range(1, self._most):
            before = max(hypothesis.log_evidence for hypothesis in self._best_by_key.values())
            for base in self._extendable(depth)[: _EXTENDED[min(depth, 2) - 1]]:
                self._progress(f"trying a further effect next to {self._text(base)}")
                self._extend(base, _THEN)
            deeper = [
                hypothesis.log_evidence
                for hypothesis in self._best_by_key.values()
                if len(hypothesis.effects) + len(hypothesis.uncatalogued_sizes) > depth
            ]
            if max(deeper, default=-np.inf) < before:
                break
        selected = self._compared()
        for _ in range(LAW.max_effects):
            if not self._replace(selected):
                break
            selected = self._compared()
        return selected

    def _compared(self) -> SelectedCauses:
        return compare(self.fit, self.evidence, list(self._best_by_key.values()), self._observed, self._ignored)

    def _replace(self, selected: SelectedCauses) -> bool:
        """Try other effects in place of each of several causes; False where all have been tried already.

        Forward selection compares a cause with others only next to those that were found before it.
        """
        others = [selected.causes[:k] + selected.causes[k + 1 :] for k in range(len(selected.causes))]
        new = [causes for causes in others if causes and self._key(causes, ()) not in self._tried]
        for causes in new:
            self._progress(f"comparing with others next to {' and '.join(cause.effect.name for cause in causes)}")
            base = self.evidence.evaluate(self.evidence.pool.numbers(causes))
            self._keep_if_best(base)
            self._extend(base, _THEN)
        return bool(new)

    @staticmethod
    def _key(candidates: Iterable[Candidate], uncatalogued_joints: Iterable[int]) -> HypothesisKey:
        return frozenset(candidate.key for candidate in candidates), frozenset(uncatalogued_joints)

    def candidates(self) -> Iterator[list[Candidate]]:
        """Yield every effect on all its possible joints, with the grid of its nonlinear parameters, some at a time."""
        wanted = self._grid()
        return (
            self._stable_candidates(wanted[first : first + MADE_AT_ONCE])
            for first in range(0, len(wanted), MADE_AT_ONCE)
        )

    def _grid(self) -> list[Wanted]:
        wanted: list[Wanted] = [
            (effect, joints, s) for effect, joints in self._effects_on_joints for s in effect.settings(self.fit, joints)
        ]
        self._progress(f"comparing {len(wanted)} forms of effects")
        return wanted

    def _stable_candidates(self, wanted: Sequence[Wanted]) -> list[Candidate]:
        return [candidate for candidate in self.fit.candidates(wanted, rough=True) if candidate.stable]

    def _text(self, base: EvaluatedHypothesis) -> str:
        names = [self.evidence.pool.candidate(k).effect.name for k in base.effects]
        return " and ".join([*names, *["something else"] * len(base.uncatalogued_sizes)])

    def _extendable(self, depth: int) -> list[EvaluatedHypothesis]:
        """Hypotheses with as many effects, likelier than none, that matter; likeliest first."""
        least, smallest = self.evidence.null_hypothesis.log_evidence, 0.5 * LAW.least_named_torque
        level = [
            hypothesis
            for hypothesis in self._best_by_key.values()
            if len(hypothesis.effects) + len(hypothesis.uncatalogued_sizes) == depth and hypothesis.log_evidence > least
            if min(hypothesis.largest_torque, default=1.0) > smallest
        ]
        return sorted(level, key=lambda hypothesis: -hypothesis.log_evidence)

    def _extend(self, base: EvaluatedHypothesis, count: int) -> None:
        """Extend a hypothesis by the most promising effects, and by something else on each joint, and evaluate each."""
        evidence = self.evidence
        self._tried.add(self._key(map(evidence.pool.candidate, base.effects), base.uncatalogued_sizes))
        gains, values = self._refined(evidence.as_expected(base), bool(base.scales.max() > 1))
        for numbers in self._promising(base, gains, values, count).values():
            for k in numbers:
                self._keep_if_best(evidence.evaluate([*base.effects, k], base.uncatalogued_sizes, base.scales))
        for joint in set(range(evidence.dof)) - set(base.uncatalogued_sizes):
            for size in LAW.sizes[:3]:
                self._keep_if_best(
                    evidence.evaluate(base.effects, {**base.uncatalogued_sizes, joint: size}, base.scales)
                )

    def _refined(self, base: EvaluatedHypothesis, leaves_more: bool) -> tuple[np.ndarray, list[np.ndarray]]:
        """Gains over a hypothesis, with the leaders' parameters refined.

        Parameterisations follow what it leaves if that is more than the model's own error.
        """
        evidence = self.evidence
        if base.effects and leaves_more:
            fit = self.fit.with_chosen([evidence.pool.candidate(k) for k in base.effects])
            driven = [(e, joints) for e, joints in self._effects_on_joints if e.residual_driven]
            self._add(fit, [(e, joints, s) for e, joints in driven for s in e.settings(fit, joints)])
        gains, values = evidence.shortlist_gains(base)
        leading = self._promising(base, gains, values, _LEADERS)
        best = {key: numbers[0] for key, numbers in leading.items()}
        wanted = [
            (e.effect, e.joints, s) for e in map(evidence.pool.candidate, best.values())
            for s in e.effect.reversing(self.fit, e.joints, e.settings)
        ]  # fmt: skip
        for factor in (None, *_FACTORS):
            if factor is not None:
                wanted = [
                    (e.effect, e.joints, s) for e in map(evidence.pool.candidate, best.values())
                    for s in e.effect.nearby(e.settings, factor) if e.effect.shown(self.fit, e.joints, s)
                ]  # fmt: skip
            before = evidence.pool.size
            self._add(self.fit, wanted)
            if evidence.pool.size == before:
                continue
            gains, values = evidence.shortlist_gains(base)
            for k in range(before, evidence.pool.size):
                key = evidence.pool.candidate(k).key
                if key in best and gains[k] > gains[best[key]] and evidence.possible(k, values[k]):
                    best[key] = k
        return gains, values

    def _add(self, fit: Fit, wanted: Sequence[Wanted]) -> None:
        for start in range(0, len(wanted), MADE_AT_ONCE):
            some = fit.candidates(wanted[start : start + MADE_AT_ONCE], rough=True)
            new = [c for c in dict.fromkeys(some) if c not in self._made and c.stable]
            self._made.update(new)
            self.evidence.pool.add(new)

    def _promising(
        self, base: EvaluatedHypothesis, gains: np.ndarray, values: Sequence[np.ndarray], count: int
    ) -> dict[EffectKey, list[int]]:
        """The best admissible parameterisations of the effects with the largest gain."""
        evidence = self.evidence
        chosen = [evidence.pool.candidate(k) for k in base.effects]
        numbers_by_effect: dict[EffectKey, list[int]] = {}
        for k in np.argsort(-gains).tolist():
            key = evidence.pool.candidate(k).key
            numbers = numbers_by_effect.get(key, [])
            if len(numbers) >= _PARAMETERISATIONS or (not numbers and len(numbers_by_effect) >= count):
                continue
            if not _duplicates_law(evidence.pool.candidate(k), chosen) and evidence.possible(k, values[k]):
                numbers_by_effect.setdefault(key, []).append(k)
        return numbers_by_effect

    def _keep_if_best(self, evaluated: EvaluatedHypothesis) -> None:
        """Keep a hypothesis whose parameters can be true, with its best parameterisations."""
        evidence = self.evidence
        if not all(map(evidence.possible, evaluated.effects, evaluated.values)):
            return
        key = self._key(map(evidence.pool.candidate, evaluated.effects), evaluated.uncatalogued_sizes)
        if key not in self._best_by_key or self._best_by_key[key].log_evidence < evaluated.log_evidence:
            self._best_by_key[key] = evaluated


def _duplicates_law(candidate: Candidate, chosen: Sequence[Candidate]) -> bool:
    """Whether a law of the same argument sits on the same joint already: the two would be one law."""
    shapes = set(candidate.effect.shapes)
    return any(
        candidate.key == other.key or (candidate.joints == other.joints and shapes & set(other.effect.shapes))
        for other in chosen
    )
