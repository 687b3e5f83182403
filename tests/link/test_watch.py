"""Recording without driving: from messages as bytes to a log. cyclonedds is tried where it is installed."""

import importlib.util
import os
import signal

import numpy as np
import pytest

from agent.core import Console
from agent.link import record_watched
from agent.recording import read_log
from drivers.transports.ros2.watch import WatchedArm
from fake_controller.ros2.node import JointStateWriter
from tests.link.test_wire_ros2 import JOINT_STATE, POSITIONS, STATE

PERIOD = 0.002


def observed(stamps):
    """An observation of joints b and a that has been given messages with these stamps [s]."""
    found, writer = WatchedArm(), JointStateWriter(["b", "a"])
    for k, stamp in enumerate(stamps):
        found.take(False, writer.write(stamp, *(np.array([k, -k]) + row for row in range(3))))
    found.settle()
    return found


def test_every_sample_that_came_is_there_and_gaps_are_counted():
    whole = 100.0 + PERIOD * np.arange(9000)
    lost = [200, *range(300, 3300), 3400, 3401]
    found = observed(np.delete(whole, lost))
    block = found.new_samples(received=5.0)
    assert (len(block), found.samples, found.lost) == (5997, 5997, 3003)
    assert found.rate == pytest.approx(500.0, rel=1e-3)
    assert found.longest == pytest.approx(3001 * PERIOD, rel=1e-3)
    assert block.sequence[-1] == 8999
    assert block.time == pytest.approx(np.delete(whole, lost), abs=1e-6)
    assert block.position[5].tolist() == [5.0, -5.0]
    assert found.new_samples(6.0) is None


def test_late_samples_and_a_clock_that_drifts_are_no_losses():
    rng = np.random.default_rng(1)
    stamps = 100.0 + 1.0005 * PERIOD * np.arange(20_000)
    late = np.arange(50, 20_000, 37)
    stamps[late] += 0.8 * PERIOD
    assert observed(stamps + rng.normal(0.0, 0.05 * PERIOD, len(stamps))).lost == 0


def test_a_clock_that_is_set_back_loses_nothing():
    stamps = np.concatenate([100.0 + PERIOD * np.arange(500), 40.0 + PERIOD * np.arange(500)])
    found = observed(stamps)
    assert (found.samples, found.lost, found.clock_steps) == (1000, 0, 1)


def test_the_controller_says_which_joints_are_its_own():
    found = WatchedArm()
    for state, data in ((False, JOINT_STATE), (True, STATE), (False, b"\0\1\0\0rubbish"), (True, STATE[:60])):
        found.take(state, data)
    found.settle()
    assert (found.joints, found.others) == (("shoulder", "elbow"), {"gripper"})
    assert (found.samples, found.set_points, found.damaged, found.unreadable) == (1, 1, 1, 1)
    assert found.new_samples(0.0).torque.tolist() == [[-42.5, 3.0]]
    _, position, velocity = found.new_set_points()
    assert (position.tolist(), velocity.tolist()) == ([[1.0, 2.0]], [[0.1, 0.2]])
    found.take(False, JointStateWriter(["finger"]).write(1.0, *np.zeros((3, 1))))
    assert found.foreign == 1


class Source:
    """Hands out messages in turns, then sends this process a signal in the middle of a turn."""

    without = ""

    def __init__(self, number):
        self.observed, self.turns, self.number, self.closed = WatchedArm(), 0, number, False

    def open(self):
        for _ in range(3):
            self.observed.take(False, POSITIONS)
            self.observed.take(True, STATE)

    def receive(self):
        self.turns += 1
        for k in range(10):
            stamp = 1795903665.25 + PERIOD * (10 * self.turns + k)
            if (self.turns, k) == (4, 5):
                os.kill(os.getpid(), self.number)
            self.observed.take(False, JointStateWriter(["elbow", "shoulder"]).write(stamp, *np.ones((3, 2))))

    def close(self):
        self.closed = True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_recording_with_the_log_complete(number, tmp_path, monkeypatch, capsys):
    source = Source(number)
    monkeypatch.setattr("agent.link.watch.watch", lambda address, tell: source)
    log = tmp_path / "a.mcap"
    result = record_watched("ros2://0/jtc", log, Console())
    assert (result.samples, result.set_points, source.closed) == (43, 3, True)
    assert "43 samples" in capsys.readouterr().err
    read = read_log(log)
    assert read.joint_names == ("shoulder", "elbow")
    assert (len(read.t) >= 40, read.metadata["motion"], read.metadata["watched"]) == (True, "watched", "ros2://0/jtc")


@pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="needs pip install 'calibration-agent[dds]'")
def test_cyclonedds_listens():
    """Another participant of this process publishes."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from drivers.transports.ros2.dds import Dds, message_types

    domain = 1 + os.getpid() % 100
    listener = Dds(domain)
    kind = message_types()["sensor_msgs.msg.JointState"]
    participant = DomainParticipant(domain)
    writer = DataWriter(participant, Topic(participant, "rt/joint_states", kind), Qos(Policy.Reliability.BestEffort))
    while listener.best_effort("/joint_states") is None:
        listener.spin_once(0.05)
    assert listener.best_effort("/joint_states") is True
    found = WatchedArm()
    listener.raw("sensor_msgs.msg", "JointState", "/joint_states", lambda data: found.take(False, data))
    header = kind.__annotations__["header"]
    stamp = header.__annotations__["stamp"]
    while not found.seen:
        writer.write(kind(header(stamp(7, 500_000_000), ""), ["a"], [1.0], [], []))
        listener.spin_once(0.05)
    found.settle()
    assert found.joints == ("a",)
    assert found.new_samples(0.0).time[0] == 7.5
    listener.close()
