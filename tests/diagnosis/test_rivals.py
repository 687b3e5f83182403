"""Which forms count as equal: what two of them share exactly is no matter of form, and a rich one imitates anything."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from agent.diagnosis.candidate import Candidate, HeldOutScore
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.nameable import Nameable
from agent.diagnosis.rivals import as_good, equals_by_definition, exact_in_both, gain_at_best, gain_by_form, trusted
from agent.model import CATALOGUE

ARM = SimpleNamespace(scale=np.full(3, 100.0))
OFFSET, SPRING, HOSE = ("torque_offset", (1,)), ("gravity_spring", (1,)), ("dress_pack", (1,))
ONE_SIDED = ("asymmetric_friction", (1,))
LINE, CURVE = {}, {"low": -1.0, "high": 1.0}


def score(place, gain: float, **settings) -> HeldOutScore:
    effect, joints = CATALOGUE[place[0]], place[1]
    names = effect.names(settings)
    return HeldOutScore(Candidate(effect, joints, settings, names, {}, None, ARM), 0.0, gain, np.full(len(names), 0.1))


def places(*scores: HeldOutScore) -> dict:
    return {one.candidate.place: one for one in scores}


def test_a_constant_is_part_of_an_offset_a_spring_and_a_hose_on_one_joint():
    assert exact_in_both(SPRING, HOSE) == exact_in_both(OFFSET, SPRING) == exact_in_both(ONE_SIDED, HOSE) == OFFSET
    assert exact_in_both(SPRING, ("dress_pack", (2,))) is None
    assert exact_in_both(("stribeck", (1,)), ("thermal_friction", (1,))) is None, "no form of friction is exact"
    assert all(not effect.exact or len(effect.names({})) == 1 for effect in CATALOGUE.values())


def test_only_beyond_what_is_exact_can_a_form_err():
    known = places(score(OFFSET, 980.0), score(SPRING, 1000.0, harmonics=1.0))
    assert gain_by_form(LIMITS, 1000.0, known, SPRING, OFFSET) == 20.0
    assert gain_by_form(LIMITS, 1000.0, known, SPRING, ("payload", ())) == 1000.0
    assert gain_by_form(LIMITS, 1000.0, known, SPRING, HOSE) == 20.0, "a spring's straight line has its own constant"
    assert gain_by_form(LIMITS, 1000.0, known, HOSE, SPRING) == 1000.0, "a curve through anything shows nothing by it"
    assert gain_by_form(LIMITS, 500.0, known, SPRING, OFFSET) == 0.0


@pytest.mark.parametrize(("gain", "by_form"), [(981.0, 20.0), (990.0, 1000.0)])
def test_friction_by_direction_that_explains_no_more_than_the_constant_is_taken_for_it(gain, by_form):
    """Its form errs around reversals only, and what a spring has beside the constant is not hidden by that."""
    spring, one_sided = score(SPRING, 1000.0, harmonics=1.0), score(ONE_SIDED, gain, coulomb=1.0)
    known = places(score(OFFSET, 980.0), spring, one_sided)
    assert gain_by_form(LIMITS, 1000.0, known, SPRING, ONE_SIDED) == by_form
    assert (gain_by_form(LIMITS, gain, known, ONE_SIDED, SPRING) == gain) is (by_form == 1000.0)


def test_a_large_constant_does_not_hide_what_a_spring_has_beside_it():
    """Four parts in a hundred of the whole: a constant leaves many times the background there."""
    offset, spring = score(OFFSET, 970.0), score(SPRING, 1000.0, harmonics=2.0)
    assert not as_good(LIMITS, offset, spring, 5.0, places(offset, spring))
    assert as_good(LIMITS, score(OFFSET, 996.0), spring, 5.0, places(score(OFFSET, 996.0), spring))
    payload = score(("payload", ()), 997.5)
    assert as_good(LIMITS, payload, spring, 1.0, places(offset, spring, payload)), "of another kind as before"


@pytest.mark.parametrize(("gain", "equal"), [(993.0, True), (985.0, False)])
def test_a_curve_through_anything_needs_more_than_what_a_real_spring_has_beside_its_law(gain, equal):
    hose, spring = score(HOSE, 1000.0, **CURVE), score(SPRING, gain, harmonics=2.0)
    assert as_good(LIMITS, spring, hose, 1.0, places(hose, spring)) is equal
    ripple = score(("torque_ripple", (1,)), gain, harmonics=2.0)
    assert not as_good(LIMITS, ripple, hose, 1.0, places(hose, ripple)), "of another kind as before"
    assert not as_good(LIMITS, score(HOSE, gain, **CURVE), score(SPRING, 1000.0, harmonics=2.0), 1.0, {})


@pytest.mark.parametrize(("gain", "equal"), [(930.0, True), (890.0, False)])
def test_a_string_of_pushes_has_to_be_better_by_a_tenth_than_what_repeats(gain, equal):
    """Each is somewhere for as long as it fits, so together they follow what a real spring has beside its law."""
    pushes = score(("contact", ()), 1000.0, log_1=0.0, link_1=1.0, log_2=0.0, link_2=1.0)
    spring = score(SPRING, gain, harmonics=1.0)
    assert as_good(LIMITS, spring, pushes, 1.0, places(pushes, spring)) is equal
    assert trusted(LIMITS, pushes.candidate, SPRING, LIMITS.indistinguishable_gain) == LIMITS.equal_gain_of_pushes
    assert trusted(LIMITS, spring.candidate, ("contact", ()), 0.003) == 0.003, "not the other way round"


@pytest.mark.parametrize(("left", "better"), [(500.0, True), (700.0, False)])
def test_what_happens_once_is_not_named_where_what_repeats_does_better_held_out_alike(left, better):
    """A law of position that may be the model's own is not named; the pushes that follow it are no better known."""
    push, spring = score(("contact", ()), 400.0), score(SPRING, 300.0, harmonics=1.0)
    errors = {push.candidate: 600.0, spring.candidate: left}
    fit = SimpleNamespace(
        chosen=(),
        with_chosen=lambda chosen: SimpleNamespace(error=lambda single: errors[chosen[-1]] if single else 0.0),
    )
    rules = Nameable(LIMITS, set(CATALOGUE), True, np.zeros((1, 1), dtype=bool), None)
    assert rules.repeats_better(fit, push, [push, spring]) is better
    assert not rules.repeats_better(fit, push, [push]), "nothing repeats"


