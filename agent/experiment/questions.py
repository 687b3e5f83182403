"""What a diagnosis leaves open: pairs of hypotheses that its logs cannot tell apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from agent.diagnosis import (
    Candidate,
    Diagnosis,
    Fit,
    HeldOutScore,
    best_by_place,
    complexity,
    joint_energy,
    plausible,
    practical_parameters,
)
from agent.model import CATALOGUE

Place = tuple[str, tuple[int, ...]]

#: Of a hypothesis so many forms (nonlinear parameters) are kept, each with another number of parameters: a rival is
#: whichever of its forms comes nearest, and one that is far richer is none.
_FORMS = 5
#: Of those that do as well as the best so many may be true, the simplest first.
_TRUE = 2
#: Of a gap that nothing explains so many leading places are taken.
_LEADING = 3
#: Beside what a verdict takes for equal, so many other places are asked about that explain at least this part of what
#: the cause does: forms that are alike on little motion hide each other, and the truth may be none of the first two.
_NEAREST, _NEAR = 4, 0.9
#: A form that these logs hardly show is as large as the cause, give or take so many times it.
_RESTRAINT = 3.0
#: Of effects that could not be tested so many are asked about.
_MOST_UNTESTED = 8


@dataclass(frozen=True, eq=False)
class Form:
    """An effect with its nonlinear parameters, its linear ones (k,) and their covariance (k, k)."""

    candidate: Candidate
    values: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An effect at a place; `forms` it may have, the likeliest first. No forms: nothing beyond the model.

    `as_good` of them, the simplest that do as well as the best, are what may be true.
    """

    effect: str
    joints: tuple[str, ...]
    forms: tuple[Form, ...]
    as_good: tuple[Form, ...] = ()

    @property
    def truths(self) -> tuple[Form, ...]:
        """What is taken for true where it is this one."""
        return self.as_good or self.forms[:1]

    def place(self, joint_names: Sequence[str]) -> Place:
        """Effect and joints from 0."""
        return self.effect, tuple(joint_names.index(name) for name in self.joints)

    def text(self) -> str:
        """For people."""
        if not self.forms:
            return "no effect"
        return f"{self.effect} on {', '.join(self.joints)}" if self.joints else self.effect


@dataclass(frozen=True, eq=False)
class OpenPair:
    """Two hypotheses that the logs do not separate, beside what both of them share (the chosen effects of `fit`).

    `margin` [Σ e²/σ²]: so much better, for each row of all motions, has the true one to be.
    """

    first: Hypothesis
    second: Hypothesis
    fit: Fit
    margin: float

    @property
    def names(self) -> tuple[str, str]:
        """Effects of the two."""
        return self.first.effect, self.second.effect


def open_pairs(found: Diagnosis) -> list[OpenPair]:
    """What is open after a diagnosis, most urgent first; empty where everything was settled.

    `ambiguous`: every named cause against what equals it, or nearly does. `unknown`: the leading places against each
    other. Where nothing else is open: effects of practical size that these logs would not have shown, against none.
    """
    if (pairs := list(_rivals(found)) or list(_leading(found))) or found.finding.verdict == "ambiguous":
        return pairs
    return list(_untested(found))


def _rivals(found: Diagnosis) -> Iterator[OpenPair]:
    finding, base = found.finding, found.dataset.fit
    for number, (cause, rivals) in enumerate(zip(finding.causes, finding.rivals, strict=True)):
        if not rivals or (finding.verdict != "ambiguous"):
            continue
        fit = base.with_chosen([c for k, c in enumerate(finding.causes) if k != number])
        mine = _hypothesis(found, fit, cause.place)
        near = _near(found, cause.place) if len(finding.causes) == 1 else []
        others = [_hypothesis(found, fit, place) for place in dict.fromkeys([*rivals, *near])]
        known = {cause.place, *rivals, *near, *finding.ruled_out}
        others += [_restrained(found, fit, place, cause) for place in _of_its_kind(found, cause) if place not in known]
        open_sides = [side for side in (mine, *others) if side.forms]
        for first, second in combinations(open_sides, 2):  # the truth may be none of those that are named
            yield OpenPair(first, second, fit, _margin(found, fit, (first, second)))


