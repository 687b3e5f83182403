"""From evidence to a verdict: hypotheses of known probability, and what is said of them."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.posterior import compare, posterior
from agent.diagnosis.verdict import name_causes
from agent.model import CATALOGUE
from tests.verdicts import verdict_on

JOINTS = 3
LIMIT = 4.0  # twice the usual error, squared
OFFSET, SPRING, HOSE, ASYMMETRIC = (
    (name, (0,)) for name in ("torque_offset", "gravity_spring", "dress_pack", "asymmetric_friction")
)
RIPPLE, ELSEWHERE, PAYLOAD = ("torque_ripple", (0,)), ("torque_ripple", (1,)), ("payload", ())


def log_prior(effect_keys, free) -> float:
    count = len(effect_keys) + len(free)
    if not count:
        return 0.0
    effects = [(1 - LAW.unlikely) / len(CATALOGUE) / (JOINTS if joints else 1) for _, joints in effect_keys]
    return np.log(LAW.unlikely ** (count - 1) * np.prod([*effects, *[LAW.unlikely / JOINTS] * len(free)]))


def hypothesis(share, *effect_keys, torque=(0.1, 0.1), free=(), left=0.0, scale=1.0, apart=None):
    told = {
        "share": share,
        "effect_keys": effect_keys,
        "largest": torque[: len(effect_keys)],
        "left": left,
        "free": free,
    }
    return SimpleNamespace(**told, scale=scale, apart=apart)


def evaluated(*told, kinds=lambda place: 1, observed=lambda one: 0.0):
    """Evidence and hypotheses that have these probabilities after the data; `left` is over that of nothing."""
    effect_keys = list(dict.fromkeys(place for one in told for place in one.effect_keys))
    candidates = [SimpleNamespace(key=place, joints=place[1], effect=CATALOGUE[place[0]]) for place in effect_keys]
    found = [
        SimpleNamespace(
            effects=tuple(effect_keys.index(place) for place in one.effect_keys),
            uncatalogued_sizes=dict.fromkeys(one.free, 0.1),
            log_evidence=1000 + np.log(one.share) - log_prior(one.effect_keys, one.free) - observed(one),
            largest_torque=one.largest,
            unexplained=np.array([0.5e-3, 1.5e-3]) * one.left,
            scales=np.array([0.5, one.scale]),
            told=one,
        )
        for one in told
    ]
    null = next(one for one in found if not one.effects and not one.uncatalogued_sizes)
    pool = SimpleNamespace(candidate=candidates.__getitem__, count_parameterisations=kinds)
    apart = lambda one, which: one.told.apart  # noqa: E731
    return SimpleNamespace(
        law=LAW, dof=JOINTS, null_hypothesis=null, pool=pool, usual={}, distance_from_baseline=apart
    ), found


def decided(*told, **more):
    fit = SimpleNamespace(with_chosen=lambda causes: ("with", *(cause.key for cause in causes)))
    return name_causes(compare(fit, *evaluated(*told, **more)))


@pytest.mark.parametrize("observed", [lambda one: 0.0, lambda one: -3.0 * len(one.effect_keys) - 1])
def test_probability_is_evidence_times_prior(observed):
    told = [
        *(hypothesis(0.1, left=2.0, scale=4.0), hypothesis(0.3, OFFSET, left=0.5), hypothesis(0.25, PAYLOAD)),
        *(hypothesis(0.2, OFFSET, RIPPLE), hypothesis(0.1, free=(1,)), hypothesis(0.05, PAYLOAD, free=(0, 2))),
    ]
    evidence, found = evaluated(*told, observed=observed)
    seen = posterior(evidence, found, lambda evidence, one: observed(one.told))
    assert [one.probability for one in seen] == pytest.approx([0.3, 0.25, 0.2, 0.1, 0.1, 0.05])
    assert seen == sorted(seen, key=lambda one: -round(one.probability, 6))
    for one in seen:
        prior = log_prior(one.effect_keys, one.uncatalogued_joints) - log_prior((), ())
        assert one.log_bayes_factor == pytest.approx(np.log(one.probability / 0.1) - prior)
    plain, offset = seen[3], seen[0]
    assert (plain.explained_share, plain.largest_error_ratio) == (0.0, 4.0)
    assert (offset.explained_share, offset.largest_error_ratio) == (0.75, 1.0)
    assert (offset.effect_keys, offset.largest_torque, seen[-1].uncatalogued_joints) == ((OFFSET,), (0.1,), (0, 2))


def test_of_equals_the_one_with_fewer_forms_leads():
    told = hypothesis(0.04, left=1.0), hypothesis(0.48 - 1e-7, OFFSET), hypothesis(0.48 + 1e-7, RIPPLE)
    for order in (told, told[::-1]):
        for fewer in (OFFSET, RIPPLE):
            found = decided(*order, kinds=lambda place, fewer=fewer: 1 if place == fewer else 2)
            assert [cause.key for cause in found.causes] == [fewer]


def test_the_likeliest_statement_leads_though_a_hypothesis_of_another_is_likelier():
    """Hypotheses that differ by what is too small to matter say the same."""
    fit = SimpleNamespace(with_chosen=lambda causes: ("with", *(cause.key for cause in causes)))
    told = [
        *(hypothesis(0.22, left=1.0, scale=9.0), hypothesis(0.3, OFFSET, ELSEWHERE), hypothesis(0.2, OFFSET)),
        hypothesis(0.28, OFFSET, RIPPLE, torque=(0.1, 0.001), left=0.2),
    ]

    def observed(one) -> float:
        return -3.0 * len(one.effect_keys) - 1

    evidence, found = evaluated(*told, observed=observed)
    given = {id(evidence): observed}
    seen = compare(fit, evidence, found, lambda of, one: given[id(of)](one.told), {"dress_pack"})
    assert [cause.key for cause in seen.causes] == [OFFSET]
    assert (seen.plain, seen.fit, seen.evidence, seen.ignored) == (fit, ("with", OFFSET), evidence, {"dress_pack"})
    assert seen.explained_share == pytest.approx(0.8)


def test_what_the_healthy_arm_has_and_what_is_too_small_are_both_no_fault():
    evidence, found = evaluated(hypothesis(0.5, left=1.0), hypothesis(0.5, OFFSET, torque=(0.0029,)))
    evidence.usual = {OFFSET: 0.001}
    seen = compare("fit", evidence, found)
    assert (seen.fit, seen.causes, seen.healthy) == ("fit", (), pytest.approx(1.0))


@pytest.mark.parametrize(
    ("plain", "scale", "offset", "verdict"),
    [
        (0.06, 0.99 * LIMIT, {}, "no_gap"),
        (0.04, 0.99 * LIMIT, {}, "explained"),
        (0.06, LIMIT, {}, "explained"),
        (0.04, 0.99 * LIMIT, {"torque": (0.0029,)}, "no_gap"),
        (0.04, 0.99 * LIMIT, {"torque": (0.003,)}, "explained"),
        (0.04, LIMIT, {"torque": (0.0029,)}, "unknown"),
        (0.04, 9.0, {"left": 0.24}, "explained"),
        (0.04, 9.0, {"left": 0.26}, "unknown"),
        (0.35, 9.0, {}, "explained"),
        (0.38, 9.0, {}, "unknown"),
        (0.04, 9.0, {"free": (2,)}, "explained"),
    ],
)
def test_a_cause_is_named_if_likely_large_and_enough(plain, scale, offset, verdict):
    found = decided(hypothesis(plain, left=1.0, scale=scale), hypothesis(1 - plain, OFFSET, **offset))
    assert verdict_on(found) == verdict
    is_named = verdict == "explained"
    assert [cause.key for cause in found.causes] == ([OFFSET] if is_named else [])
    assert (found.fit == ("with", OFFSET)) is is_named
    assert found.probability == (pytest.approx((0.95 * (1 - plain),)) if is_named else ())
    assert found.healthy == pytest.approx(1.0 if offset.get("torque") == (0.0029,) else plain)
    elsewhere = decided(hypothesis(0.04, left=1.0, scale=scale), hypothesis(0.96, free=(1,)))
    assert verdict_on(elsewhere) == "unknown"


def test_what_replaces_a_cause_on_its_joints_is_its_class():
    """From a tenth of its probability on; the two likeliest are listed and count."""
    told = [(0.6, OFFSET), (0.059, RIPPLE), (0.09, ELSEWHERE), (0.03, SPRING), (0.031, SPRING, ELSEWHERE)]
    for more, rivals in (
        ({}, [SPRING]),
        ({PAYLOAD: 0.08}, [PAYLOAD, SPRING]),
        ({PAYLOAD: 0.08, HOSE: 0.07}, [PAYLOAD, HOSE]),
    ):
        others = [hypothesis(*one) for one in (*told, *((share, place) for place, share in more.items()))]
        found = decided(hypothesis(0.19 - sum(more.values()), left=1.0, scale=9.0), *others)
        assert (verdict_on(found), found.rivals) == ("ambiguous", (tuple(rivals),))
        assert found.probability == pytest.approx((0.95 * (0.6 + sum({SPRING: 0.061, **more}[one] for one in rivals)),))
    found = decided(hypothesis(0.04, left=1.0, scale=9.0), hypothesis(0.5, OFFSET), hypothesis(0.46, SPRING, RIPPLE))
    assert (found.rivals, found.probability) == (((SPRING, RIPPLE),), pytest.approx((0.95,)))


def test_equals_are_listed_by_name():
    """Else the order of a set is that of the process, and two runs on the same logs differ."""
    plain = hypothesis(0.04, left=1.0, scale=9.0)
    for pair in combinations(sorted((*(SPRING, HOSE, ASYMMETRIC, RIPPLE), ("stribeck", (0,)))), 2):
        assert decided(plain, hypothesis(0.5, OFFSET), hypothesis(0.46, *pair)).rivals == (pair,)
        assert [cause.key for cause in decided(plain, hypothesis(0.96, *pair)).causes] == list(pair)


def test_each_cause_has_a_class_and_the_largest_comes_first():
    both, more = hypothesis(0.6, OFFSET, ELSEWHERE, torque=(0.1, 0.2)), hypothesis(0.1, OFFSET)
    other = hypothesis(0.1, ASYMMETRIC, ELSEWHERE), hypothesis(0.16, OFFSET, SPRING)
    found = decided(hypothesis(0.04, left=1.0, scale=9.0), both, more, *other)
    assert [cause.key for cause in found.causes] == [ELSEWHERE, OFFSET]
    assert found.probability == pytest.approx((0.95 * 0.7, 0.95 * 0.96))
    assert (verdict_on(found), found.rivals) == ("explained", ((), (ASYMMETRIC,)))
    again = found.with_rival(1, SPRING).with_rival(1, SPRING)
    assert (again.rivals, again.causes, again.fit) == (((), (SPRING, ASYMMETRIC)), found.causes, found.fit)
    assert (found.keeping([1]).fit, found.keeping(()).fit) == (("with", OFFSET), found.plain)


@pytest.mark.parametrize(("apart", "rivals"), [(0.049, (HOSE,)), (0.051, ())])
def test_what_equals_a_cause_by_definition_and_gains_about_as_much_is_its_rival(apart, rivals):
    plain = 1e-80
    gain = np.log(0.7 / plain) - log_prior((SPRING,), ()) + log_prior((), ())
    share, small = 0.7 * np.exp(-apart * gain), {"torque": (0.001, 0.1)}
    others = [hypothesis(share, *one) for one in ((RIPPLE,), (("dress_pack", (1,)),), (SPRING, RIPPLE))]
    told = hypothesis(0.7, SPRING), hypothesis(0.3, ELSEWHERE), hypothesis(share, HOSE, **small)
    found = decided(hypothesis(plain, left=1.0, scale=9.0), *told, *others)
    assert (found.rivals, found.probability) == ((rivals,), pytest.approx((0.95 * 0.7,), rel=1e-3))


@pytest.mark.parametrize(("other", "rivals"), [(RIPPLE, (RIPPLE,)), (ELSEWHERE, None)])
def test_a_cause_whose_equal_was_ignored_has_the_likeliest_other_one_as_its_rival(other, rivals):
    """There is a gap, but no name for it, where no other hypothesis is on the same joint."""
    fit = SimpleNamespace(with_chosen=list)
    told = hypothesis(0.05, left=1.0), hypothesis(0.9, OFFSET), hypothesis(0.05, other)
    found = name_causes(compare(fit, *evaluated(*told), ignored={"asymmetric_friction"}))
    assert (found.rivals, found.leaves_gap) == (((rivals,), False) if rivals else ((), True))
    assert name_causes(compare(fit, *evaluated(*told), ignored={"stribeck"})).rivals == ((),)


def test_a_hundred_hypotheses_are_kept_and_that_of_nothing():
    many = [hypothesis(0.009 - 1e-5 * k, ("torque_ripple", (k,))) for k in range(101)]
    found = decided(hypothesis(0.005, left=1.0, scale=9.0), *many, hypothesis(0.9, OFFSET))
    assert len(found.hypotheses) == 101
    assert [one.effect_keys for one in found.hypotheses[:2]] == [(OFFSET,), (("torque_ripple", (0,)),)]
    assert found.hypotheses[-1].effect_keys == ()
    assert len(decided(hypothesis(0.1, left=1.0), hypothesis(0.9, OFFSET)).hypotheses) == 2


@pytest.mark.parametrize(("times", "likely"), [(1.0, True), (4.0, False), (12.0, True)])
def test_a_healthy_arm_may_have_more_than_usual_of_what_it_has_already(times, likely):
    """Within the usual the noise model knows it; a few times as much is in the tails of Student's t, and no more."""
    size = 0.01 * times
    evidence, found = evaluated(hypothesis(0.01, left=1.0), hypothesis(0.99, OFFSET, torque=(size,)))
    evidence.usual = {OFFSET: 0.01}
    shares = {one.effect_keys: one for one in posterior(evidence, found)}[OFFSET,].shares
    tail = stats.t.pdf(size, LAW.nu, scale=0.01 * np.sqrt(1 - 2 / LAW.nu)) - stats.norm.pdf(size, scale=0.01)
    odds = max(tail, 0) / stats.norm.pdf(size, scale=size) * np.exp(log_prior((), ()) - log_prior((OFFSET,), ()))
    assert shares.get(frozenset(), 0.0) == pytest.approx(odds * shares[frozenset({OFFSET})])
    assert (shares[frozenset({OFFSET})] > LAW.sure) is likely
    decision = name_causes(compare(SimpleNamespace(with_chosen=list), evidence, found))
    assert verdict_on(decision) == ("explained" if likely else "no_gap")


@pytest.mark.parametrize(("apart", "verdict"), [((0.0005, 0.001), "no_gap"), ((0.006, 0.001), "explained")])
def test_what_equals_the_baselines_own_is_no_fault(apart, verdict):
    """Twelve times the usual is a fault, unless the baseline had as much."""
    evidence, found = evaluated(hypothesis(0.01, left=1.0), hypothesis(0.99, OFFSET, torque=(0.12,), apart=apart))
    evidence.usual = {OFFSET: 0.01}
    assert verdict_on(name_causes(compare(SimpleNamespace(with_chosen=list), evidence, found))) == verdict