def test_friction_by_direction_is_as_good_as_the_offset_that_it_is_while_the_joint_slides():
    offset, one_sided = score(OFFSET, 1000.0), score(ONE_SIDED, 998.0, coulomb=1.0)
    assert gain_at_best(LIMITS, one_sided, places(offset, one_sided), OFFSET) == 1000.0
    refuted = score(ONE_SIDED, 900.0, coulomb=1.0)
    assert gain_at_best(LIMITS, refuted, places(offset, refuted), OFFSET) == 900.0


@pytest.mark.parametrize(("line", "equal"), [(999.0, True), (800.0, False)])
def test_a_curve_through_anything_is_no_evidence_for_a_hose(line, equal):
    """It equals a spring where its straight form does, not where it takes four parameters more."""
    spring = score(SPRING, 1000.0, harmonics=1.0)
    forms = {SPRING: [spring], HOSE: [score(HOSE, 1000.0, **CURVE), score(HOSE, line, **LINE)]}
    fit = SimpleNamespace(
        score=lambda some: [one for found in forms.values() for one in found if one.candidate in some],
        reference=SimpleNamespace(robot=None),
        chosen=(),
    )
    tried = [one.candidate for found in forms.values() for one in found]
    known = places(spring, forms[HOSE][0])
    margins = dict.fromkeys(known, 10.0)
    found = equals_by_definition(LIMITS, fit, tried, spring.candidate, 1000.0, margins, known)
    assert (HOSE in found) is equal


@pytest.mark.parametrize(
    ("settings", "offset", "equal"),
    [
        ({"coulomb": 1.0}, 970.0, True),
        ({"coulomb": 1.0}, 900.0, False),
        ({"coulomb": 1.0, "viscous": 1.0}, 970.0, False),
    ],
)
def test_what_friction_by_direction_has_over_an_offset_at_rest_is_no_evidence(settings, offset, equal):
    one_sided = score(ONE_SIDED, 1000.0, **settings)
    fit = SimpleNamespace(score=lambda some: [], reference=SimpleNamespace(robot=None), chosen=())
    known = places(one_sided, score(OFFSET, offset))
    margins = dict.fromkeys(known, 10.0)
    found = equals_by_definition(LIMITS, fit, [], one_sided.candidate, 1000.0, margins, known)
    assert (OFFSET in found) is equal


@pytest.mark.parametrize(
    ("settings", "offset", "equal"),
    [({"harmonics": 1.0}, 970.0, False), ({"harmonics": 1.0}, 0.0, True), ({"harmonics": 2.0}, 970.0, True)],
)
def test_a_curve_that_a_sine_has_without_a_parameter_for_it_is_no_hose(settings, offset, equal):
    """What a straight line leaves of it is little beside the whole, but a sixth of what there is beside the constant.
    A spring that takes as many parameters as a cubic has nothing ahead of it."""
    spring = score(SPRING, 1000.0, **settings)
    bent = {"middle": 0.0, "reach": 1.0}
    forms = [spring, score(HOSE, 995.0, **LINE), score(HOSE, 1000.0, **bent)]
    fit = SimpleNamespace(
        score=lambda some: [one for one in forms if one.candidate in some],
        reference=SimpleNamespace(robot=None),
        chosen=(),
        count=np.array([100.0]),
    )
    known = places(score(OFFSET, offset), spring, forms[2])
    tried = [one.candidate for one in forms]
    margin = max(2.0, LIMITS.equal_shape_gain * gain_by_form(LIMITS, 1000.0, known, SPRING, HOSE))
    found = equals_by_definition(LIMITS, fit, tried, spring.candidate, 1000.0, dict.fromkeys(known, margin), known)
    assert (HOSE in found) is equal


def test_of_a_spring_and_a_hose_the_simpler_one_is_not_trusted_further_either():
    """A hose that neither hardens nor rubs is a spring: its straight line gains what that one's does."""
    alike = LIMITS.indistinguishable_gain
    for cause, other, settings in ((HOSE, SPRING, CURVE), (SPRING, HOSE, {"harmonics": 2.0}), (HOSE, SPRING, LINE)):
        assert trusted(LIMITS, score(cause, 1.0, **settings).candidate, other, alike) == LIMITS.equal_shape_gain
    hose = score(HOSE, 1.0, **LINE).candidate
    assert trusted(LIMITS, hose, ("gravity_spring", (2,)), alike) == alike, "on another joint"
    assert trusted(LIMITS, hose, OFFSET, alike) == alike, "a constant is exact"
    assert trusted(LIMITS, hose, SPRING, LIMITS.equal_gain) == LIMITS.equal_gain, "where numbers were moved"
