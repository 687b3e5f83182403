"""What a verdict promises holds whatever the procedure came to."""

from __future__ import annotations

import json
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from hypothesis import given, strategies as st

from agent.diagnosis import verdict as rules
from agent.diagnosis.answer import Cause, DiagnosisResult, EffectPlace, JointShare, PathGap, TorqueGap
from agent.diagnosis.finding import Finding, class_probability
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.result import next_experiment
from agent.diagnosis.verdict import judge, settle, with_path

VERDICTS = st.sampled_from(["no_gap", "explained", "ambiguous", "unknown"])
closures = st.one_of(
    st.none(),
    st.floats(-1, 3),
    st.sampled_from([0.0, LIMITS.least_share, LIMITS.least_closure, LIMITS.explained, np.nan, -np.inf]),
)
causes = st.builds(
    Cause,
    effect=st.sampled_from(["stribeck", "interpolator_mismatch"]),
    joints=st.just(("joint_2",)),
    closure=closures,
    probability=st.floats(0.5, 1),
    parameters=st.dictionaries(st.sampled_from("ab"), st.sampled_from([0.0, 1.0, np.nan, np.inf]), max_size=2),
    equivalent_to=st.sampled_from([(), (EffectPlace("presliding", ("joint_2",)),)]),
    closure_of_joints=closures,
)


def keeps_its_promises(verdict, named, closure) -> bool:
    """The answer, as JSON has it, by docs/diagnosis.md."""
    next_one = next_experiment(named, verdict, [JointShare("joint_1", 1.0, (0.9, 1.0), ())])
    gap = TorqueGap(("joint_2",), ("nominal",), (1.0,), (0.5,), None)
    answer = DiagnosisResult(verdict, gap, PathGap(), closure, (), named, (), next_one, (), ())
    told = json.loads(json.dumps({**answer.to_dict(), "closure": None}, allow_nan=False))
    assert bool(told["causes"]) == (verdict in ("explained", "ambiguous"))
    for cause in told["causes"]:
        small = cause.get("closure_of_joints") or 0.0  # beside a large one of another joint
        assert cause["closure"] >= 0.03 or small >= 0.25, "a cause without a size is none"
        assert any(cause["parameters"].values())
        assert closure >= 0.25, "no probability without a closure"
    if verdict == "explained":
        assert closure >= 0.75
        assert not told["causes"][0]["equivalent_to"]
    if verdict == "ambiguous":
        assert told["causes"][0]["equivalent_to"]
        assert len(told["next_experiment"]["separates"]) == 2
    if verdict == "unknown":
        assert told["next_experiment"]["motion"]
    if verdict in ("explained", "no_gap"):
        assert told["next_experiment"] is None
    return True


@given(VERDICTS, st.lists(causes, max_size=3).map(tuple), closures)
def test_a_verdict_keeps_its_promises(verdict, found, closure):
    settled, named = settle(verdict, found, closure)
    assert keeps_its_promises(settled, named, closure)
    assert all(any(cause is one for one in found) for cause in named)
    if closure is None and verdict != "unknown":
        assert settled == "no_gap"
    assert settle(settled, named, closure) == (settled, named), "it is settled"


@given(VERDICTS, st.lists(causes, max_size=2).map(tuple), closures, closures, st.booleans())
def test_promises_hold_where_the_path_is_another(verdict, found, closure, of_path, path_named):
    verdict, closure = with_path(verdict, closure, of_path, path_named)
    settled, named = settle(verdict, found, closure)
    assert keeps_its_promises(settled, named, closure)


def test_two_causes_that_cancel_each_other_are_none():
    def cause(closure, joint="joint_2", effect="stribeck"):
        return Cause(effect, (joint,), closure, 0.9, {"rise": 1.0})

    hose = cause(2.3, effect="dress_pack")
    assert settle("explained", (hose, cause(2.5)), 0.95) == ("unknown", ())
    assert settle("ambiguous", (hose, cause(0.1), cause(1.7)), 0.95) == ("unknown", ())
    for other in (cause(1.0), cause(2.5, "joint_3"), cause(None), cause(np.nan)):
        assert settle("explained", (hose, other), 0.95)[0] == "explained", "one of them may be in the other's way"
        assert settle("explained", (other, hose), 0.95)[0] == "explained"