def _near(found: Diagnosis, cause: Place) -> list[Place]:
    """Places that explain nearly as much as the only cause, the best first."""
    best = best_by_place([s for s in found.finding.steps[0].scores if plausible(s) and not s.candidate.effect.once])
    least = _NEAR * best[cause].gain if cause in best else np.inf
    best = {place: s for place, s in best.items() if place not in found.finding.ruled_out}
    others = sorted((s for place, s in best.items() if place != cause and s.gain > least), key=lambda s: -s.gain)
    return [score.candidate.place for score in others[:_NEAREST]]


def _of_its_kind(found: Diagnosis, cause: Candidate) -> list[Place]:
    """Other shapes of a cause's kind on its joints: on little motion all of them are the same."""
    kin = [effect for effect in CATALOGUE.values() if set(effect.shapes) & set(cause.effect.shapes) and not effect.once]
    return [(e.name, cause.joints) for e in kin if cause.joints in list(e.places(found.dataset.robot))]


def _restrained(found: Diagnosis, fit: Fit, place: Place, cause: Candidate) -> Hypothesis:
    """The forms of an effect that explain about what a cause does, kept to about its size: what these logs hardly show
    could fit at any."""
    effect = CATALOGUE[place[0]]
    size = found.finding.fit.values[found.finding.causes.index(cause)]
    energy = float(size @ _energy(fit, cause) @ size)
    made: list[tuple[float, Form]] = []
    for candidate in fit.candidates([(effect, place[1], settings) for settings in effect.settings(fit, place[1])]):
        own = np.maximum(_energy(fit, candidate).diagonal(), 1e-9)
        ridge = fit.ridge(candidate, own) + np.diag(own / (_RESTRAINT**2 * max(energy, 1e-9)))
        fitted, covariance, gain = _fitted(fit, candidate, ridge)
        if plausible(HeldOutScore(candidate, 0.0, gain, fitted)):
            made.append((gain, Form(candidate, fitted, covariance)))
    known = fit.ridge(cause, np.maximum(_energy(fit, cause).diagonal(), 1e-9))
    least = _NEAR * _fitted(fit, cause, known)[2]
    best = sorted(made, key=lambda entry: -entry[0])[:_FORMS]
    forms = [form for gain, form in best if gain > least]
    names = found.dataset.robot.joint_names
    return Hypothesis(effect.name, tuple(names[k] for k in place[1]), tuple(forms))


def _leading(found: Diagnosis) -> Iterator[OpenPair]:
    """The forms that came nearest to a gap that nothing of the catalogue closes."""
    finding, fit = found.finding, found.dataset.fit
    if finding.verdict != "unknown":
        return
    scores = [s for s in finding.steps[0].scores if plausible(s) and s.gain > finding.least]
    scores = [score for score in scores if score.candidate.place not in finding.ruled_out]
    leading = [_hypothesis(found, fit, score.candidate.place) for score in scores[:_LEADING]]
    for first, second in combinations([h for h in leading if h.forms], 2):
        yield OpenPair(first, second, fit, found.dataset.limits.equal_gain_floor)


def _untested(found: Diagnosis) -> Iterator[OpenPair]:
    finding, fit = found.finding, found.dataset.fit
    names = found.dataset.robot.joint_names
    listed = found.result["not_testable"]
    nothing = Hypothesis("none", (), ())
    count = 0
    for entry in listed:
        effect = CATALOGUE[entry["effect"]]
        joints = () if entry["joint"] is None else (names.index(entry["joint"]),)
        places = [place for place in effect.places(found.dataset.robot) if set(joints) <= set(place)]
        if effect.once or effect.shows_in != "torque" or not places:
            continue
        forms = fit.candidates([(effect, places[0], s) for s in effect.settings(fit, places[0])[:_FORMS]])
        sized = tuple(_practical(fit, form) for form in forms)
        if sized:
            least = finding.least / float(fit.count.sum())
            where = tuple(names[k] for k in places[0])
            yield OpenPair(Hypothesis(effect.name, where, sized), nothing, fit, least)
            count += 1
        if count == _MOST_UNTESTED:
            return


