"""Decisions by log evidence: what stands in the logs is named, and what the healthy arm has already is not."""

import numpy as np
import pytest

from agent.blind_check import clopper_pearson
from agent.core import Console
from agent.diagnosis.hypotheses.healthy import healthy_on, with_healthy_effects
from agent.diagnosis.hypotheses.noise_model import HealthyForm
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.verdict import name_causes
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.pipeline import FitQuestion, estimate_files
from agent.recording import write_log
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record
from tests.verdicts import verdict_on

OFFSET = {"effect": "torque_offset", "joints": ["joint_2"], "parameters": {"offset": 6.0}}


@pytest.fixture(scope="module")
def robot():
    return make_arm("RR")


@pytest.fixture(scope="module")
def baseline(robot):
    return [record(Plant(robot, seed=3), f"healthy_{seed}", seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="module")
def model(robot, baseline):
    return estimate(robot, baseline, EstimationSettings.create())


def fit_of(robot, model, effects=(), seeds=(21, 22)):
    logs = [record(Plant(robot, seed=3, effects=effects), f"judged_{seed}", seed) for seed in seeds]
    return assemble(robot, model, logs, None).fit


def test_names_an_offset_or_an_equivalent_and_nothing_on_a_healthy_arm(robot, model):
    assert verdict_on(name_causes(Search(fit_of(robot, model)).run())) == "no_gap"
    decision = name_causes(Search(fit_of(robot, model, [OFFSET])).run())
    assert ("torque_offset", (1,)) in (decision.causes[0].key, *decision.rivals[0])
    assert decision.probability[0] > 0.6
    assert sum(h.probability for h in decision.hypotheses) == pytest.approx(1.0, abs=1e-6)


def test_an_effect_of_the_healthy_arm_is_not_named(robot, model):
    fit = fit_of(robot, model, [OFFSET])
    found = {cause.key for cause in name_causes(Search(fit).run()).causes}
    assert found
    forms = [form for batch in Search(fit).candidates() for form in batch if form.key in found]
    usual = [HealthyForm(form, np.full(len(form.names), 6.0)) for form in forms]  # N·m, as large as the effect
    again = name_causes(Search(fit, healthy=usual).run())
    assert not {cause.key for cause in again.causes} & found


@pytest.fixture(scope="module")
def odd(baseline, robot):
    """The baseline with an offset on its last day."""
    return [*baseline[:2], record(Plant(robot, seed=3, effects=[OFFSET]), "odd_day", 13)]


def test_learns_an_effect_present_in_one_baseline_log(robot, baseline, odd, model):
    """An offset on one day is part of what the arm has; a baseline without it teaches far less of it."""
    learned, plain = (with_healthy_effects(model, known) for known in (odd, baseline))
    larger, usual = (
        {(one.effect, one.joints): max(one.amount.values()) for one in each.healthy}.get(
            ("torque_offset", ("joint_2",)), 0
        )
        for each in (learned, plain)
    )
    assert larger > max(5 * usual, 1.0), "N·m: three days of which one has 6 N·m scatter by 3.5"
    fit, known = fit_of(robot, model), {one.effect for one in learned.healthy}
    for without in ((), ("torque_offset",)):
        assert {one.candidate.effect.name for one in healthy_on(fit, learned, without)} == known - {*without}
    assert IdentifiedModel.from_dict(learned.to_dict()).healthy == learned.healthy


def test_estimate_stores_the_effects_of_the_healthy_arm(robot, odd, tmp_path):
    """`agent estimate` keeps it in the file of the model, where a diagnosis reads it."""
    paths = [tmp_path / f"{number}.mcap" for number in range(len(odd))]
    for path, log in zip(paths, odd, strict=True):
        write_log(path, log)
    estimate_files(robot, paths, tmp_path / "model.json", FitQuestion(), Console(-1))
    healthy = IdentifiedModel.load(tmp_path / "model.json").healthy
    assert max(one.amount["offset"] for one in healthy if one.effect == "torque_offset") > 1.0


SETS = 20
LEVELS = (0.01, 0.05, 0.1)
MOTIONS = ("one", "two", "three")


def healthy_finding(machine: int) -> SelectedCauses:
    """Of three fresh motions of a machine, against a model of three others of its motions."""
    robot = make_arm("RRR")
    plant = Plant(robot, seed=machine)
    baseline, logs = (
        [record(plant, name, 1000 * machine + 10 * session + k) for k, name in enumerate(MOTIONS)] for session in (0, 1)
    )
    model = with_healthy_effects(estimate(robot, baseline), baseline)
    fit = assemble(robot, model, logs, None).fit
    return name_causes(Search(fit, healthy=healthy_on(fit, model)).run())


@pytest.mark.verify
def test_the_false_alarm_level_on_fresh_healthy_motions(measured):
    findings = [healthy_finding(machine) for machine in range(101, 101 + SETS)]
    for level in LEVELS:
        hits = sum(selected.healthy < level for selected in findings)
        low, high = clopper_pearson(hits, SETS)
        target = f"{100 * level:g} % if the level holds; 95 % interval {100 * low:.0f} to {100 * high:.0f} %"
        measured(f"healthy sets of three motions beyond the {100 * level:g} % level", f"{hits} of {SETS}", "", target)
    alarms = sum(verdict_on(selected) != "no_gap" for selected in findings)
    measured("the same sets with a verdict", f"{alarms} of {SETS}")
    assert alarms <= 1
