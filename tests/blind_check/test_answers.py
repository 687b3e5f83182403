"""Answers of any tool, scored by a key: what each outcome counts, what is refused, and the page of the results."""

import json
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from agent.blind_check.answers import read_answers
from agent.blind_check.key import Key
from agent.blind_check.own_check import score_answers
from agent.blind_check.report import page, read_results
from agent.blind_check.scoring import OUTCOMES, clopper_pearson, outcome
from agent.core.errors import InputError

STRIBECK = [("stribeck", ["joint_1"])]


def cause(effect, *joints, probability=0.9, equal=()):
    same = [{"effect": name, "joints": list(where)} for name, where in equal]
    return {"effect": effect, "joints": list(joints), "probability": probability, "equivalent_to": same}


def answer(run, verdict, *causes, worst="joint_1", without=()):
    where = [{"joint": worst, "share": 0.8}, {"joint": "joint_3", "share": 0.2}]
    line = {"run": run, "verdict": verdict, "causes": list(causes), "where": where}
    return {**line, "without": list(without)} if without else line


def truth(run, kind="one", effects=STRIBECK, size=0.03, **more):
    built_in = [{"effect": name, "joints": list(where), "parameters": {}} for name, where in effects]
    return {"run": run, "kind": kind, "effects": built_in, "size": size if built_in else None, **more}


def scored(tmp_path: Path, runs, answers, name="tool", out=None):
    Key("tiny", len(runs), 1, "salt", list(runs)).save(tmp_path / "key.json")
    file = tmp_path / f"{name}.jsonl"
    file.write_text("".join(json.dumps(one) + "\n" for one in answers))
    return score_answers(tmp_path / "key.json", [file], out)["tools"][name]


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (answer("a", "explained", cause("stribeck", "joint_1")), "named"),
        (answer("a", "explained", cause("stribeck", "joint_2")), "wrong name"),
        (answer("a", "explained", cause("presliding", "joint_1")), "wrong name"),
        (answer("a", "explained", cause("presliding", "joint_1"), cause("stribeck", "joint_1")), "wrong name"),
        (answer("a", "ambiguous", cause("stribeck", "joint_1", equal=[("backlash", ["joint_1"])])), "in class"),
        (answer("a", "ambiguous", cause("backlash", "joint_1", equal=STRIBECK)), "in class"),
        (answer("a", "ambiguous", cause("backlash", "joint_1"), cause("stribeck", "joint_1")), "wrong class"),
        (answer("a", "unknown"), "unknown"),
        (answer("a", "no_gap"), "no gap"),
        (None, "no answer"),
    ],
)
def test_classifies_each_answer(said, expected):
    assert outcome(truth("a")["effects"], said) == expected


def test_the_order_of_a_joint_pair_does_not_matter():
    effects = truth("a", effects=[("wrist_coupling", ["joint_2", "joint_1"])])["effects"]
    assert outcome(effects, answer("a", "explained", cause("wrist_coupling", "joint_1", "joint_2"))) == "named"


def test_every_run_counts_once_by_kind(tmp_path: Path):
    runs = [
        truth("a", "none", ()),
        truth("b", "none", ()),
        truth("c"),
        truth("d"),
        truth("e", "outside", [("rust", ["joint_2"])]),
        truth("f", "two", [*STRIBECK, ("payload", [])]),
        truth("g"),
    ]
    answers = [
        answer("a", "no_gap"),
        answer("b", "ambiguous", cause("stribeck", "joint_1")),
        answer("c", "explained", cause("stribeck", "joint_1"), cause("backlash", "joint_1")),
        answer("d", "ambiguous", cause("backlash", "joint_1", equal=STRIBECK)),
        answer("e", "unknown", worst="joint_2"),
        answer("f", "explained", cause("payload"), cause("stribeck", "joint_1")),
    ]
    found = scored(tmp_path, runs, answers)
    told = {kind: {name: n for name, n in row.items() if n} for kind, row in found["outcomes"].items()}
    assert told == {
        "none": {"no gap": 1, "wrong class": 1},
        "one": {"named": 1, "in class": 1, "no answer": 1},
        "outside": {"unknown": 1},
        "two": {"named": 1},
        "three": {},
    }
    assert (found["all_of_two"]["count"], found["all_of_two"]["of"]) == (1, 1)
    assert (found["further_wrong"]["count"], found["further_wrong"]["of"]) == (1, 2)
    assert (found["joint"]["count"], found["joint"]["of"]) == (3, 4), "the one without an answer has no joint right"
    assert found["classes"] == {"2": 1}
    assert found["effects"]["rust"]["unknown"] == 1


def test_small_effects_stay_in_the_power_curve(tmp_path: Path):
    runs = [truth("a", size=0.001), truth("b", size=0.001), truth("c", size=0.03)]
    wrong, right = cause("backlash", "joint_1"), cause("stribeck", "joint_1")
    answers = [answer("a", "explained", wrong), answer("b", "no_gap"), answer("c", "explained", right)]
    power = scored(tmp_path, runs, answers)["power"]
    assert sum(row["found"]["of"] for row in power) == 3
    assert (power[0]["from"], power[0]["found"]["count"], power[0]["wrong"]["count"]) == (0.0, 1, 1)
    (row,) = (row for row in power if row["right"]["count"])
    assert row["from"] <= 0.03 < row["to"]


