"""Runs of an emulated arm, made here, and the model of its healthy machine."""

from collections.abc import Callable
from functools import cache

import pytest

from agent.diagnosis import Diagnosis, diagnose
from agent.estimation import estimate
from agent.model import IdentifiedModel
from agent.recording.log import Log
from agent.robot import RobotDescription
from fake_controller.plant import Plant
from tests.small_arms import record

#: What each case has built in.
CASES = {
    0: (),
    1: ({"effect": "stribeck", "joints": ["joint_2"], "parameters": {"rise": 39.0, "speed": 0.17}},),
    3: ({"effect": "joint_elasticity", "joints": ["joint_2"], "parameters": {"stiffness": 133e3}},),
}
#: Seed of each motion and the share of its amplitude.
MOTIONS = {"excite": (21, 1.0), "moves": (22, 0.8), "slow": (23, 0.3)}


@pytest.fixture(scope="session")
def arm(ns16) -> RobotDescription:
    return ns16


@pytest.fixture(scope="session")
def baseline(arm) -> IdentifiedModel:
    plant = Plant(arm, seed=3)
    return estimate(arm, [record(plant, "first", 11), record(plant, "second", 12)])


@pytest.fixture(scope="session")
def runs(arm) -> Callable[[int], list[Log]]:
    """Logs of a case by its number."""

    @cache
    def made(case: int) -> list[Log]:
        plant = Plant(arm, seed=3, effects=CASES[case])
        return [record(plant, name, *motion) for name, motion in MOTIONS.items()]

    return made


@pytest.fixture(scope="session")
def diagnosed(arm, baseline, runs) -> Callable[[int], Diagnosis]:
    """Diagnosis of a case against the healthy machine's model, made once."""
    return cache(lambda case: diagnose(arm, runs(case), baseline))
