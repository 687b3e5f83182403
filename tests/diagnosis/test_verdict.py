"""The conditions of a verdict hold for every result of the search."""

import json
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.diagnosis import verdict as rules
from agent.diagnosis.diagnosis import next_experiment
from agent.diagnosis.document import Cause, DiagnosisResult, JointShare, NamedEffect, PathGap, TorqueGap
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.selected_causes import Hypothesis, SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.verdict import Verdict, causes_of, decide_verdict, has_size, keep_supported, name_causes
from agent.model import CATALOGUE

JOINTS = 3
EDGES = [0.0, LIMITS.least_share, LIMITS.explained, np.nan, -np.inf]
closures = st.one_of(st.none(), st.floats(-1, 3), st.sampled_from(EDGES))
causes = st.builds(
    Cause,
    effect=st.sampled_from(["stribeck", "interpolator_mismatch"]),
    joints=st.just(("joint_2",)),
    closure=closures,
    probability=st.floats(0.5, 1),
    parameters=st.dictionaries(st.sampled_from("ab"), st.sampled_from([0.0, 1.0, np.nan, np.inf]), max_size=2),
    equivalent_to=st.sampled_from([(), (NamedEffect("presliding", ("joint_2",)),)]),
    closure_of_joints=closures,
)
several = st.lists(causes, max_size=3).map(tuple)


def keeps_its_promises(verdict, told_causes, closure) -> bool:
    """The answer, as JSON has it, by docs/diagnosis.md."""
    next_one = next_experiment(told_causes, verdict, [JointShare("joint_1", 1.0, (0.9, 1.0), ())])
    gap = TorqueGap(("joint_2",), ("nominal",), (1.0,), (0.5,), None)
    answer = DiagnosisResult(verdict, gap, PathGap(), closure, (), told_causes, (), next_one, (), ())
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


@pytest.mark.parametrize("zero_known", [False, True])
def test_a_log_with_the_drives_off_is_said_in_words_and_by_its_key(zero_known):
    equal = (NamedEffect("asymmetric_friction", ("joint_2",)),)
    cause = Cause("torque_offset", ("joint_2",), 0.9, 0.9, {"offset": 1.0}, equal)
    following = next_experiment((cause,), "ambiguous", (), zero_known)
    assert ("--drives-off" in following.motion) is following.drives_off is not zero_known


@given(st.booleans(), several, closures, st.one_of(st.none(), several), several, st.floats(0, 3))
def test_a_verdict_meets_its_contract(leaves_gap, found, closure, path, numbers, by_numbers):
    """With causes, another path and moved numbers; each counts only where those before it explain nothing."""
    selected = SimpleNamespace(leaves_gap=leaves_gap)
    decided = decide_verdict(selected, found, closure, path, numbers, by_numbers)
    assert keeps_its_promises(decided.name, decided.causes, decided.closure)
    by_effects = decide_verdict(selected, found, closure)
    assert all(any(cause is one for one in found) for cause in by_effects.causes)
    assert decide_verdict(selected, by_effects.causes, closure) == by_effects, "it is settled"
    if by_effects.causes:
        assert (decided.name, decided.closure) == (by_effects.name, closure)
        assert decided.causes == (*by_effects.causes, *filter(has_size, path or ()))
    else:
        assert by_effects.name == ("unknown" if leaves_gap else "no_gap")
        gap = leaves_gap or path is not None
        of_numbers = all(any(cause is one for one in numbers) for cause in decided.causes)
        assert decided.causes or decided.name == ("unknown" if gap else "no_gap")
        assert not leaves_gap or not decided.causes or (by_numbers > 0.9 and of_numbers)
    assert closure is not None or not by_effects.causes


FOUND, PATH, NUMBER, SMALL = (
    Cause(name, (), closure, 0.9, {"a": 1.0})
    for name, closure in (("stribeck", 0.8), ("time_delay", 0.85), ("payload", 0.9), ("stribeck", 0.05))
)


