"""The suite that every driver has to pass, on ROS 2: by topic, and by goals where control_msgs is installed."""

import pytest

from drivers.conformance import DriverConformance
from tests.ros2.conftest import GOALS


class TestByTopic(DriverConformance):
    @pytest.fixture
    def bench(self, ros_bench):
        found = ros_bench(goals=False)
        found.set_points = False
        return found


@pytest.mark.skipif(not GOALS, reason="needs control_msgs, which has no wheel: source ROS 2 with it")
class TestByGoal(DriverConformance):
    @pytest.fixture
    def bench(self, ros_bench):
        return ros_bench()
