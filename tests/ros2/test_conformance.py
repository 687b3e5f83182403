"""The suite that every driver has to pass, on ROS 2: by topic, and by goals."""

import pytest

from drivers.conformance import DriverConformance


class TestByTopic(DriverConformance):
    @pytest.fixture
    def bench(self, ros_bench):
        return ros_bench()


class TestByGoal(DriverConformance):
    @pytest.fixture
    def bench(self, goal_types, ros_bench):
        return ros_bench(goals=True)
