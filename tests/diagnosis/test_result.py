"""The result by the definitions of the contract, and what is said of bad input."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core import Console
from agent.core.errors import InputError
from agent.diagnosis import diagnose
from agent.model import CATALOGUE
from agent.pages import headline
from agent.pages.diagnosis.page import diagnosis_report
from agent.pipeline import GapQuestion, diagnose_files
from agent.pipeline.gap.printed_diagnosis import diagnosis_text

CONTRACTS = Path(__file__).parents[3] / "shared/CONTRACTS.md"


@pytest.mark.skipif(not CONTRACTS.is_file(), reason="the contracts are not part of this repository")
def test_the_catalogue_has_every_name_of_the_contracts():
    (table,) = re.findall(r"(?ms)^## [^\n]*Vocabulary of effects$(.*?)(?=^## |\Z)", CONTRACTS.read_text("utf-8"))
    named = re.findall(r"(?m)^\| `(\w+)` \|", table)
    assert len(named) > 20
    assert set(named) <= {effect.name for effect in CATALOGUE.built_in}


def test_effects_name_only_effects_of_the_catalogue():
    for effect in CATALOGUE.values():
        assert all((effect.formula, effect.source, effect.signature, effect.look_at))
        assert set(effect.confused_with) | set(effect.structurally_equivalent) <= set(CATALOGUE)


def test_rows_of_compared_effects_are_made_again(diagnosed):
    found = diagnosed(1).selected
    forms = {form.effect.name: form for one in found.hypotheses for form in one.effects}
    afresh = found.plain.with_reference(found.plain.reference)
    for form in forms.values():
        form.release()
        made = afresh.candidate(form.effect, form.joints, form.settings)
        for joint, rows in made.blocks.items():
            np.testing.assert_allclose(form.blocks[joint], rows, rtol=1e-9, atol=1e-9 * np.abs(rows).max())
    assert len(forms) > 3


@pytest.mark.parametrize("case", [0, 1])
def test_figures_match_their_definitions(diagnosed, case):
    result = diagnosed(case).result
    json.dumps(result, allow_nan=False)
    assert result["schema"] == "diagnosis/1"
    gap = result["gap"]
    before, after, floor = (np.array(gap[key]) for key in ("before", "after", "floor"))
    b, a, f = (np.mean(part**2) for part in (before, after, floor))
    if b < 1.21 * f:
        assert result["closure"] is None
    else:
        assert result["closure"] == pytest.approx((b - a) / (b - f))
    shares = {entry["joint"]: entry["share"] for entry in result["where"]}
    assert sum(shares.values()) == pytest.approx(1)
    for entry in result["where"]:
        low, high = entry["interval"]
        assert 0 <= low <= high <= 1
    excess = np.maximum(before**2 - floor**2, 0)
    if excess.any():
        assert [shares[name] for name in gap["joints"]] == pytest.approx(excess / excess.sum())
    assert {fold["held_out"] for fold in result["folds"]} == {"excite.mcap", "moves.mcap", "slow.mcap"}
    assert all(fold["held_out"] not in fold["fitted_on"] for fold in result["folds"])
    for cause in result["causes"]:
        assert 0 < cause["probability"] <= 1


def test_a_healthy_machine_has_no_gap_and_a_built_in_effect_is_named(diagnosed):
    assert (diagnosed(0).result["verdict"], diagnosed(0).result["causes"]) == ("no_gap", [])
    assert diagnosed(1).result["verdict"] == "explained"
    assert [(cause["effect"], cause["joints"]) for cause in diagnosed(1).result["causes"]] == [
        ("stribeck", ["joint_2"])
    ]


def test_the_page_and_the_text_name_the_cause(diagnosed):
    page = diagnosis_report(diagnosed(1))
    assert "joint_2, most likely: friction rises as the joint slows down (stribeck)." in page
    assert "lubrication" in page
    assert "1970" not in page, "the clock of these logs counts from its start"
    text = diagnosis_text(diagnosed(1).result)
    assert "stribeck on joint_2" in text
    steps = diagnosed(1).result["waterfall"]
    assert [entry["step"] for entry in steps][:: len(steps) - 1] == ["stribeck of joint_2", "remainder"]
    assert sum(entry["closes"] for entry in steps) == pytest.approx(1)
    assert sum(entry["closes"] for entry in steps[:-1]) == pytest.approx(diagnosed(1).result["closure"])
    assert steps[0]["closes"] == pytest.approx(steps[0]["alone"]), "the named cause has what it closes alone"
    assert steps[0]["closes"] > 0.98
    assert "It closes 99 % of the gap" in text
    assert re.search(r"stribeck of joint_2 .*####", text)
    assert "stribeck of joint_2" in page
    assert "waterfall" not in diagnosed(0).result


def test_a_single_log_is_split_and_the_answer_is_reproducible(arm, baseline, runs):
    one = runs(1)[2:]
    first, second = (diagnose(arm, one, baseline).result for _ in range(2))
    assert json.dumps(first) == json.dumps(second)
    assert first["causes"][0]["joints"] == ["joint_2"]
    assert len(first["folds"]) > 1
    assert any("one motion only" in warning for warning in first["warnings"])


def test_a_late_moving_joint_is_reported_as_interpolator_mismatch(arm, baseline, runs):
    logs = []
    for log in runs(0)[1:]:
        planned = np.array(log.reference_position)
        late = np.roll(planned, 10, axis=0)
        late[:10] = planned[:1]
        logs.append(replace(log, planned_position=planned, reference_position=late))
    result = diagnose(arm, logs, baseline).result
    assert [cause["effect"] for cause in result["causes"]] == ["interpolator_mismatch"]
    assert max(result["motion_gap"]["after"]) < 0.3 * max(result["motion_gap"]["before"])


def test_a_small_controller_delay_is_not_a_gap(arm, baseline, runs):
    """Ramps of a controller are never quite those that were planned with: a ten-thousandth of the speed is no cause."""
    logs = []
    for log in runs(0)[1:]:
        start, reference = log.t[0], np.array(log.reference_position)
        planned = np.column_stack([np.interp(start + 1.0004 * (log.t - start), log.t, one) for one in reference.T])
        logs.append(replace(log, planned_position=planned))
    found = diagnose(arm, logs, baseline)
    assert max(found.result["motion_gap"]["before"]) > 1e-4
    assert (found.result["verdict"], found.result["causes"]) == ("no_gap", [])
    assert any("practical size" in warning for warning in found.warnings)


def test_a_log_that_is_given_twice_counts_once(arm, baseline, runs, diagnosed):
    found = diagnose(arm, [*runs(0), runs(0)[1]], baseline)
    assert any("the same samples" in warning for warning in found.warnings)
    assert found.result["folds"] == diagnosed(0).result["folds"]


def test_reports_invalid_input_in_one_message(arm, baseline, runs):
    with pytest.raises(InputError, match="no logs"):
        diagnose(arm, [], baseline)
    with pytest.raises(InputError, match="squeak"):
        diagnose(arm, runs(0), baseline, without=["squeak"])
    other = [replace(runs(0)[0], joint_names=tuple("abcdef"))]
    with pytest.raises(InputError, match="its joints are"):
        diagnose(arm, other, baseline)
    short = [replace(runs(0)[0], segments=((0, 60),))]
    with pytest.raises(InputError, match="longest segment"):
        diagnose(arm, short, baseline)


def test_warns_of_a_model_of_another_arm(baseline, tmp_path, capsys):
    """Many arms have joints of the same names: the other one's nominal torques would be what errors are shares of."""
    baseline.save(tmp_path / "model.json")
    ur10e = str(Path(__file__).parents[2] / "recipes/examples/ur10e/robot.yaml")
    with pytest.raises(InputError, match="no such file"):
        diagnose_files(ur10e, [tmp_path / "log.mcap"], GapQuestion(tmp_path / "model.json"), Console())
    assert f"is a model of {baseline.robot.name}, but --robot names ur10e" in capsys.readouterr().err