class _Fit:
    """A fit that knows its causes and no data."""

    def __init__(self, chosen=()):
        self.chosen = tuple(chosen)

    def with_chosen(self, chosen):
        return _Fit(chosen)


@given(
    verdict=st.sampled_from(["explained", "ambiguous"]),
    found=st.lists(causes, min_size=1, max_size=3),
    closings=st.lists(closures, min_size=1, max_size=4),
    other=st.booleans(),
    hardly=st.booleans(),
    small=st.booleans(),
)
def test_what_a_search_found_comes_to_an_answer_that_keeps_its_promises(verdict, found, closings, other, hardly, small):
    """Whatever is taken away: the gap is then another, and so are the causes' parts of it."""
    candidates = tuple(SimpleNamespace(place=("stribeck", (k,)), cause=cause) for k, cause in enumerate(found))
    scores = (SimpleNamespace(candidate=SimpleNamespace(place=("presliding", (0,)))),) if other else ()
    count = len(found)
    rivals = tuple(tuple((e.effect, (1,)) for e in cause.equivalent_to) for cause in found)
    steps = (SimpleNamespace(scores=scores),)
    finding = Finding(
        verdict, _Fit(candidates), candidates, rivals, (0.0,) * count, (1.0,) * count, 0.9, steps, 0.0, 0.0
    )  # type: ignore[arg-type]

    def gap_of(dataset, fit, unit=None):
        closure = closings[min(len(fit.chosen), len(closings) - 1)]
        return SimpleNamespace(closure=closure, hardly_closed=hardly, small=small)

    def told(dataset, finding, gap):
        return tuple(
            Cause(
                c.cause.effect,
                c.cause.joints,
                c.cause.closure,
                c.cause.probability,
                c.cause.parameters,
                tuple(EffectPlace(name, ("joint_2",)) for name, _ in there),
            )
            for c, there in zip(finding.causes, finding.rivals, strict=True)
        )

    dataset = SimpleNamespace(limits=LIMITS)
    with patch.object(rules, "held_out_gap", gap_of), patch.object(rules, "causes_of", told):
        judged, gap = judge(dataset, finding, _Fit())  # type: ignore[arg-type]
        named = told(dataset, judged, gap)
    assert keeps_its_promises(judged.verdict, named, gap.closure)


@given(hardly=st.booleans(), matters=st.booleans(), small=st.booleans())
def test_where_nothing_is_left_to_name_a_gap_is_said_only_if_it_matters(hardly, matters, small):
    """A push that the search took for one closes nothing: on a healthy arm that is no gap, not an unknown one."""
    push = SimpleNamespace(place=("contact", ()))
    steps = (SimpleNamespace(scores=()),)
    finding = Finding("explained", _Fit((push,)), (push,), ((),), (0.0,), (1.0,), 0.9, steps, 0.0, 0.0, matters=matters)  # type: ignore[arg-type]
    gap = SimpleNamespace(closure=0.0, hardly_closed=hardly, small=small)
    cause = Cause("contact", (), 0.01, 0.9, {"force_x": 1.0})

    def told(dataset, finding, gap):
        return (cause,) * len(finding.causes)

    with patch.object(rules, "held_out_gap", lambda *_: gap), patch.object(rules, "causes_of", told):
        judged, _ = judge(SimpleNamespace(limits=LIMITS), finding, _Fit())  # type: ignore[arg-type]
    assert judged.verdict == ("unknown" if matters and not small else "no_gap")
    assert judged.causes == ()


@given(st.floats(0, 1e6), st.floats(-0.5, 1), st.floats(-0.5, 1))
def test_what_closes_more_is_no_less_probable(margin_ratio, one, other):
    less, more = sorted((one, other))
    low, high = class_probability(margin_ratio, less), class_probability(margin_ratio, more)
    assert 0 < low <= high < 1