@pytest.mark.parametrize(
    ("leaves_gap", "told", "expected"),
    [
        (False, ((FOUND, SMALL), 0.8, (PATH, SMALL), (NUMBER,), 1.0), ("explained", (FOUND, PATH), 0.8)),
        (False, ((FOUND,), 0.7, (PATH, SMALL), (NUMBER,), 1.0), ("explained", (PATH,), 0.85)),
        (True, ((), 0.1, (PATH,), (NUMBER,), 0.91), ("explained", (NUMBER,), 0.91)),
        (True, ((), 0.1, None, (NUMBER,), 0.9), ("unknown", (), 0.1)),
        (False, ((), 0.1, (), (NUMBER,), 0.9), ("unknown", (), 0.1)),
        (False, ((), None, None, (NUMBER,), 0.8), ("explained", (NUMBER,), 0.8)),
        (False, ((), None, None, (NUMBER,)), ("no_gap", (), None)),
    ],
)
def test_effects_come_before_another_path_and_that_before_moved_numbers(leaves_gap, told, expected):
    assert decide_verdict(SimpleNamespace(leaves_gap=leaves_gap), *told) == Verdict(*expected)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("closure", "of_joints", "values", "sized"),
    [
        *((part, None, (1.0,), part == 0.1) for part in (None, 0.099, 0.1, np.inf, np.nan)),
        *((0.01, part, (1.0,), part == 0.1) for part in (0.099, 0.1, np.inf)),
        (0.1, 0.01, (0.0, 1.0), True),
        *((0.1, 0.1, values, False) for values in ((), (0.0, 0.0), (1.0, np.inf), (np.nan,))),
    ],
)
def test_a_cause_with_a_size_closes_a_tenth_with_finite_parameters(closure, of_joints, values, sized):
    cause = Cause("stribeck", (), closure, 0.9, dict(zip("ab", values, strict=False)), (), of_joints)
    assert has_size(cause) is sized


def test_a_cause_is_told_with_what_it_closes_where_it_is_and_what_its_effect_reports():
    """Of the whole gap, and of its joints that no larger cause has: of the whole arm, of the main one of them."""

    def reported(reference, settings, values):
        return {"of": reference, **settings, **values}

    names = (("rise",), ("mass", "moment_x"))
    stribeck, load = (
        SimpleNamespace(
            effect=SimpleNamespace(name=name, reported=reported),
            joints=joints,
            blocks=dict.fromkeys(joints or range(3)),
            settings=more,
            names=own,
        )
        for name, joints, more, own in (("stribeck", (2, 0), {"speed": 1}, names[0]), ("payload", (), {}, names[1]))
    )
    fit = SimpleNamespace(reference=7, values=[np.array([3.0]), np.array([4.0, 5.0])])
    gap = SimpleNamespace(closure_without=lambda left: 0.5 + left, closure_on=lambda joints, left: (joints, left))
    dataset = SimpleNamespace(robot=SimpleNamespace(joint_names=("a", "b", "c")))
    rivals = ((("payload", ()), ("dress_pack", (1, 2))), ())
    selected = SimpleNamespace(fit=fit, causes=(stribeck, load), rivals=rivals, probability=(0.8, 0.7))
    equal = NamedEffect("payload", ()), NamedEffect("dress_pack", ("b", "c"))

    def told_of(selected):
        adequacy = SimpleNamespace(gap=gap, causes=selected.causes, taken_out=[1, 11])
        adequacy.main_joint = lambda joints, left: list(joints)[-1]
        return causes_of(dataset, selected, adequacy)  # type: ignore[arg-type]

    told = told_of(selected)
    for causes, own in (
        ((load, stribeck), [[2], [2, 0]]),
        ((load, load), [[2], None]),
        ((stribeck, stribeck), [[2, 0], None]),
    ):
        values = [np.ones(len(cause.names)) for cause in causes]
        again = SimpleNamespace(
            **{**vars(selected), "causes": causes, "fit": SimpleNamespace(**{**vars(fit), "values": values})}
        )
        parts = [cause.closure_of_joints for cause in told_of(again)]
        assert [part and part[0] for part in parts] == own  # type: ignore[index]
    assert told == (
        Cause("stribeck", ("c", "a"), 1.5, 0.8, {"of": 7, "speed": 1.0, "rise": 3.0}, equal, ([2, 0], 1)),  # type: ignore[arg-type]
        Cause("payload", (), 11.5, 0.7, {"of": 7, "mass": 4.0, "moment_x": 5.0}, (), ([1], 11)),  # type: ignore[arg-type]
    )


