"""Goals of the ROS 2 driver: what is sent by control_msgs and what comes back, with types of the same fields.

No wheel has control_msgs, so these types are written by hand, by control_msgs 5.8 (Jazzy). `tests/ros2` sends goals of
the real ones where they are installed.
"""

import os
import sys
from threading import Lock
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from drivers.transports.ros2 import link as links, ros
from drivers.transports.ros2.link import CANCELLED, RosLink
from drivers.wire.ros2 import RosAddress

JOINTS = ("a", "b")
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6  # action_msgs/GoalStatus


def message(name, /, **fields):
    """A type with these fields and no others; a field that is a function makes its value."""

    def new(self, **given):
        assert given.keys() <= fields.keys()
        for field, value in fields.items():
            setattr(self, field, given.get(field, value() if callable(value) else value))

    return type(name, (), {"__slots__": tuple(fields), "__init__": new})


Time = message("Time", sec=0, nanosec=0)
Header = message("Header", stamp=Time, frame_id="")
Point = message(
    "JointTrajectoryPoint", positions=list, velocities=list, accelerations=list, effort=list, time_from_start=Time
)
Trajectory = message("JointTrajectory", header=Header, joint_names=list, points=list)
Tolerance = message("JointTolerance", name="", position=0.0, velocity=0.0, acceleration=0.0)
Goal = message(
    "FollowJointTrajectory_Goal", trajectory=Trajectory, multi_dof_trajectory=None, path_tolerance=list,
    component_path_tolerance=list, goal_tolerance=list, component_goal_tolerance=list, goal_time_tolerance=Time,
)  # fmt: skip
TYPES = {
    "trajectory_msgs.msg": {"JointTrajectory": Trajectory, "JointTrajectoryPoint": Point},
    "control_msgs.msg": {"JointTolerance": Tolerance},
    "control_msgs.action": {"FollowJointTrajectory": SimpleNamespace(Goal=Goal)},
}


class Future:
    """What rclpy promises: one value, and who waits for it."""

    def __init__(self):
        self._heard, self._value = [], None

    def add_done_callback(self, heard):
        self._heard.append(heard)

    def result(self):
        return self._value

    def set(self, value):
        self._value = value
        for heard in self._heard:
            heard(self)


#: Held while an executor handles answers.
SENDING = Lock()


class Server:
    """The far end of an action client. It may answer before the client has noted the goal."""

    def __init__(self, *_):
        self.goals, self.answer, self.end, self.there = [], Future(), Future(), True

    def server_is_ready(self):
        return True

    def destroy(self):
        self.there = False

    def send_goal_async(self, goal):
        assert SENDING.locked()
        self.goals.append(goal)
        return self.answer

    def accept(self, accepted=True):
        self.answer.set(SimpleNamespace(accepted=accepted, get_result_async=lambda: self.end))

    def finish(self, status, code=0, text=""):
        self.end.set(SimpleNamespace(status=status, result=SimpleNamespace(error_code=code, error_string=text)))


@pytest.fixture
def link(monkeypatch):
    """A link whose node does nothing, with a sample that says which time it is there."""
    for package, types in {**TYPES, "rclpy.action": {"ActionClient": Server}}.items():
        module = ModuleType(package)
        vars(module).update(types)
        monkeypatch.setitem(sys.modules, package, module)
        monkeypatch.setitem(sys.modules, package.partition(".")[0], ModuleType(package.partition(".")[0]))
    node = SimpleNamespace(commands=lambda target: None, node=None, sending=SENDING, close=lambda: None)
    monkeypatch.setattr(links, "Ros", lambda domain, name: node)
    monkeypatch.setattr(RosLink, "_work", lambda self: self._closing.wait())
    found = RosLink(RosAddress.of("ros2://0/ns/arm"), 0.1, *[lambda *_: None] * 4)
    found.joints = JOINTS
    monkeypatch.setattr(found, "clock", lambda: 1_795_900_000.25)
    assert found.goals()
    yield found
    found.close()


def sent(link):
    heard = []
    points = [(0.2, np.zeros(2), np.zeros(2), np.zeros(2)), (1.7, np.ones(2), np.zeros(2), np.zeros(2))]
    stamp = link.send_goal(
        0.3, points, np.array([0.1, 0.05]), 1.5, lambda accepted: heard.append(accepted), lambda *end: heard.append(end)
    )
    (goal,) = link._goals.goals
    return stamp, goal, heard


