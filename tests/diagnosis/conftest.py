"""Runs of the simulated arm beside the checkout, and the model of its baseline."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from agent.diagnosis import Diagnosis, diagnose
from agent.estimation import estimate
from agent.model import IdentifiedModel
from agent.recording import read_log
from agent.recording.log import Log
from agent.robot import RobotDescription, load_robot

MOTIONS = ("excite", "moves", "slow")


@pytest.fixture(scope="session")
def arm(shared_data) -> RobotDescription:
    return load_robot(shared_data / "gap-dev")


@pytest.fixture(scope="session")
def baseline(shared_data, arm) -> IdentifiedModel:
    return estimate(arm, [read_log(shared_data / f"gap-dev/baseline/{name}.mcap", arm) for name in MOTIONS[:2]])


@pytest.fixture(scope="session")
def runs(shared_data, arm) -> Callable[[int], list[Log]]:
    """Logs of a case by its number."""

    @cache
    def read(case: int) -> list[Log]:
        folder = shared_data / f"gap-dev/case_{case:02d}/logs"
        return [read_log(folder / f"{name}.mcap", arm) for name in MOTIONS]

    return read


@pytest.fixture(scope="session")
def diagnosed(arm, baseline, runs) -> Callable[[int], Diagnosis]:
    """Diagnosis of a case against the baseline's model, made once."""
    return cache(lambda case: diagnose(arm, runs(case), baseline))