class _Fit:
    """A fit that knows its causes and no data."""

    def __init__(self, chosen=()):
        self.chosen = tuple(chosen)

    def with_chosen(self, chosen):
        return _Fit(chosen)


def found_by_a_search(candidates, rivals, scale=1.0, runner_up=()):
    """A finding over two hypotheses: the causes, and nothing, with a squared error of `scale` times the noise."""
    plain = Hypothesis((), (), 0.0, {}, (), 0.0, scale)
    best = Hypothesis(candidates, (), 9.0, {}, (0.1,) * len(candidates), 1.0, 1.0)
    others = (Hypothesis(runner_up, (), 5.0, {}, (0.1,), 1.0, 1.0),) if runner_up else ()
    evidence, probability = SimpleNamespace(law=LAW, dof=JOINTS), (0.9,) * len(candidates)
    hypotheses = (best, *others, plain)
    return name_causes(
        SelectedCauses(_Fit(), _Fit(candidates), candidates, rivals, probability, 1.0, hypotheses, evidence)
    )  # type: ignore[arg-type]


def candidate_of(name, *joints, **more):
    return SimpleNamespace(key=(name, joints), effect=CATALOGUE[name], **more)


def judged_by(selected, gap_of, told, failing=(), own=1.0, large=False):
    """A finding as it is supported, and the verdict, where fits have these gaps, and findings these causes.

    Causes at `failing` joints do not explain what they claim; `own` is their part of what they close with the model;
    `large`: without causes, a joint errs by far more than the model's own error.
    """
    dataset, unit, gaps = SimpleNamespace(), np.ones(JOINTS), []

    def made(*seen):
        assert seen == (dataset, seen[1], unit)
        gaps.append(gap_of(*seen))
        return gaps[-1]

    def told_of(*seen):
        assert seen[0] is dataset
        assert seen[2].gap is gaps[-1]
        return told(dataset, seen[1], gaps[-1])

    def adequacy(selected, gap):
        assert gap is gaps[-1]
        lacking = ["it leaves too much" if set(failing) & set(cause.key[1]) else "" for cause in selected.causes]
        of_causes = {"closed_alone": own * (gap.closure or 0.0), "explained_part": gap.closure}
        return SimpleNamespace(gap=gap, exceeds=lambda: large, shortfalls=lambda irreplaceable: lacking, **of_causes)

    patches = {"held_out_gap": made, "causes_of": told_of, "Adequacy": SimpleNamespace(of=adequacy)}
    patches |= {"drop_replaceable": lambda *_: None}
    with patch.multiple(rules, **patches):
        judged, gap = keep_supported(dataset, selected, unit)  # type: ignore[arg-type]
    assert gap is gaps[-1]
    return judged, decide_verdict(judged, told(None, judged, gap), gap.closure)