def _practical(fit: Fit, form: Candidate) -> Form:
    """At the size from which on it matters; where these logs show nothing of it, each parameter alone at its prior."""
    count = len(form.names)
    energy = sum((np.sum(block**2, axis=0) for block in form.blocks.values()), np.zeros(count))
    if np.all(energy > 1e-9):
        return Form(form, practical_parameters(fit, form), np.zeros((count, count)))
    deviation = np.ones(count) if form.prior is None else 1 / np.sqrt(np.diag(form.prior))
    return Form(form, deviation, np.zeros((count, count)))


def _hypothesis(found: Diagnosis, fit: Fit, place: Place) -> Hypothesis:
    """The forms of an effect at a place that explain these logs best."""
    effect = CATALOGUE[place[0]]
    wanted = [(effect, place[1], settings) for settings in effect.settings(fit, place[1])]
    cause = next((c for c in found.finding.causes if c.place == place), None)
    candidates = ([cause] if cause is not None else []) + fit.candidates(wanted)
    scores = sorted((s for s in fit.score(candidates) if plausible(s)), key=lambda s: -s.gain)
    best = best_by_place(scores).get(place)
    forms: dict[int, Form] = {}
    true: list[Form] = []
    least = found.dataset.limits.equal_gain_floor * float(fit.count.sum())
    for score in scores:
        richness = complexity(score.candidate)
        near = best is not None and score.gain > best.gain - 0.5 * abs(
            best.gain
        )  # an equal beside friction may gain none
        if best is not None and near and richness not in forms and len(forms) < _FORMS:
            ridge = fit.ridge(score.candidate, np.maximum(_energy(fit, score.candidate).diagonal(), 1e-9))
            form = forms[richness] = Form(score.candidate, score.values, _fitted(fit, score.candidate, ridge)[1])
            if score.gain >= best.gain - least:
                true.append(form)
    true = sorted(true, key=lambda form: complexity(form.candidate))[:_TRUE]
    if true and (usual := as_usual(fit, true[0].candidate, true[0].values)) is not None:
        ridge = fit.ridge(usual, np.maximum(_energy(fit, usual).diagonal(), 1e-9))
        true = [Form(usual, *_fitted(fit, usual, ridge)[:2])]
    names = found.dataset.robot.joint_names
    return Hypothesis(effect.name, tuple(names[k] for k in place[1]), tuple(forms.values()), tuple(true))


def as_usual(fit: Fit, shown: Candidate, values: np.ndarray) -> Candidate | None:
    """The form that an effect has as a rule, where motions showed this one of it with such parameters (k,)."""
    of_shown = dict(zip(shown.names, map(float, values), strict=True))
    usual = shown.effect.usually(fit.reference, shown.joints, shown.settings, of_shown)
    if usual is None:
        return None
    made = fit.candidates([(shown.effect, shown.joints, usual[0])])
    return replace(made[0], prior=usual[1]) if made else None


def _energy(fit: Fit, candidate: Candidate) -> np.ndarray:
    """(k, k) second moments of a candidate's columns over all rows."""
    ((_, (_, own)),) = fit.moments([candidate])
    return own.sum(axis=0)


def _fitted(fit: Fit, candidate: Candidate, ridge: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Its parameters (k,) under a prior precision, their covariance (k, k), the model and the effects beside it being
    fitted as well, and what they gain on independent rows."""
    ((_, (cross, own)),) = fit.moments([candidate])
    b, total = cross.sum(axis=0) / fit.repeat, own.sum(axis=0) / fit.repeat
    inverse, alone = fit.solve(np.ones(fit.cells, dtype=bool))
    information = total + ridge
    schur = information - b[:-1].T @ inverse @ b[:-1]
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    covariance = np.linalg.inv(schur * np.outer(scale, scale) + 1e-9 * np.eye(len(schur))) * np.outer(scale, scale)
    side = b[-1] - b[:-1].T @ alone
    values = covariance @ side
    return values, covariance, float(side @ values)


def _margin(found: Diagnosis, fit: Fit, sides: Sequence[Hypothesis]) -> float:
    """What the verdict asks of a cause over its rival (point 9 of docs/diagnosis.md): no less than the cause leaves;
    the true one of two leaves less."""
    left = []
    for form in (side.truths[0] for side in sides):
        energy = joint_energy(fit.with_chosen((*fit.chosen, form.candidate)))
        left.append(float(np.sum(np.maximum(energy - 1, 0)[list(form.candidate.blocks)])) / len(fit.rows))
    return max(found.dataset.limits.equal_gain_floor, min(left))