def test_torque_in_coarse_steps_is_not_clipped(arm, baseline, runs):
    """Around its peak it stays at one step for some samples, as long as at the steps below."""
    log = runs(0)[2]
    step = 0.01 * np.abs(log.effort).max(axis=0)
    warnings = diagnose(arm, [replace(log, effort=np.round(log.effort / step) * step)], baseline).warnings
    assert not any("clipped" in text for text in warnings)


def test_warns_of_clipped_torque_and_a_stationary_joint(arm, baseline, runs):
    log = runs(0)[2]
    effort, position = log.effort.copy(), log.position.copy()
    limit = np.quantile(np.abs(effort[:, 1]), 0.9)
    effort[:, 1] = np.clip(effort[:, 1], -limit, limit)
    position[:, 5] = position[0, 5]
    warnings = diagnose(arm, [replace(log, effort=effort, position=position)], baseline).warnings
    assert any("joint_2" in text and "clipped" in text for text in warnings)
    assert any("a joint that never moves can be judged: joint_6" in text for text in warnings)


def test_no_gap_says_what_the_logs_could_show(diagnosed):
    """The power is that of the testability; a weak model, or one that sees less than half, never "agrees"."""
    result = diagnosed(0).result
    missed = {(entry["effect"], entry["joint"]) for entry in result["not_testable"]}
    for entry in result["power"]:
        found = entry["smallest"] is not None and entry["smallest"] <= entry["practical"]
        assert found != ((entry["effect"], entry["joint"]) in missed), entry
    assert "No gap: model and robot agree" in headline(result)
    blind = [{**entry, "smallest": 10 * entry["practical"]} for entry in result["power"]]
    for weak in ({"power": blind}, {"model_error": 0.13}):
        said = {**result, **weak}
        assert headline(said) == "No change found that these logs could show."
        assert "agree" not in diagnosis_text(said)