@given(
    found=st.lists(causes, min_size=1, max_size=3),
    closings=st.lists(closures, min_size=1, max_size=4),
    other=st.booleans(),
    scale=st.sampled_from([1.0, 10.0]),
    failing=st.sets(st.integers(0, 2)),
)
def test_every_search_result_gives_an_answer_that_meets_the_contract(found, closings, other, scale, failing):
    """Whatever is taken away: the gap is then another, and so are the causes' parts of it."""
    candidates = tuple(candidate_of("stribeck", k, cause=cause) for k, cause in enumerate(found))
    runner_up = (candidate_of("presliding", 0),) if other else ()
    rivals = tuple(tuple((e.effect, (1,)) for e in cause.equivalent_to) for cause in found)
    selected = found_by_a_search(candidates, rivals, scale, runner_up)

    def gap_of(dataset, fit, unit=None):
        return SimpleNamespace(closure=closings[min(len(fit.chosen), len(closings) - 1)])

    def told(dataset, selected, gap):
        there = [tuple(NamedEffect(name, ("joint_2",)) for name, _ in rivals) for rivals in selected.rivals]
        of = zip((c.cause for c in selected.causes), there, strict=True)
        return tuple(replace(cause, equivalent_to=equal, closure_of_joints=None) for cause, equal in of)

    judged, decided = judged_by(selected, gap_of, told, failing)
    assert keeps_its_promises(decided.name, decided.causes, decided.closure)
    assert failing.isdisjoint(joint for cause in judged.causes for joint in cause.key[1])
    assert decided.name != "no_gap" or not judged.rejected, "what is rejected leaves its gap"
    assert len(decided.causes) == len(judged.causes), "what is supported is named"


def test_a_cause_is_named_from_the_limits_on():
    """At exactly the probability, the share explained, and the doubt of a healthy arm, that are asked for."""
    plain = Hypothesis((), (), 0.0, {}, (), 0.0, 1.0)
    best = (candidate_of("stribeck", 0),)
    found = SelectedCauses(
        _Fit(), _Fit(best), best, ((),), (LAW.sure,), LIMITS.explained, (plain,), None, 1 - LAW.confidence
    )  # type: ignore[arg-type]
    assert name_causes(found).causes == best
    for less in ({"probability": (LAW.sure - 1e-9,)}, {"explained_share": 0.7499}, {"healthy": 0.0501}):
        judged = name_causes(replace(found, **less))
        assert (judged.causes, judged.leaves_gap) == ((), "healthy" not in less)


@given(scale=st.floats(0.2, 100), large=st.booleans())
def test_causes_without_held_out_gain_leave_a_gap_only_beyond_the_noise_model(scale, large):
    """A push that the search took for one closes nothing: on a healthy arm that is no gap, not an unknown one."""
    selected = found_by_a_search((candidate_of("contact"),), ((),), scale)
    cause = Cause("contact", (), 0.01, 0.9, {"force_x": 1.0})

    def told(dataset, selected, gap):
        return (cause,) * len(selected.causes)

    judged, decided = judged_by(selected, lambda *_: SimpleNamespace(closure=0.0), told, large=large)
    assert decided.name == ("unknown" if scale >= 4.0 or large else "no_gap")
    assert judged.causes == ()


def test_causes_that_close_too_little_are_named_with_the_runner_up():
    offset, stribeck = (candidate_of(name, 0) for name in ("torque_offset", "stribeck"))
    selected = found_by_a_search((offset,), ((),), 1.0, (stribeck,))
    cause = Cause("torque_offset", ("joint_1",), 0.5, 0.9, {"offset": 1.0})

    def told(dataset, selected, gap):
        there = [tuple(NamedEffect(name, ("joint_1",)) for name, _ in rivals) for rivals in selected.rivals]
        return tuple(replace(cause, equivalent_to=rivals) for rivals in there)

    for closure, verdict in ((0.9, "explained"), (0.75, "explained"), (0.5, "ambiguous"), (0.01, "ambiguous")):
        judged, decided = judged_by(selected, lambda *_, closure=closure: SimpleNamespace(closure=closure), told)
        assert decided.name == verdict
        assert judged.rivals[0] == (() if verdict == "explained" else (stribeck.key,))
    for own, verdict in ((0.5, "explained"), (0.4, "ambiguous")):  # the model's own change closes more
        _, decided = judged_by(selected, lambda *_: SimpleNamespace(closure=0.9), told, own=own)
        assert decided.name == verdict
    for closure in (0.0, -0.4):  # the model alone predicts as well
        _, decided = judged_by(selected, lambda *_, closure=closure: SimpleNamespace(closure=closure), told)
        assert (decided.name, decided.causes) == ("no_gap", ())