def test_a_goal_brings_its_trajectory_its_tolerances_and_a_stamp_of_the_controllers_clock(link):
    stamp, goal, _ = sent(link)
    assert stamp == 1_795_900_000.55
    when = goal.trajectory.header.stamp
    assert when.sec + 1e-9 * when.nanosec == pytest.approx(stamp, abs=1e-6)
    assert goal.trajectory.joint_names == ["a", "b"]
    first, last = goal.trajectory.points
    assert (first.time_from_start.sec, first.time_from_start.nanosec) == (0, 200_000_000)
    assert (last.time_from_start.sec, last.time_from_start.nanosec) == (1, 700_000_000)
    assert (last.positions, last.velocities, last.accelerations) == ([1.0, 1.0], [0.0, 0.0], [0.0, 0.0])
    assert [(one.name, one.position, one.velocity) for one in goal.path_tolerance] == [
        ("a", 0.1, 0.0),
        ("b", 0.05, 0.0),
    ]
    assert not goal.goal_tolerance
    assert (goal.goal_time_tolerance.sec, goal.goal_time_tolerance.nanosec) == (1, 500_000_000)


@pytest.mark.parametrize(
    ("status", "code", "told"),
    [
        (SUCCEEDED, 0, 0),
        (ABORTED, -4, -4),
        (ABORTED, -5, -5),
        (CANCELED, 0, CANCELLED),  # by anybody: a controller gives it no error code
        (ABORTED, 0, CANCELLED),
    ],
)
def test_an_end_that_is_no_success_is_told_as_one(link, status, code, told):
    _, _, heard = sent(link)
    link._goals.accept()
    link._goals.finish(status, code, "why")
    assert heard == [True, (told, "why")]


def test_a_refused_goal_has_no_end(link):
    _, _, heard = sent(link)
    link._goals.accept(False)
    assert heard == [False]


def test_a_closed_link_is_no_commander_any_more(link):
    client = link._goals
    link.close()
    assert not client.there


def test_without_the_types_no_goal_is_sent(link, monkeypatch):
    link._goals = None
    monkeypatch.setattr(links, "typed", lambda package, name: None)
    assert not link.goals()
    assert ros.typed("no_such_msgs.msg", "Nothing") is None


LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
UDP, MEMORY = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}, {"FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"}
BY_PROFILE = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT", "FASTRTPS_DEFAULT_PROFILES_FILE": ros._LOCAL}


@pytest.mark.parametrize(
    ("chosen", "used"),
    [
        ({}, UDP),
        (MEMORY, MEMORY),
        (LOCAL, BY_PROFILE),
        ({**LOCAL, "FASTRTPS_DEFAULT_PROFILES_FILE": ros._LOCAL}, BY_PROFILE),  # of the second process
        ({**LOCAL, "FASTRTPS_DEFAULT_PROFILES_FILE": "mine.xml"}, LOCAL),
        ({**LOCAL, "ROS_STATIC_PEERS": "192.0.2.1"}, LOCAL),
        ({**LOCAL, **MEMORY}, LOCAL),
        ({**LOCAL, "middleware": "rmw_cyclonedds_cpp"}, LOCAL),
        ({**LOCAL, "begun": "1"}, LOCAL),
    ],
)
def test_a_node_that_is_killed_holds_no_lock_that_others_wait_for(monkeypatch, chosen, used):
    """By shared memory an agent that was killed kept the emulated arm from moving, braking and publishing for 3 s."""
    monkeypatch.setattr(os, "environ", dict(chosen))
    seen = {}
    nothing = lambda *_, **__: SimpleNamespace(add_node=lambda node: None)  # noqa: E731
    options = SimpleNamespace(NO=0)
    init = lambda **_: seen.update(os.environ)  # noqa: E731
    middleware = chosen.get("middleware", "rmw_fastrtps_cpp")
    monkeypatch.setattr(ros, "_begins", lambda: "begun" not in chosen)
    for package, values in {
        "rclpy": {"Context": nothing, "init": init, "SignalHandlerOptions": options},
        "rclpy.executors": {"SingleThreadedExecutor": nothing},
        "rclpy.node": {"Node": nothing},
        "rclpy.utilities": {"get_rmw_implementation_identifier": lambda: middleware},
    }.items():
        module = ModuleType(package)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, package, module)
    ros.Ros(0, "agent")
    assert seen.items() >= used.items()
    assert {**os.environ, **chosen} == os.environ, "what was chosen stays for others, and for the second process"