def test_any_named_cause_is_wrong_if_the_true_effect_is_withheld(tmp_path: Path):
    runs = [truth(name) for name in "abc"]
    plain = [answer(name, "explained", cause("stribeck", "joint_1")) for name in "abc"]
    other = cause("backlash", "joint_1")
    again = [
        answer("a", "unknown", without=["stribeck"]),
        answer("b", "ambiguous", other, without=["stribeck", "payload"]),
        answer("c", "explained", other, without=["stribeck"]),
    ]
    found = scored(tmp_path, runs, [*plain, *again])
    assert found["withheld"] == {"unknown": 1, "wrong class": 1, "wrong name": 1}
    assert found["outcomes"]["one"]["named"] == 3
    with pytest.raises(InputError, match="run a: `without` lacks a true effect: stribeck"):
        scored(tmp_path, runs, [answer("a", "unknown", without=["backlash"])])


def test_calibration_compares_stated_probabilities_with_outcomes(tmp_path: Path):
    runs = [truth("a"), truth("b"), truth("c"), truth("d", "none", ())]
    said = [cause("stribeck", "joint_1", probability=0.96)] * 3 + [cause("payload", probability=0.7)]
    answers = [answer(run["run"], "explained", one) for run, one in zip(runs, said, strict=True)]
    found = scored(tmp_path, runs, answers)["calibration"]
    assert [(row["runs"], row["came"]) for row in found["bins"]] == [(1, 0.0), (3, 1.0)]
    assert found["brier"] == pytest.approx((3 * 0.04**2 + 0.7**2) / 4)
    assert found["ece"] == pytest.approx((3 * 0.04 + 0.7) / 4)


def test_a_tool_without_probabilities_has_no_calibration(tmp_path: Path):
    bare = {"run": "a", "verdict": "explained", "causes": [{"effect": "stribeck", "joints": ["joint_1"]}]}
    found = scored(tmp_path, [truth("a")], [bare])
    assert found["outcomes"]["one"]["named"] == 1
    assert found["calibration"]["brier"] is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "Invalid JSON"),
        (json.dumps({"run": "a"}), "verdict: Field required"),
        (json.dumps(answer("a", "perhaps")), "verdict: Input should be 'no_gap', 'explained', 'ambiguous'"),
        (json.dumps(answer("a", "explained")), "explained and ambiguous need at least one cause"),
        (json.dumps(answer("a", "unknown", cause("payload"))), "unknown have none"),
        (json.dumps(answer("a", "explained", cause("payload", probability=7))), "less than or equal to 1"),
        (json.dumps(answer("a", "no_gap")) + "\n" + json.dumps(answer("a", "unknown")), "second answer for run a"),
        (json.dumps(answer("z", "no_gap")), "no run z"),
        ("[1]", "Input should be an object"),
        (json.dumps(answer("a", "explained", cause("payload", probability=float("nan")))), "a finite number"),
        (
            json.dumps(answer("a", "unknown") | {"where": [{"joint": "joint_1", "share": float("inf")}]}),
            "finite number",
        ),
        (json.dumps(answer("a", "explained", cause("rust"))), "no effect 'rust' in the catalogue"),
        (json.dumps(answer("a", "explained", cause("payload", equal=[("rust", [])]))), "no effect 'rust'"),
        (json.dumps(answer("a", "unknown", without=["rust"])), "no effect 'rust'"),
        (json.dumps(answer("b", "unknown", without=["stribeck"])), "run b: it has no effect to be `without`"),
    ],
)
def test_refuses_invalid_answers_with_file_and_reason(tmp_path: Path, line: str, message: str):
    (tmp_path / "tool.jsonl").write_text(line + "\n")
    Key("tiny", 2, 1, "salt", [truth("a"), truth("b", "none", ())]).save(tmp_path / "key.json")
    with pytest.raises(InputError, match=message) as caught:
        score_answers(tmp_path / "key.json", [tmp_path / "tool.jsonl"])
    assert "tool" in str(caught.value)


def test_a_key_without_runs_and_tools_of_one_name_are_refused(tmp_path: Path):
    (tmp_path / "tool.jsonl").write_text("")
    Key("tiny", 1, 1, "salt").save(tmp_path / "key.json")
    with pytest.raises(InputError, match="not recorded yet"):
        score_answers(tmp_path / "key.json", [tmp_path / "tool.jsonl"])
    Key("tiny", 1, 1, "salt", [truth("a")]).save(tmp_path / "key.json")
    with pytest.raises(InputError, match="have one name"):
        score_answers(tmp_path / "key.json", [tmp_path / "tool.jsonl", tmp_path / "more" / "tool.jsonl"])
    with pytest.raises(InputError, match="no such file"):
        read_answers(tmp_path / "missing.jsonl")


