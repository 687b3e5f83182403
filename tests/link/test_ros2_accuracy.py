"""A model identified by ROS 2 is as good as one identified over TCP: the same arm and loops, in simulated time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core import Console
from agent.estimation import estimate
from agent.pipeline.planning.plan import make_plan
from agent.recipe import load_recipe
from agent.recording import Log
from agent.robot import load_robot
from agent.validation import predict_log
from drivers.joint_trajectory import GoalProgram
from drivers.transports.ros2.motion import Ros2Motion
from drivers.wire.ros2 import JointSample, RosAddress
from fake_controller.build import build_controller, build_ros2_cell
from fake_controller.controller import PERIOD, Listener
from fake_controller.ros2.trajectory import TrajectoryMessage, TrajectoryPoint
from tests.conftest import ROOT

ROBOT = load_robot("ur5e")
_CHANGES = {
    "population: 50, generations: 40": "population: 16, generations: 4",
    "cycles: 10": "cycles: 5",
    "motions: 30": "motions: 6",
}


class OverTcp(Listener):
    """The arm under a controller that runs programs."""

    driver = "driver: tcp, address: 127.0.0.1:9100"

    def __init__(self):
        self._controller = build_controller("ur5e", 7, "fast")
        self._motions = 0

    def on_samples(self, first, time_ns, samples):
        self._parts.append(samples)

    def run(self, text):
        self._parts, self._motions = [], self._motions + 1
        self._controller.start("p", self._controller.store("p", text.encode()), bytes([self._motions] * 16), self)
        self._controller.go()
        assert self._controller.wait(600.0)
        return tuple(np.concatenate([getattr(one, name) for one in self._parts]) for name in ("position", "torque"))


class OverRos2:
    """The arm under a trajectory controller, and the link to it."""

    driver = "driver: ros2, address: ros2://0/arm, effort: torque"
    target, watchdog, states = RosAddress.of("ros2://0/arm"), 0.5, ()

    def __init__(self):
        self._now = 1_795_900_000.0
        self._cell = build_ros2_cell("ur5e", 7, clock=lambda: self._now)
        self._pass(lambda sample: None)

    def _pass(self, heard):
        self._now += 25 * PERIOD + 1e-7
        cycles = self._cell.run()
        for k, stamp in enumerate(cycles.stamps):
            self.latest = JointSample(stamp, cycles.position[k], cycles.velocity[k], cycles.effort[k])
            heard(self.latest)

    def send(self, ahead, points):
        rows = tuple(TrajectoryPoint.of(t, *row) for t, *row in points)
        message = TrajectoryMessage(ROBOT.joint_names, self._now + ahead, rows)
        assert self._cell.controller.take(message, self._now) == ""
        return message.stamp

    def run(self, text):
        motion = Ros2Motion(
            GoalProgram.of(text), self, PERIOD, False, None, True, 1 << 30, lambda: None, lambda: self._now
        )
        motion.begin()
        reader, blocks = motion.blocks(), []
        while not motion.over:
            self._pass(lambda sample: motion.sample(sample, sample.stamp))
            while motion.size > 10_000:
                blocks.append(next(reader))
        blocks += reader
        return tuple(np.concatenate([getattr(one, name) for one in blocks]) for name in ("position", "torque"))


def log_of(motion, position, torque):
    t, nothing = PERIOD * np.arange(len(position)), None
    whole = ((0, len(t)),)
    return Log(Path(motion), ROBOT.joint_names, t, position, nothing, torque, nothing, nothing, 1 / PERIOD, 0.0, whole)


@pytest.mark.verify
def test_a_model_is_as_good_as_over_tcp(tmp_path, monkeypatch, measured):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "recipes/ros2.yaml").read_text(encoding="utf-8")
    for old, new in _CHANGES.items():
        assert old in text
        text = text.replace(old, new)
    recipes = {}
    for kind in (OverRos2, OverTcp):
        path = tmp_path / f"{kind.__name__}.yaml"
        own = text.replace("driver: ros2, address: ros2://0/joint_trajectory_controller, effort: torque", kind.driver)
        assert kind.driver in own
        path.write_text(own, encoding="utf-8")
        recipes[kind] = load_recipe(path)
    plan = make_plan(recipes[OverRos2], Console(-1))
    logs = {}
    for kind, recipe in recipes.items():
        arm = kind()
        logs[kind] = [
            log_of(f"{kind.__name__}_{k}", *arm.run(replace(motion, recipe=recipe).program))
            for k, motion in enumerate([plan.excitation, *plan.validation])
        ]
    models = {kind: estimate(ROBOT, [found[0]]) for kind, found in logs.items()}

    def errors(model, on):
        """Root mean square [%] of nominal torque: (n,) over all samples, (n,) where an arm moves."""
        found = [predict_log(models[model], log) for log in logs[on][1:]]
        error, moving = (np.concatenate([getattr(one, name) for one in found]) for name in ("error", "moving"))
        rows = (error, error[moving])
        return [100 * np.sqrt(np.mean(row**2, axis=0)) / ROBOT.nominal_torque for row in rows]

    all_over_tcp, over_tcp = errors(OverTcp, OverTcp)
    all_by_ros2, by_ros2 = errors(OverRos2, OverRos2)
    crossed, _ = errors(OverRos2, OverTcp)
    for what, figures in (
        ("over TCP, all samples", all_over_tcp),
        ("over TCP, in motion", over_tcp),
        ("by ROS 2, all samples", all_by_ros2),
        ("by ROS 2, in motion", by_ros2),
        ("model by ROS 2, motions over TCP, all samples", crossed),
    ):
        measured(f"ur5e {what}: error of the joints", ", ".join(f"{one:.3f}" for one in figures), "% of nominal")
    assert np.all(crossed <= 1.1 * all_over_tcp)
