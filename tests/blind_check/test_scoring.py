"""Scores of runs whose answers are written by hand."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from agent.blind_check.report import report_text, summary_text, weak_spots
from agent.blind_check.scoring import clopper_pearson, outcome, score
from agent.blind_check.size import kind_by_size


def cause(effect, *joints, probability=0.9, equal=()):
    same = [{"effect": name, "joints": list(where)} for name, where in equal]
    return {
        "effect": effect,
        "joints": list(joints),
        "probability": probability,
        "equivalent_to": same,
        "closure": 0.9,
        "parameters": {},
    }


def entry(kind, effects=(), verdict="no_gap", causes=(), before=0.01, worst="joint_1", **more):
    other = "joint_2" if worst == "joint_1" else "joint_1"
    found = {
        "number": 0,
        "kind": kind,
        "strength": 1.0,
        "size": 0.03,
        "effects": [{"effect": name, "joints": list(where), "parameters": {}} for name, where in effects],
        "seconds": 5.0,
        "result": {
            "verdict": verdict,
            "causes": list(causes),
            "closure": 0.9 if causes else None,
            "gap": {"before": [before, 0.001], "after": [0.001, 0.001], "floor": None},
            "where": [{"joint": worst, "share": 0.8}, {"joint": other, "share": 0.2}],
        },
        **more,
    }
    return {**found, "outcome": outcome(found)}


STRIBECK = [("stribeck", ["joint_1"])]


@pytest.mark.parametrize(
    ("run", "expected"),
    [
        (entry("none"), "right"),
        (entry("none", verdict="unknown"), "false alarm"),
        (entry("one", STRIBECK, "explained", [cause("stribeck", "joint_1")]), "right"),
        (entry("one", STRIBECK, "explained", [cause("stribeck", "joint_2")]), "wrong name"),
        (entry("one", STRIBECK, "explained", [cause("presliding", "joint_1")]), "wrong name"),
        (entry("one", STRIBECK, "unknown"), "unknown"),
        (entry("one", STRIBECK), "missed"),
        (entry("outside", [("rough_bearing", ["joint_1"])], "unknown"), "right"),
        (entry("outside", [("rough_bearing", ["joint_1"])], "explained", [cause("stribeck", "joint_1")]), "wrong name"),
        (entry("small", STRIBECK), "right"),
        (entry("small", STRIBECK, "explained", [cause("stribeck", "joint_1")]), "right"),
    ],
)
def test_outcomes(run, expected):
    assert run["outcome"] == expected


def test_pair_of_joints_has_no_order():
    run = entry(
        "one",
        [("wrist_coupling", ["joint_2", "joint_1"])],
        "explained",
        [cause("wrist_coupling", "joint_1", "joint_2")],
    )
    assert run["outcome"] == "right"


def test_an_ambiguous_answer_is_right_only_with_the_truth_among_at_most_three():
    small = [("presliding", ["joint_1"]), ("stribeck", ["joint_1"])]
    large = [("presliding", ["joint_1"]), ("backlash", ["joint_1"]), ("stribeck", ["joint_1"])]
    first = "thermal_friction"
    assert entry("one", STRIBECK, "ambiguous", [cause(first, "joint_1", equal=small)])["outcome"] == "in class"
    assert entry("one", STRIBECK, "ambiguous", [cause(first, "joint_1", equal=large)])["outcome"] == "no class"
    assert entry("one", STRIBECK, "ambiguous", [cause(first, "joint_1", equal=small[:1])])["outcome"] == "no class"


def test_scores_of_a_known_set():
    two = [("stribeck", ["joint_1"]), ("payload", [])]
    runs = [
        entry("none", before=0.002),
        entry("none", verdict="unknown", before=0.002),
        entry(
            "one",
            STRIBECK,
            "explained",
            [cause("stribeck", "joint_1")],
            withheld=entry("one", verdict="unknown")["result"],
            closures={"oracle": 0.95, "wrong": 0.2, "wrong_effect": "presliding", "black_box": 0.1},
        ),
        entry(
            "one",
            STRIBECK,
            "explained",
            [cause("presliding", "joint_1"), cause("stribeck", "joint_1")],
            withheld=entry("one", verdict="explained", causes=[cause("presliding", "joint_1")])["result"],
            closures={"oracle": 0.9, "wrong": 0.4, "wrong_effect": "backlash", "black_box": 0.3},
        ),
        entry("two", two, "explained", [cause("payload"), cause("stribeck", "joint_1")]),
        entry("outside", [("rubbing_brake", ["joint_2"])], "unknown", worst="joint_2"),
        entry("small", STRIBECK),
        {"number": 7, "kind": "one", "strength": 1.0, "effects": [], "error": "no", "outcome": "not recorded"},
    ]
    scores = score(runs)
    assert (scores["false_alarms"]["count"], scores["false_alarms"]["of"]) == (1, 2)
    assert (scores["top_1"]["count"], scores["top_1"]["of"]) == (2, 3)
    assert scores["top_3"]["count"] == 3
    assert scores["both_of_two"]["share"] == 1.0
    assert scores["joint"]["share"] == 1.0
    assert scores["unknowns_recognised"]["share"] == 1.0
    assert scores["withheld"]["confident_wrong_names"]["count"] == 1
    assert scores["closure"]["of_oracle"] == pytest.approx((0.9 / 0.95 + 1.0) / 2)
    assert scores["closure"]["black_box"] == pytest.approx(0.2)
    assert scores["confusion"]["stribeck"] == {"stribeck": 1, "presliding": 1}
    assert scores["too_small_left_alone"]["count"] == 1
    assert len(scores["not_recorded"]) == 1
    spots = weak_spots(scores)
    assert any("false alarm" in spot or spot.startswith("nothing: 1 of 2") for spot in spots)
    assert any(spot.startswith("stribeck: 1 of 2 named as presliding") for spot in spots)
    text = report_text({**scores, "key_sha256": "ab", "world": "a world", "robot": "arm"})
    assert text.index("## Weak spots") < text.index("## Figures") < text.index("## Confusion")
    assert "first cause right" in summary_text(scores)


def test_calibration_counts_how_often_the_class_held_the_truth():
    sure = [entry("one", STRIBECK, "explained", [cause("stribeck", "joint_1", probability=0.97)])] * 3
    wrong = entry("one", STRIBECK, "explained", [cause("backlash", "joint_1", probability=0.97)])
    (row,) = score([*sure, wrong])["calibration"]["bins"]
    assert (row["runs"], row["share_true"]) == (4, 0.75)
    assert row["mean_probability"] == pytest.approx(0.97)


def test_runs_are_scored_by_recorder_where_logs_are_kept_in_more_than_one_way():
    right = {**entry("one", STRIBECK, "explained", [cause("stribeck", "joint_1")]), "recorder": "clean"}
    alarm = {**entry("none", verdict="unknown"), "recorder": "as recorded"}
    scores = score([right, right, alarm])
    assert (scores["recorders"]["clean"]["top_1"]["count"], scores["recorders"]["clean"]["runs"]) == (2, 2)
    assert scores["recorders"]["as recorded"]["false_alarms"]["count"] == 1
    assert "| clean | 2 | 2 of 2 |" in summary_text(scores)
    assert score([entry("none")])["recorders"] == {}


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_exact_interval_holds_the_share_and_has_the_tails_it_promises(counts):
    from scipy.stats import binom

    hits, trials = counts
    low, high = clopper_pearson(hits, trials)
    assert 0 <= low <= hits / trials <= high <= 1
    if hits:
        assert binom.sf(hits - 1, trials, low) == pytest.approx(0.025, abs=1e-6)
    if hits < trials:
        assert binom.cdf(hits, trials, high) == pytest.approx(0.025, abs=1e-6)


def test_an_effect_that_changes_nothing_is_a_small_one():
    assert [kind_by_size(kind, 0.0) for kind in ("one", "outside", "two", "none")] == ["small", "small", "two", "none"]
    assert [kind_by_size(kind, 0.01) for kind in ("one", "outside")] == ["one", "outside"]
