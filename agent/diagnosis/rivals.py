"""Which forms do as well as another: how far forms can be trusted, and which of them could imitate anything."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from agent.diagnosis.candidate import Candidate, HeldOutScore, Where
from agent.diagnosis.excess import possible_together
from agent.diagnosis.fit import Fit
from agent.diagnosis.isolability import complexity, plausible, structurally_equivalent
from agent.diagnosis.limits import DecisionLimits
from agent.diagnosis.needs import Excursions
from agent.model import CATALOGUE

Places = Mapping[Where, HeldOutScore]


def exact_in_both(first: Where, second: Where) -> Where | None:
    """The place of an exact special case that two places have in common, or that one of them is: a constant, on one
    joint, is part of an offset, of a spring and of a hose alike."""
    if first[1] != second[1]:
        return None
    a, b = ({name, *CATALOGUE[name].special_cases} for name, _ in (first, second))
    return next(((name, first[1]) for name in sorted(a & b) if CATALOGUE[name].exact), None)


def gain_by_form(limits: DecisionLimits, gain: float, best: Places, first: Where, second: Where) -> float:
    """Of the gain of one of two places, without that of what they have in common, where one of them is exactly that or
    explains no more, or the first is the plainer of two laws of position: only beyond it a form errs. Of others that
    both explain more, both forms err in all they explain."""
    both = exact_in_both(first, second)
    if both is None or both not in best:
        return gain
    exact = max(best[both].gain, 0.0)
    no_more = (1 + limits.indistinguishable_gain) * exact
    one, other = CATALOGUE[first[0]], CATALOGUE[second[0]]
    plainer = other.name in one.structurally_equivalent and one.complexity_penalty < other.complexity_penalty
    if plainer or both in (first, second) or any(best[at].gain <= no_more for at in (first, second) if at in best):
        return gain - min(exact, gain)
    return gain


def trusted(limits: DecisionLimits, cause: Candidate, other: Where, alike: float) -> float:
    """The share of a gain by which a cause has to be better than another place; `alike` that of unlike forms.

    Two laws of position that equal each other by definition are trusted to a tenth of their torque: a spring between
    pivots is neither a sine nor a straight line. What happens once has to be better by more than what repeats: a string
    of pushes, each somewhere for as long as it fits, follows whatever a law has beside its form.
    """
    effect, rival = cause.effect, CATALOGUE[other[0]]
    same = other[1] == cause.joints and rival.name in effect.structurally_equivalent
    laws = all("position" in one.shapes and not one.exact for one in (effect, rival))
    if effect.once and not rival.once:
        return max(alike, limits.equal_gain_of_pushes)
    return max(alike, limits.equal_shape_gain) if same and laws else alike


def gain_at_best(limits: DecisionLimits, score: HeldOutScore, best: Places, other: Where) -> float:
    """A score's gain, and no less than that of the exact part that it has in common with another place, as far as forms
    are trusted: friction by direction is an offset while the joint slides, whatever its form around a reversal."""
    both = exact_in_both(score.candidate.place, other)
    if both is None or both not in best:
        return score.gain
    exact = best[both].gain
    return max(score.gain, exact) if exact - score.gain <= limits.indistinguishable_gain * exact else score.gain


def as_good(limits: DecisionLimits, score: HeldOutScore, best: HeldOutScore, least: float, places: Places) -> bool:
    """Whether a score falls behind the best by no more than `least`, or than forms are trusted.

    A law that equals a freer one by definition, a spring and a curve through any torque over position, is trusted to a
    tenth of its torque: the freer one follows whatever a real spring has beside its law. So does a string of pushes.
    """
    far = complexity(score.candidate) <= complexity(best.candidate) / limits.simpler_ratio
    freer = complexity(score.candidate) < complexity(best.candidate) and structurally_equivalent(best.candidate, score)
    share = limits.equal_gain if far else limits.equal_shape_gain if freer else limits.indistinguishable_gain
    if far and best.candidate.effect.once and not score.candidate.effect.once:
        share = limits.equal_gain_of_pushes
    by_form = gain_by_form(limits, best.gain, places, best.candidate.place, score.candidate.place)
    return best.gain - gain_at_best(limits, score, places, best.candidate.place) <= max(least, share * by_form)


def special_case_as_good(limits: DecisionLimits, rows: float, score: HeldOutScore, limit: str, places: Places) -> bool:
    """Whether a simpler limit of a form does as well, so that the form has nothing to show for itself."""
    joints, place = score.candidate.joints, score.candidate.place
    there = [(limit, ())] if CATALOGUE[limit].scope != "joint" else [(limit, (j,)) for j in joints]
    most = complexity(score.candidate)  # a limit with a reversal of its own may be no simpler
    simpler = [places[at] for at in there if at in places and plausible(places[at])]
    simpler = [other for other in simpler if complexity(other.candidate) <= most]
    least, share = limits.equal_gain_floor * rows, 0.5 * limits.equal_gain
    return any(
        score.gain - other.gain
        < max(least, share * gain_by_form(limits, score.gain, places, place, other.candidate.place))
        for other in simpler
    )


def offset_and_friction_as_good(
    limits: DecisionLimits, fit: Fit, score: HeldOutScore, forms: Sequence[Candidate], places: Places
) -> bool:
    """Whether a form of a joint with several parameters is no more than a torque offset and another level of friction.

    A hose that rubs and does not pull is both by another name, and so is a gear with another loss each way under a
    load that hardly changes. A spring that hardly changes over its joint's travel is not: what it has beside a constant
    has to be friction.
    """
    law = score.candidate
    shifts = [name for name, effect in CATALOGUE.items() if effect.shifts]
    basic = [[form for form in forms if form.place == (name, law.joints)] for name in shifts]
    simpler = {*law.effect.special_cases, *law.effect.simpler(law.settings, fit.reference.robot)}
    itself = law.effect.shifts or law.effect.rivals_special_cases
    if itself or len(law.names) < len(shifts) or simpler.isdisjoint(shifts):
        return False
    left = fit.with_chosen((*fit.chosen, law)).error()
    pairs = (pair for pair in product(*basic) if sum(len(form.names) for form in pair) <= len(law.names))
    least = limits.equal_gain_floor * float(fit.count.sum())
    by_form = [gain_by_form(limits, score.gain, places, law.place, (name, law.joints)) for name in shifts]
    as_good = max(least, limits.equal_gain * min(by_form))
    return any(fit.with_chosen((*fit.chosen, *pair)).error() - left < as_good for pair in pairs)


def may_follow_position(limits: DecisionLimits, fit: Fit, score: HeldOutScore, excursions: Excursions) -> bool:
    """Whether a law of position takes away as much, on a joint that travels too little for it to be named."""
    wanted = [
        (effect, (joint,), settings)
        for effect in CATALOGUE.values()
        for joint in score.candidate.blocks
        if effect.scope == "joint" and "position" in effect.shapes and excursions.moved[joint]
        if excursions.travel[joint] < effect.needs_travel
        for settings in effect.settings(fit, (joint,))
    ]
    laws = fit.score(fit.candidates(wanted))
    return any(law.gain >= (1 - limits.equal_gain) * score.gain for law in laws)


def only_steps(limits: DecisionLimits, fit: Fit, score: HeldOutScore) -> bool:
    """Whether something fades within one log, and its simpler forms with parameters of each log's own do as well.

    Held out by short segments it could stand for anything that this log has and the others have not.
    """
    fading = score.candidate
    if not fading.once or fading.effect.once:
        return False
    reversal = {key: value for key, value in fading.settings.items() if key == "reversal_travel"}
    wanted = [
        (CATALOGUE[limit], fading.joints, {**settings, **reversal})
        for limit in fading.effect.special_cases
        for settings in CATALOGUE[limit].settings(fit, fading.joints)
    ]
    log = np.concatenate([np.full(len(s.time[s.kept]), s.log_index) for s in fit.signals])
    of_log = (log[:, None] == np.unique(log)).astype(float)
    steps = [
        replace(
            fading,
            names=tuple(f"{name}_{number}" for name in plain.names for number in range(of_log.shape[1])),
            blocks={
                joint: (block[:, :, None] * of_log[:, None]).reshape(len(log), -1)
                for joint, block in plain.blocks.items()
            },
        )
        for plain in fit.candidates(wanted)
    ]
    return any(score.gain - other.gain < limits.equal_gain * score.gain for other in fit.score(steps))


def equals_by_definition(
    limits: DecisionLimits,
    fit: Fit,
    forms: Sequence[Candidate],
    cause: Candidate,
    lost: float,
    margins: Mapping[Where, float],
    places: Places,
) -> list[Where]:
    """Places that equal a cause by definition and do as well, with one parameter more than its simplest form at most.

    A curve through anything imitates whatever is there: that it can is no evidence for it (Occam's razor). A hose that
    rubs is equalled by a spring too, if the joint may rub more beside that; and so is a spring by a hose, where more
    friction was found beside it.

    Args:
        fit: without the cause, which loses `lost`; forms: all that were tried; margins: by so much does each place have
            to be worse.
    """

    def simplest(place: Where, gain: float) -> float:
        there = [score for score in fit.score([form for form in forms if form.place == place]) if plausible(score)]
        return min((complexity(score.candidate) for score in there if score.gain >= gain), default=float("inf"))

    found = []
    for place, score in places.items():
        enough = lost - margins[place]
        if structurally_equivalent(cause, score) and gain_at_best(limits, score, places, cause.place) >= enough:
            mine = min(simplest(cause.place, enough), complexity(cause))
            if simplest(place, min(enough, score.gain)) <= mine + 1:
                found.append(place)
    sure = _margin_of_rubbing(limits, fit, forms, cause, lost, places)
    beside = [
        place
        for place, gain in _beside_friction(fit, forms, cause)
        if gain >= lost - min(sure, margins.get(place, 0.0))
    ]
    beside += _while_it_slides(limits, cause, lost, places)
    rubs = any(c.joints == cause.joints and c.effect.shifts and "speed" in c.effect.shapes for c in fit.chosen)
    if rubs and "position" in cause.effect.shapes:
        beside += [(name, cause.joints) for name in cause.effect.structurally_equivalent]
    return list(dict.fromkeys([*found, *beside]))


def _while_it_slides(limits: DecisionLimits, cause: Candidate, lost: float, places: Places) -> list[Where]:
    """The exact form that a cause of one parameter is while its joint slides, if it does about as well: what is better
    at rest is none the better, as stiction leaves the torque open there."""
    if not cause.effect.rivals_special_cases or complexity(cause) > 1:
        return []
    exact = [(name, cause.joints) for name in cause.effect.special_cases if CATALOGUE[name].exact]
    return [place for place in exact if place in places and lost - places[place].gain <= limits.equal_gain * lost]


def _margin_of_rubbing(
    limits: DecisionLimits, fit: Fit, forms: Sequence[Candidate], cause: Candidate, lost: float, places: Places
) -> float:
    """By so much has a law without rubbing, and friction of the joint beside it, to be worse than a cause that rubs
    and takes a way of its own to turn around; infinite where that is not sure.

    How far the form of a pull is trusted says nothing of how it turns around.
    """
    constant = next((name for name in cause.effect.special_cases if CATALOGUE[name].exact), None)
    of_place = [form for form in forms if form.place == cause.place]
    ways = [form.settings[way] for form in of_place for way in cause.effect.refined if way in form.settings]
    at_once = min(ways, default=0.0)
    plain = [form for form in of_place if all(form.settings.get(way, 0.0) <= at_once for way in cause.effect.refined)]
    exact = places.get((constant, cause.joints)) if constant is not None else None
    if exact is None or not plain:
        return float("inf")
    margin = max(
        limits.equal_gain_floor * float(fit.count.sum()), limits.equal_shape_gain * max(lost - exact.gain, 0.0)
    )
    without = max((score.gain for score in fit.score(plain)), default=0.0)
    return margin if without < lost - margin else float("inf")


def _beside_friction(fit: Fit, forms: Sequence[Candidate], cause: Candidate) -> Iterator[tuple[Where, float]]:
    """Of a law of position that rubs, the places of what equals it without rubbing, and what each gains (Σ e² / σ²)
    with a simpler law of the joint's friction beside it: inner friction that turns around at once is the joint's too.
    """
    effect = cause.effect
    levels = set(effect.simpler(cause.settings, fit.reference.robot)) - set(effect.special_cases)
    if "position" not in effect.shapes:
        return
    of_joint = [form for form in forms if form.joints == cause.joints]
    laws = [form for form in of_joint if form.effect.name in effect.structurally_equivalent]
    for law, level in product(laws, [form for form in of_joint if form.effect.name in levels]):
        pair = fit.with_chosen((*fit.chosen, law, level))
        if possible_together(pair):
            yield law.place, fit.error() - pair.error()
