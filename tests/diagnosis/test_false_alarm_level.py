"""How often an arm is not called healthy at a level, measured on fresh motions of healthy arms."""

from __future__ import annotations

import pytest

from agent.blind_check import clopper_pearson
from agent.diagnosis.hypotheses.finding import Finding
from agent.diagnosis.hypotheses.healthy import healthy_on, with_healthy_effects
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.verdict import named
from agent.estimation import estimate
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record
from tests.verdicts import verdict_on

SETS = 20
LEVELS = (0.01, 0.05, 0.1)
MOTIONS = ("one", "two", "three")


def healthy_finding(machine: int) -> Finding:
    """Of three fresh motions of a machine, against a model of three others of its motions."""
    robot = make_arm("RRR")
    plant = Plant(robot, seed=machine)
    baseline, logs = (
        [record(plant, name, 1000 * machine + 10 * session + k) for k, name in enumerate(MOTIONS)] for session in (0, 1)
    )
    model = with_healthy_effects(estimate(robot, baseline), baseline)
    fit = assemble(robot, model, logs, None).fit
    return named(Search(fit, healthy=healthy_on(fit, model)).run())


@pytest.mark.verify
def test_the_false_alarm_level_on_fresh_healthy_motions(measured):
    findings = [healthy_finding(machine) for machine in range(101, 101 + SETS)]
    for level in LEVELS:
        hits = sum(finding.healthy < level for finding in findings)
        low, high = clopper_pearson(hits, SETS)
        target = f"{100 * level:g} % if the level holds; 95 % interval {100 * low:.0f} to {100 * high:.0f} %"
        measured(f"healthy sets of three motions beyond the {100 * level:g} % level", f"{hits} of {SETS}", "", target)
    alarms = sum(verdict_on(finding) != "no_gap" for finding in findings)
    measured("the same sets with a verdict", f"{alarms} of {SETS}")
    assert alarms <= 1
