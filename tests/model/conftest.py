"""The description of the bench."""

import pytest

from agent.robot import load_robot
from tests.model.bench import ROBOT, URDF, written


@pytest.fixture
def robot(tmp_path):
    written(tmp_path, URDF, "arm.urdf")
    return load_robot(written(tmp_path, ROBOT, "robot.yaml"))
