"""An emulated arm on ROS 2. Everything here needs rclpy, and skips without it; `make ros` makes an environment."""

import contextlib
import functools
import importlib
import importlib.util
import itertools
import json
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.registry import create
from fake_controller.build import build_ros2_cell
from tests.conftest import patience

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
HERE = importlib.util.find_spec("rclpy") is not None
#: What stands for control_msgs where it is not installed.
GOALS = str(Path(__file__).with_name("goals"))

JOINTS = ("shoulder", "elbow")
CONTROLLER = "arm_controller"
#: One domain a process: those of two test runs at once do not meet.
DOMAIN = 1 + os.getpid() % 100
_arms = itertools.count(1)


def pytest_collection_modifyitems(items):
    """Without rclpy nothing of this folder runs."""
    needs = pytest.mark.skip(reason="needs ROS 2 (Jazzy or later): source it, or run `make ros`")
    for item in items:
        if not HERE and item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(needs)


@functools.cache
def goal_modules():
    """control_msgs, or what stands for it: by unmodified rclpy, in both cases."""
    sys.path.append(GOALS)
    try:
        return {
            name: importlib.import_module(name) for name in ("control_msgs", "control_msgs.msg", "control_msgs.action")
        }
    finally:
        sys.path.remove(GOALS)
        for name in [name for name in sys.modules if name.partition(".")[0] == "control_msgs"]:
            del sys.modules[name]


@pytest.fixture
def goal_types(monkeypatch):
    """From here on this process, and those that it starts, can send goals."""
    for name, module in goal_modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setenv("PYTHONPATH", GOALS, prepend=os.pathsep)


def goal(way, seconds, cycles=1, joints=JOINTS, tolerance=0.15):
    """A line of a program: out by `way` [rad] and back within `seconds`, rest to rest, `cycles` times."""
    t = np.arange(0.0, seconds + 0.01, 0.05)
    phase = 2 * np.pi * t / seconds
    rows = [
        way * (1 - np.cos(phase)) / 2,
        way * np.pi / seconds * np.sin(phase),
        way * 2 * (np.pi / seconds) ** 2 * np.cos(phase),
    ]
    rows[1][[0, -1]] = rows[2][[0, -1]] = 0.0
    points = [
        {
            **{
                name: [float(row[k])] * len(joints)
                for name, row in zip(("positions", "velocities", "accelerations"), rows, strict=True)
            },
            "time_from_start": dict(zip(("sec", "nanosec"), divmod(round((t[k] + 0.2) * 1e9), 10**9), strict=True)),
        }
        for k in range(len(t))
    ]
    trajectory = {"joint_names": list(joints), "points": points}
    tolerances = [{"name": name, "position": tolerance} for name in joints]
    return json.dumps({"cycles": cycles, "goal": {"trajectory": trajectory, "path_tolerance": tolerances}}) + "\n"


def program(*lines, joints=JOINTS):
    """The text of a program `p`."""
    return json.dumps({"program": "p", "joint_names": list(joints)}) + "\n" + "".join(lines)


SHORT = program(goal(0.2, 2.0))
LONG = program(goal(1.0, 19.0))


class Unhurried:
    """Time [s] that waits while this process is kept waiting: a real controller has a computer of its own."""

    def __init__(self):
        self._read = self._now = time.time()
        self._lock = threading.Lock()

    def __call__(self):
        with self._lock:
            before, self._read = self._read, time.time()
            self._now += min(self._read - before, 0.05)  # at most as many cycles as it makes at once
            return self._now


class RosBench:
    """An arm in a namespace of its own, and drivers for it."""

    joint_names = JOINTS
    short, long, comment = SHORT, LONG, "#"

    def __init__(self, arm, undo, **options):
        from fake_controller.ros2.node import Ros2Server

        self.undo = undo
        self.address = f"ros2://{DOMAIN}/arm_{next(_arms)}/{CONTROLLER}"
        self.set_points = options.pop("goals", False)
        self.cell = build_ros2_cell(arm, 3, clock=Unhurried(), **options)
        self.server = Ros2Server(self.cell, self.address, self.set_points)
        undo.callback(self.server.close)

    def driver(self, **options):
        return self.created(self.address, **options)

    def created(self, address, **options):
        driver = create("ros2", address, **{"timeout": patience(10.0), "watchdog": patience(0.5), **options})
        self.undo.callback(driver.close)
        return driver

    def nobody(self):
        return self.created(f"ros2://{DOMAIN}/nowhere/{CONTROLLER}", timeout=1.0)

    def mute(self):
        return self._answering()

    def stranger(self):
        return self._answering("joint_states", patience(3.0))

    def _answering(self, topic=None, timeout=1.5):
        """Somebody with the parameters of a controller, who publishes texts or nothing."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from std_msgs.msg import String

        namespace = f"/stranger_{next(_arms)}"
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=DOMAIN, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        node = rclpy.node.Node(CONTROLLER, namespace=namespace, context=context)
        node.declare_parameter("joints", list(JOINTS))
        if topic:
            node.create_publisher(String, f"{namespace}/{topic}", 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        over = threading.Event()

        def spin():
            while not over.is_set():
                executor.spin_once(timeout_sec=0.1)

        thread = threading.Thread(target=spin, daemon=True)
        thread.start()
        for end in (context.try_shutdown, node.destroy_node, thread.join, over.set):
            self.undo.callback(end)
        return self.created(f"ros2://{DOMAIN}{namespace}/{CONTROLLER}", timeout=timeout)

    def motions_started(self):
        return self.cell.controller.started

    def moving(self):
        return self.cell.moving

    def cut(self):
        self.silence()

    def silence(self):
        """Samples stop; commands still arrive."""
        from fake_controller.faults import Fault

        self.cell._lies["mute"] = Fault("mute", "streaming")

    def replay(self):
        """What was sent arrives once more."""
        for message in list(self.server.taken):
            self.server.take(message)


@pytest.fixture
def ros_bench(arm):
    """A function that makes benches: options of `build_ros2_cell`, and `goals` with `goal_types`."""
    with contextlib.ExitStack() as undo:
        yield lambda **options: RosBench(arm, undo, **options)
