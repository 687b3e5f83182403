"""The simple tools that the blind check compares with: one locates, one names what a refit changes."""

import pytest

from benchmarks.blind_baselines import Gap, ranking, refit
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record

RUBS = {"effect": "friction_change", "joints": ["joint_2"], "parameters": {"coulomb": 2.0, "viscous": 2.0}}


def gap_of(*effects: dict) -> Gap:
    robot = make_arm("RRR")
    healthy, judged = Plant(robot, seed=3), Plant(robot, seed=3, effects=effects)
    baseline = [record(healthy, f"baseline_{seed}", seed) for seed in (11, 12, 13)]
    return Gap.between(robot, baseline, [record(judged, f"log_{seed}", seed) for seed in (21, 22, 23)])


@pytest.mark.parametrize("method", [ranking, refit])
def test_a_healthy_machine_has_no_gap(method):
    assert method(gap_of())["verdict"] == "no_gap"


def test_more_friction_is_located_by_both_and_named_by_the_refit():
    gap = gap_of(RUBS)
    located, named = ranking(gap), refit(gap)
    assert (located["verdict"], located["causes"]) == ("unknown", [])
    assert located["where"][0]["joint"] == "joint_2"
    (cause,) = named["causes"]
    assert (named["verdict"], cause["effect"], cause["joints"]) == ("explained", "friction_change", ["joint_2"])
    assert cause["probability"] > 0.7
