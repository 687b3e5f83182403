"""Scores of a check with further motions, of answers that are written by hand."""

import pytest

from benchmarks.active.scoring import WAYS, active_scores, active_text

TRUE = {"effect": "stribeck", "joints": ["joint_2"], "parameters": {}}


def said(verdict, *causes, equal=()):
    found = [{"effect": name, "joints": ["joint_2"], "equivalent_to": []} for name in causes]
    if found:
        found[0]["equivalent_to"] = [{"effect": name, "joints": ["joint_2"]} for name in equal]
    return {"verdict": verdict, "causes": found, "closure": 0.9}


RIGHT = said("explained", "stribeck")
WRONG = said("explained", "presliding")
OPEN = said("ambiguous", "presliding", equal=("stribeck",))


def run(number, first, kind="one", tests=None, **ways):
    entry = {"number": number, "kind": kind, "effects": [TRUE] if kind == "one" else [], "strength": 1.0}
    pair = {"pair": ["presliding on joint_2", "stribeck on joint_2"], "after_if": [0.5, 0.9]}
    other = {"pair": ["presliding on joint_2", "torque_ripple on joint_2"], "after_if": [None, 0.6]}
    answers = {
        way: {"seconds": 20.0, "planning_s": 3.0, "expected": [pair, other] * (way == "planned"), "result": result}
        for way, result in ways.items()
    }
    return {**entry, "first": first, "ways": answers, "tests": tests}


@pytest.fixture
def scores():
    return active_scores(
        [
            run(0, OPEN, planned=RIGHT, loop_again=OPEN, random_pieces=OPEN, d_optimal_pieces=WRONG),
            run(1, OPEN, planned=OPEN, loop_again=OPEN, random_pieces=RIGHT),
            run(2, RIGHT),
            run(3, said("no_gap"), kind="none"),
            {"number": 4, "kind": "one", "effects": [TRUE], "strength": 1.0, "error": "nobody there"},
        ]
    )


def test_scores_every_strategy_on_the_ambiguous_runs(scores):
    assert scores["first"] == {"ambiguous": 2, "explained": 1, "no_gap": 1}
    assert scores["ambiguous"] == 2
    found = {way: scores["ways"][way]["right"]["count"] for way in WAYS}
    assert found == {"planned": 1, "loop_again": 0, "random_pieces": 1, "d_optimal_pieces": 0}
    assert scores["ways"]["d_optimal_pieces"]["wrong_names"]["count"] == 1
    assert scores["ways"]["planned"]["robot_s"] == 40.0
    assert scores["not_recorded"] == [{"run": 4, "why": "nobody there"}]


def test_compares_predicted_probabilities_with_outcomes(scores):
    calibration = scores["calibration"]
    assert calibration["pairs"] == 2, "a pair without the truth has no right answer"
    overall = {"said": 0.9, "came": 0.5, "brier": (0.1**2 + 0.9**2) / 2}
    assert calibration["overall"] == pytest.approx(overall)
    assert "predicted 0.90, came 0.50" in active_text(scores)


def test_a_cause_still_equivalent_to_the_truth_does_not_count():
    still = said("ambiguous", "stribeck", equal=("presliding",))
    assert active_scores([run(0, OPEN, planned=still)])["calibration"]["overall"]["came"] == 0.0


def test_skips_a_pair_without_a_prediction_for_the_truth():
    unsaid = run(0, OPEN, planned=RIGHT)
    unsaid["ways"]["planned"]["expected"] = [{**unsaid["ways"]["planned"]["expected"][0], "after_if": [0.6, None]}]
    calibration = active_scores([unsaid, run(1, OPEN, planned=RIGHT)])["calibration"]
    assert calibration["pairs"] == 1
    assert calibration["overall"]["said"] == pytest.approx(0.9)


def test_reports_no_figures_without_recordings():
    nothing = active_scores([{"number": 0, "kind": "one", "effects": [TRUE], "strength": 1.0, "error": "no link"}])
    assert nothing["calibration"]["overall"] is None
    assert nothing["planning_s"] is None
    assert "1 runs" in active_text(nothing)


def test_requested_tests_count_for_the_planned_strategy_only():
    scores = active_scores([run(0, OPEN, tests=RIGHT, planned=OPEN, random_pieces=OPEN), run(1, OPEN, planned=OPEN)])
    ways = scores["ways"]
    assert ways["planned"]["right_with_tests"]["count"] == 1
    assert ways["planned"]["right"]["count"] == ways["random_pieces"]["right_with_tests"]["count"] == 0
    assert "and tests" in active_text(scores)


def test_an_effect_named_after_one_motion_counts():
    runs = [
        run(0, said("no_gap"), planned=RIGHT, loop_again=said("no_gap")),
        run(1, said("unknown"), planned=WRONG),
        run(2, OPEN, planned=RIGHT),
        run(3, said("no_gap"), kind="none", planned=said("no_gap")),
    ]
    scores = active_scores(runs)
    assert scores["unnamed"] == 2
    assert scores["ways"]["planned"]["found"]["count"] == 1
    assert scores["ways"]["loop_again"]["found"]["count"] == 0
