"""The conditions of a verdict hold for every result of the search."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from hypothesis import given, strategies as st

from agent.diagnosis import verdict as rules
from agent.diagnosis.answer import Cause, DiagnosisResult, EffectPlace, JointShare, PathGap, TorqueGap
from agent.diagnosis.hypotheses.finding import Finding, Hypothesis
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.result import next_experiment
from agent.diagnosis.verdict import judge, settle, with_path

VERDICTS = st.sampled_from(["no_gap", "explained", "ambiguous", "unknown"])
closures = st.one_of(
    st.none(),
    st.floats(-1, 3),
    st.sampled_from([0.0, LIMITS.least_share, LIMITS.explained, np.nan, -np.inf]),
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
        of_joints = cause.get("closure_of_joints") or 0.0  # next to a large one of another joint
        assert max(cause["closure"], of_joints) >= 0.03, "a cause without a size is none"
        assert any(cause["parameters"].values())
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
def test_a_verdict_meets_its_contract(verdict, found, closure):
    settled, named = settle(verdict, found, closure)
    assert keeps_its_promises(settled, named, closure)
    assert all(any(cause is one for one in found) for cause in named)
    if closure is None and verdict != "unknown":
        assert settled == "no_gap"
    assert settle(settled, named, closure) == (settled, named), "it is settled"


@given(VERDICTS, st.lists(causes, max_size=2).map(tuple), closures, closures, st.booleans())
def test_the_contract_holds_with_another_path(verdict, found, closure, of_path, path_named):
    verdict, closure = with_path(verdict, closure, of_path, path_named)
    settled, named = settle(verdict, found, closure)
    assert keeps_its_promises(settled, named, closure)


class _Fit:
    """A fit that knows its causes and no data."""

    def __init__(self, chosen=()):
        self.chosen = tuple(chosen)

    def with_chosen(self, chosen):
        return _Fit(chosen)


def found_by_a_search(verdict, candidates, rivals, scale=1.0, runner_up=()):
    """A finding over two hypotheses: the causes, and nothing, with a squared error of `scale` times the noise."""
    plain = Hypothesis((), (), 0.0, {}, (), 0.0, scale)
    best = Hypothesis(candidates, (), 9.0, {}, (0.1,) * len(candidates), 1.0, 1.0)
    others = (Hypothesis(runner_up, (), 5.0, {}, (0.1,), 1.0, 1.0),) if runner_up else ()
    evidence = SimpleNamespace(law=LAW)
    return Finding(
        verdict, _Fit(candidates), candidates, rivals, (0.9,) * len(candidates), (best, *others, plain), evidence
    )  # type: ignore[arg-type]


def judged_by(finding, gap_of, told):
    """A finding as it is judged where fits have these gaps, and findings these causes."""
    with patch.object(rules, "held_out_gap", gap_of), patch.object(rules, "causes_of", told):
        return judge(SimpleNamespace(limits=LIMITS), finding, _Fit())  # type: ignore[arg-type]


@given(
    verdict=st.sampled_from(["explained", "ambiguous"]),
    found=st.lists(causes, min_size=1, max_size=3),
    closings=st.lists(closures, min_size=1, max_size=4),
    other=st.booleans(),
    scale=st.sampled_from([1.0, 10.0]),
)
def test_every_search_result_gives_an_answer_that_meets_the_contract(verdict, found, closings, other, scale):
    """Whatever is taken away: the gap is then another, and so are the causes' parts of it."""
    candidates = tuple(SimpleNamespace(place=("stribeck", (k,)), cause=cause) for k, cause in enumerate(found))
    runner_up = (SimpleNamespace(place=("presliding", (0,))),) if other else ()
    rivals = tuple(tuple((e.effect, (1,)) for e in cause.equivalent_to) for cause in found)
    finding = found_by_a_search(verdict, candidates, rivals, scale, runner_up)

    def gap_of(dataset, fit, unit=None):
        return SimpleNamespace(closure=closings[min(len(fit.chosen), len(closings) - 1)])

    def told(dataset, finding, gap):
        there = [tuple(EffectPlace(name, ("joint_2",)) for name, _ in rivals) for rivals in finding.rivals]
        named = zip((c.cause for c in finding.causes), there, strict=True)
        return tuple(replace(cause, equivalent_to=equal, closure_of_joints=None) for cause, equal in named)

    judged, gap = judged_by(finding, gap_of, told)
    named = told(None, judged, gap)
    assert keeps_its_promises(judged.verdict, named, gap.closure)


@given(scale=st.floats(0.2, 100))
def test_causes_without_held_out_gain_leave_a_gap_only_beyond_the_noise_model(scale):
    """A push that the search took for one closes nothing: on a healthy arm that is no gap, not an unknown one."""
    push = SimpleNamespace(place=("contact", ()))
    finding = found_by_a_search("explained", (push,), ((),), scale)
    cause = Cause("contact", (), 0.01, 0.9, {"force_x": 1.0})

    def told(dataset, finding, gap):
        return (cause,) * len(finding.causes)

    judged, _ = judged_by(finding, lambda *_: SimpleNamespace(closure=0.0), told)
    assert judged.verdict == ("unknown" if scale >= LAW.exceeded else "no_gap")
    assert judged.causes == ()


def test_causes_that_close_too_little_are_named_with_the_runner_up():
    offset, stribeck = (SimpleNamespace(place=(name, (0,))) for name in ("torque_offset", "stribeck"))
    finding = found_by_a_search("explained", (offset,), ((),), 1.0, (stribeck,))
    cause = Cause("torque_offset", ("joint_1",), 0.5, 0.9, {"offset": 1.0})

    def told(dataset, finding, gap):
        there = tuple(EffectPlace(name, ("joint_1",)) for name, _ in finding.rivals[0])
        return (replace(cause, equivalent_to=there),)

    for closure, verdict in ((0.9, "explained"), (0.5, "ambiguous")):
        judged, _ = judged_by(finding, lambda *_, closure=closure: SimpleNamespace(closure=closure), told)
        assert judged.verdict == verdict
        assert judged.rivals[0] == (() if verdict == "explained" else (stribeck.place,))
