"""Logs that another program wrote, where they are at hand."""

import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages

from agent.recording import read_log
from agent.robot import load_robot


def test_every_log_of_the_other_simulation_is_read_whole(shared_data):
    robot = load_robot(shared_data / "gap-dev")
    paths = sorted((shared_data / "gap-dev").glob("**/*.mcap"))
    assert len(paths) > 10
    for path in paths:
        log = read_log(path, robot)
        assert log.joint_names == robot.joint_names
        assert log.sample_rate == 500.0
        assert log.cycle_starts == (0.0, 10.0)
        assert log.repairs == ()
        assert log.segments == ((0, len(log.t)),)
        for values in (log.position, log.velocity, log.effort, log.reference_position, log.planned_position):
            assert values is not None
            assert np.isfinite(values).all()


def test_numbers_are_those_of_the_ros_reader(shared_data):
    path = shared_data / "gap-dev/case_02/logs/slow.mcap"
    log = read_log(path)
    states = [m.ros_msg for m in read_ros2_messages(str(path), topics=["/joint_states"])]
    np.testing.assert_array_equal(log.position, [m.position for m in states])
    np.testing.assert_array_equal(log.velocity, [m.velocity for m in states])
    np.testing.assert_array_equal(log.effort, [m.effort for m in states])
    first = states[0].header.stamp
    assert log.stamp == pytest.approx(first.sec + 1e-9 * first.nanosec)
