"""Scores of a check with further motions, of answers that are written by hand."""

from __future__ import annotations

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


def run(number, first, ways, kind="one"):
    effects = [TRUE] if kind == "one" else []
    entry = {"number": number, "kind": kind, "effects": effects, "strength": 1.0, "first": first, "ways": {}}
    for way, results in ways.items():
        pair = {"pair": ["presliding on joint_2", "stribeck on joint_2"], "before": 0.5, "after": 0.7}
        pair["after_if"] = [0.5, 0.9]
        other = {"pair": ["presliding on joint_2", "torque_ripple on joint_2"], "before": 0.5, "after": 0.6}
        other["after_if"] = [None, 0.6]
        asked = [pair, other] if way == "planned" else []
        entry["ways"][way] = [
            {"seconds": 20.0, "planning_s": 3.0, "expected": asked, "result": result} for result in results
        ]
    return entry


@pytest.fixture
def scores():
    return active_scores(
        [
            run(
                0,
                OPEN,
                {
                    "planned": [RIGHT],
                    "loop_again": [OPEN, OPEN],
                    "random_pieces": [OPEN, RIGHT],
                    "d_optimal_pieces": [WRONG],
                },
            ),
            run(1, OPEN, {"planned": [OPEN, RIGHT], "loop_again": [OPEN, OPEN]}),
            run(2, RIGHT, {}),
            run(3, said("no_gap"), {}, kind="none"),
            {"number": 4, "kind": "one", "effects": [TRUE], "strength": 1.0, "error": "nobody there"},
        ]
    )


def test_every_way_is_counted_over_the_runs_that_were_ambiguous(scores):
    assert scores["first"] == {"ambiguous": 2, "explained": 1, "no_gap": 1}
    assert scores["ambiguous"] == 2
    found = {way: [scores["ways"][way][k]["count"] for k in ("right_after_one", "right_after_two")] for way in WAYS}
    assert found == {**{way: [0, 0] for way in WAYS}, "planned": [1, 2], "random_pieces": [0, 1]}
    assert scores["ways"]["d_optimal_pieces"]["wrong_names"]["count"] == 1
    assert scores["ways"]["planned"]["robot_s"] == 60.0
    assert scores["not_recorded"] == [{"run": 4, "why": "nobody there"}]


def test_predicted_probabilities_are_compared_with_what_came_where_the_truth_was_asked_about(scores):
    calibration = scores["calibration"]
    assert calibration["pairs"] == 3, "a pair without the truth has no right answer"
    brier = (2 * 0.1**2 + 0.9**2) / 3
    assert calibration["overall"] == pytest.approx({"said": 0.9, "came": 2 / 3, "brier": brier})
    assert "predicted 0.90, came 0.67" in active_text(scores)


def test_a_rival_that_still_equals_the_truth_is_no_answer():
    still = said("ambiguous", "stribeck", equal=("presliding",))
    assert active_scores([run(0, OPEN, {"planned": [still]})])["calibration"]["overall"]["came"] == 0.0


def test_a_pair_of_which_nothing_was_predicted_for_the_truth_is_not_compared():
    unsaid = run(0, OPEN, {"planned": [RIGHT]})
    unsaid["ways"]["planned"][0]["expected"][0]["after_if"] = [0.6, None]
    calibration = active_scores([unsaid, run(1, OPEN, {"planned": [RIGHT]})])["calibration"]
    assert calibration["pairs"] == 1
    assert calibration["overall"]["said"] == pytest.approx(0.9)


def test_smallest_sizes_are_compared_where_the_first_motion_leaves_them_weak():
    def healthy(**sizes):
        return {**said("no_gap"), "smallest": sizes}

    before = healthy(stribeck=4.0, payload=2.0, backlash=None, ripple=None, presliding=0.5)
    after = healthy(stribeck=1.0, payload=1.5, backlash=0.2, ripple=None, presliding=0.4)
    runs = [
        run(
            0, before, {"planned": [after], "random_pieces": [before, after], "d_optimal_pieces": [WRONG]}, kind="none"
        ),
        run(1, OPEN, {"planned": [RIGHT]}),
    ]
    scores = active_scores(runs)
    planned, repeated = (scores["smallest_sizes"][way] for way in ("planned", "random_pieces"))
    assert planned["of_before"] == pytest.approx((0.25 * 0.75) ** 0.5)
    assert (planned["weak"], planned["halved"], planned["had_none"], planned["have_one"]) == (4, 2, 2, 1)
    assert (repeated["of_before"], repeated["halved"], repeated["have_one"]) == (1.0, 0, 0)
    assert scores["smallest_sizes"]["d_optimal_pieces"]["weak"] == 0, "what names something has no size to find"
    assert "0.43 of before on average" in active_text(scores)


def test_nothing_recorded_is_said(scores):
    nothing = active_scores([{"number": 0, "kind": "one", "effects": [TRUE], "strength": 1.0, "error": "no link"}])
    assert nothing["calibration"]["overall"] is None
    assert nothing["planning_s"] is None
    assert "1 runs" in active_text(nothing)


def test_the_answer_with_seconds_on_the_brakes_counts_beside_the_motion_alone():
    one, two = (run(number, OPEN, {"planned": [OPEN]}) for number in range(2))
    one["brakes"] = {"planned": RIGHT, "random_pieces": WRONG}
    scores = active_scores([one, two])
    shares = {
        way: tuple(scores["ways"][way][key]["count"] for key in ("right_with_tests", "wrong_with_tests"))
        for way in WAYS
    }
    assert shares == {**dict.fromkeys(WAYS, (0, 0)), "planned": (1, 0), "random_pieces": (0, 1)}
    assert scores["ways"]["planned"]["right_after_one"]["count"] == 0
    assert "and tests" in active_text(scores)


def test_the_answer_with_a_mass_counts_for_the_way_that_asked_for_it():
    one, two = (run(number, OPEN, {"planned": [OPEN], "random_pieces": [OPEN]}) for number in range(2))
    one["mass"], two["mass"] = RIGHT, None
    scores = active_scores([one, two])
    ways = scores["ways"]
    assert ways["planned"]["right_with_tests"]["count"] == 1
    assert ways["planned"]["right_after_one"]["count"] == ways["random_pieces"]["right_with_tests"]["count"] == 0


def test_an_effect_of_which_nothing_was_named_at_first_counts_where_one_motion_names_it():
    runs = [
        run(0, said("no_gap"), {"planned": [RIGHT], "loop_again": [said("no_gap")]}),
        run(1, said("unknown"), {"planned": [WRONG]}),
        run(2, OPEN, {"planned": [RIGHT]}),
        run(3, said("no_gap"), {"planned": [said("no_gap")]}, kind="none"),
    ]
    scores = active_scores(runs)
    assert scores["unnamed"] == 2
    assert scores["ways"]["planned"]["found_after_one"]["count"] == 1
    assert scores["ways"]["loop_again"]["found_after_one"]["count"] == 0