def test_a_byte_order_mark_and_unicode_line_separators_do_not_split_lines(tmp_path: Path):
    line = json.dumps(answer("a", "unknown") | {"note": "one\u2028two"}, ensure_ascii=False)
    (tmp_path / "tool.jsonl").write_text(f"\ufeff{line}\r\n\n", encoding="utf-8")
    assert [one["run"] for one in read_answers(tmp_path / "tool.jsonl")] == ["a"]


@pytest.mark.parametrize(
    "runs",
    [5, [{}], [truth("a", "several")], [{**truth("a"), "effects": [{}]}], [{"run": "a", "kind": "one", "effects": []}]],
)
def test_a_key_whose_runs_are_damaged_is_refused(tmp_path: Path, runs):
    Key("tiny", 1, 1, "salt", runs).save(tmp_path / "key.json")
    (tmp_path / "tool.jsonl").write_text("")
    with pytest.raises(InputError, match=r"key\.json: not a whole key: a run lacks"):
        score_answers(tmp_path / "key.json", [tmp_path / "tool.jsonl"])


def test_runs_with_three_effects_and_path_effects_are_scored_separately(tmp_path: Path):
    three = [*STRIBECK, ("payload", []), ("backlash", ["joint_2"])]
    runs = [truth("a", "three", three), truth("b", effects=[("interpolator_mismatch", [])], size=None)]
    runs[1]["size"] = None
    causes = [cause("payload"), cause("stribeck", "joint_1"), cause("presliding", "joint_2", equal=three[2:])]
    answers = [answer("a", "explained", *causes), answer("b", "explained", cause("interpolator_mismatch"))]
    found = scored(tmp_path, runs, answers)
    assert (found["outcomes"]["three"]["named"], found["outcomes"]["one"]["named"]) == (1, 1)
    assert (found["all_of_three"]["count"], found["all_of_two"]["of"]) == (1, 0)
    assert sum(row["found"]["of"] for row in found["power"]) == 0


@pytest.mark.parametrize("key", ["tool", "world", "recorder"])
def test_names_are_text_on_the_page(tmp_path: Path, key: str):
    scored(tmp_path, [truth("a")], [answer("a", "unknown")], out=tmp_path / "out")
    (result,) = read_results(tmp_path / "out" / "results.jsonl")
    text = page([{**result, key: "<img src=x> | [x](y) **z**\n# w_w"}])
    assert r"\<img src=x\> \| \[x\](y) \*\*z\*\* \# w_w" in text
    assert "\n# w" not in text


def test_the_page_counts_each_world_separately(tmp_path: Path):
    scored(tmp_path, [truth("a")], [answer("a", "unknown")], out=tmp_path / "out")
    (result,) = read_results(tmp_path / "out" / "results.jsonl")
    text = page([result, {**result, "world": "other"}, {**result, "world": "other", "run": "b"}])
    assert "## World tiny\n\n1 runs" in text
    assert "## World other\n\n2 runs" in text
    assert [text.count(f"| one effect: tool | 0 | 0 | 0 | 0 | {runs} | 0 | 0 |") for runs in (1, 2)] == [1, 1]


def test_the_page_is_made_of_the_results_and_defines_every_column(tmp_path: Path):
    runs = [truth("a", recorder="clean"), truth("b", "none", (), recorder="as recorded")]
    scored(tmp_path, runs, [answer("a", "explained", cause("stribeck", "joint_1"))], out=tmp_path / "out")
    results = read_results(tmp_path / "out" / "results.jsonl")
    assert [one["outcome"] for one in results] == ["named", "no answer"]
    text = page(results)
    assert text == (tmp_path / "out" / "blind_check.md").read_text()
    definitions = text.partition("## World")[0]
    for name in (*OUTCOMES, "joint", "class sizes", "withheld", "further cause wrong", "found", "right", "wrong"):
        assert f"`{name}`" in definitions
    assert "changed between draws" in text
    assert "## World tiny\n\n2 runs, answered by tool" in text
    assert "| tool, clean | 1 | 0 |" in text


def test_the_published_page_is_made_of_the_published_results():
    docs = Path(__file__).resolve().parents[2] / "docs"
    results = read_results(docs / "measured/blind-check-results.jsonl")
    for world in ("emulator", "mujoco"):
        assert len({one["run"] for one in results if one["world"] == world}) >= 30
    assert (docs / "measured/blind-check-results.md").read_text(encoding="utf-8") == page(results)


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_clopper_pearson_interval_has_its_nominal_tails(counts):
    from scipy.stats import binom

    hits, trials = counts
    low, high = clopper_pearson(hits, trials)
    assert 0 <= low <= hits / trials <= high <= 1
    if hits:
        assert binom.sf(hits - 1, trials, low) == pytest.approx(0.025, abs=1e-6)
    if hits < trials:
        assert binom.cdf(hits, trials, high) == pytest.approx(0.025, abs=1e-6)
