"""Every number that may change an answer has a line in docs/measured/numbers.csv, and varying one varies that alone."""

from dataclasses import replace
from functools import cache

import grimp
import numpy as np
import pytest

from agent.diagnosis import diagnose, diagnosis
from agent.diagnosis.gap import adequacy
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.position_logs import stretch
from agent.model import CATALOGUE
from agent.model.effects import payload, stribeck
from benchmarks import sensitivity
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record


@cache
def numbers() -> dict[str, sensitivity.Site]:
    return {site.key: site for site in sensitivity.sites()}


def test_every_number_has_its_line():
    lines = {number: row["value"] for number, row in sensitivity.table().items()}
    now = {number: site.value for number, site in numbers().items()}
    differ = sorted(number for number in now.keys() | lines.keys() if now.get(number) != lines.get(number))
    assert differ == [], "say what they change, or take them out: python -m benchmarks.sensitivity --runs 12"
    assert sensitivity.PAGE.read_text("utf-8") == sensitivity.page(list(sensitivity.table().values()))


def test_at_most_eighty_numbers_decide_and_each_says_what_it_is():
    rows = sensitivity.table()
    decide = [site for number, site in numbers().items() if sensitivity.kind_of(site, rows[number]) == "decides"]
    assert len(decide) <= 80, "a number that decides enters by deleting one"
    assert [site.key for site in decide if not site.comment] == []


def test_what_is_called_numerical_changes_nothing():
    rows = sensitivity.table()
    claimed = [rows[number] for number, site in numbers().items() if site.claims == "numerical"]
    changed = [row["number"] for row in claimed if any(int(row[name] or 0) for name in sensitivity.COLUMNS[4:])]
    assert changed == [], "it decides: say so in its comment"


def test_a_number_is_numerical_only_once_runs_that_reach_it_show_nothing(numerical):
    row = {"runs": "10", "executed": "3", **dict.fromkeys(sensitivity.COLUMNS[4:], "0")}
    assert sensitivity.kind_of(numerical, row) == "numerical"
    for less in ({"runs": "0"}, {"executed": "0"}, {"half_answers": "1"}, {"double_probabilities": "1"}):
        assert sensitivity.kind_of(numerical, row | less) == "decides"
    assert sensitivity.kind_of(replace(numerical, comment="of rows"), row) == "decides"


def test_numbers_of_figures_belong_to_packages_that_no_verdict_is_made_by():
    graph = grimp.build_graph("agent", cache_dir=None)
    name = sensitivity.FIGURES[0].replace("/", ".")
    assert not [chain for chain in graph.find_shortest_chains("agent.diagnosis.workflow", name)]


@pytest.mark.parametrize(
    ("shift", "verdict"), [(0.0, "ambiguous"), pytest.param(15.0, "unknown", marks=pytest.mark.verify)]
)
def test_shares_of_regimes_are_only_shown(monkeypatch, shift: float, verdict: str):
    arm = make_arm("RR")
    effect = {"effect": "asymmetric_friction", "joints": ["joint_2"], "parameters": {"coulomb": 0.2}}
    logs = [record(Plant(arm, seed=3, effects=[effect]), name, seed) for name, seed in (("one", 21), ("two", 22))]
    logs[1] = replace(logs[1], effort=logs[1].effort + shift)
    model = learn(arm)
    shown = diagnose(arm, logs, model).result
    monkeypatch.setattr(adequacy, "regimes", lambda *_: ())
    monkeypatch.setattr(diagnosis, "regimes", lambda *_: ())
    monkeypatch.setattr(diagnosis, "share_intervals", lambda rows, floor, block: np.zeros((len(floor), 2)))
    bare = diagnose(arm, logs, model).result
    assert shown["verdict"] == bare["verdict"] == verdict
    assert shown["causes"] == bare["causes"]
    assert [(e["joint"], e["share"]) for e in shown["where"]] == [(e["joint"], e["share"]) for e in bare["where"]]


@pytest.fixture
def numerical():
    return replace(numbers()["diagnosis/hypotheses/pool: _AT_ONCE"], comment="numerical: rows worked out together")


@pytest.mark.parametrize(
    ("value", "half", "double"),
    [(0.2, 0.1, 0.4), (3, 2, 6), (0.95, 0.975, 0.9), (1.1, 1.05, 1.2), ((0.1, 2.0), (0.05, 1.0), (0.2, 4.0))],
)
def test_shares_and_factors_are_varied_by_what_they_leave(value, half, double):
    assert sensitivity.varied(value, 0.5) == pytest.approx(half)
    assert sensitivity.varied(value, 2.0) == pytest.approx(double)


def test_a_number_is_varied_wherever_it_stands_and_put_back():
    plausible = CATALOGUE["payload"].plausible
    light = {"mass": 0.015, **dict.fromkeys(("moment_x", "moment_y", "moment_z"), 0.0)}
    assert plausible({}, light)
    with sensitivity.changed(numbers()["model/effects/payload: _LEAST_MASS"], 2.0):
        assert not plausible({}, light)
    assert plausible({}, light)
    with sensitivity.changed(numbers()["diagnosis/hypotheses/law: EvidenceLaw.sure"], 2.0):
        assert LAW.sure == pytest.approx(0.2)
    assert LAW.sure == 0.6
    with sensitivity.changed(numbers()["model/effects/effect: Effect.practical"], 2.0):
        assert CATALOGUE["stribeck"].practical == 2 * 0.01
    assert stribeck.Stribeck.practical == 0.01
    with sensitivity.changed(numbers()["model/effects/effect: SLIDES"], 2.0):
        assert CATALOGUE["stribeck"].needs_travel == CATALOGUE["stribeck"].needs_speed == 2 * 0.02
    assert stribeck.Stribeck.needs_travel == 0.02
    with sensitivity.changed(numbers()["diagnosis/position_logs/stretch: stretches_of.1.5"], 0.5):
        assert 1.25 in stretch.stretches_of.__code__.co_consts
    assert 1.25 not in stretch.stretches_of.__code__.co_consts
    finest = CATALOGUE["backlash"].grid[0]
    with sensitivity.changed(numbers()["model/effects/backlash: _GAPS"], 2.0):
        assert CATALOGUE["backlash"].grid[0][-1] == 2 * finest[-1]
    assert CATALOGUE["backlash"].grid[0] == finest
    with sensitivity.changed(numbers()["model/effects/payload: _LEAST_RADIUS"], 0.5):
        assert payload._LEAST_RADIUS == 0.025
    assert payload._LEAST_RADIUS == 0.05
