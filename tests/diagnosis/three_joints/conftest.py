"""A small arm of three revolute joints, and what was learned of it."""

import pytest

from agent.model import IdentifiedModel
from agent.robot import RobotDescription
from tests.small_arms import learn, make_arm


@pytest.fixture(scope="session")
def arm() -> RobotDescription:
    return make_arm("RRR")


@pytest.fixture(scope="session")
def model(arm) -> IdentifiedModel:
    return learn(arm)
