"""Every fault that an arm on ROS 2 can have, through `agent record`: how it ends, and how soon the arm stands."""

import functools
import threading
import time
from collections import deque

import numpy as np
import pytest

from agent.motion import JointTarget, Move, MoveType, create_dialect
from agent.motion.joint_trajectory.settings import PaceSettings
from agent.robot import load_robot
from drivers.transports.ros2.driver import Ros2Driver
from fake_controller.faults import FAULTS, Fault, Faults
from fake_controller.ros2.cell import IMPOSSIBLE
from fake_controller.state import home
from tests.conftest import patience
from tests.faults.conftest import run  # noqa: F401

RECIPE = """
robot: {robot}
controller: {{driver: ros2, address: "{address}", effort: torque}}
motion:
  speed: 0.5 m/s
  fly: {{distance: 5 mm}}
  via_points:
    count: 3
    box:
      centre: [0.6 m, 0 m, 0 m]
      size: [100 mm, 10 mm, 100 mm]
      orientation: [0 deg, 0 deg, 0 deg]
      cone: 10 deg
record: {{rate: 500 Hz, cycles: 2}}
"""
STRIKES = 1.5  # s of motion before the fault
#: Faults that lose nothing: the middleware repeats and orders what it carries, and has its own checksums.
HARMLESS = ("reorder", "duplicate", "corrupt")
#: Samples that do not come; all others show that the arm does something else.
UNSEEN = ("silent", "drop", "delay", "mute", "columns", "clock_back", "reset_counters", "late samples")
#: They are small at first: the arm follows another path, and samples are 0.7 s late after 1.4 s.
GROWS = ("other_motion", "late samples")
#: Commands do not arrive, so the arm goes on to the end of what was sent.
DEAF = ("lost_client", "disobey", "disobedience", "lost_client off the plan")
TOGETHER = {
    "disobedience": ("disobey", "off_path"),
    "lost_client off the plan": ("lost_client", "off_path"),
}
POSSIBLE = [*(name for name in FAULTS if name not in IMPOSSIBLE), *TOGETHER, "late samples"]
QUICK = ("frozen",)


class Watched(Faults):
    """Notes when a fault struck, by the clock of the arm [s]."""

    def __init__(self, faults, clock):
        super().__init__(faults)
        self.struck, self._clock = None, clock

    def strike(self, phase, motion_time=0.0):
        waiting, due = self.waiting, super().strike(phase, motion_time)
        if self.struck is None and self.waiting != waiting:
            self.struck = self._clock()
        return due


class Swing:
    """An arm that swings out and back, and what `agent record` says of it."""

    def __init__(self, bench, faults, folder, command, arm):
        self.bench, robot = bench, load_robot(arm)
        cell = bench.cell
        cell.faults = self.faults = Watched(faults, cell._clock)
        self.speeds, advance = [], cell.run

        def noted():
            cycles = advance()
            if cycles is not None:
                self.speeds.append((cell._clock(), float(np.abs(cell.velocity).max())))
            return cycles

        cell.run = noted
        pace = PaceSettings(velocity=(0.5, 0.5), acceleration=(2.0, 2.0))
        ways = (np.array([0.8, -0.8]), np.zeros(2))
        swing = [Move(MoveType.JOINT, JointTarget(home(robot) + way), pace) for way in ways]
        program, recipe, self.log = folder / "swing.jsonl", folder / "recipe.yaml", folder / "swing.mcap"
        program.write_text(create_dialect("joint_trajectory").write("swing", swing, robot), encoding="utf-8")
        recipe.write_text(RECIPE.format(robot=arm, address=bench.address), encoding="utf-8")
        self.ended = command("record", recipe, "--program", program, "-o", self.log, "--yes")

    def stood(self):
        """Seconds from the fault until the arm stood."""
        until = time.monotonic() + patience(20.0)
        while self.bench.moving() and time.monotonic() < until:
            time.sleep(0.01)
        assert not self.bench.moving()
        moved = [at for at, speed in list(self.speeds) if speed > 0.02]
        return max(0.0, moved[-1] - self.faults.struck)


def publish_late(bench):
    """From a moment of motion on, each sample comes later than the one before: the watchdog more in each second."""
    cell, states, waiting, publish = bench.cell, bench.server._states, deque(), bench.server._states.publish
    over, growth = threading.Event(), patience(0.5)
    begun = []

    def keep(message):
        if not begun and cell.moving and cell._moved > STRIKES:
            cell.faults.struck = cell._clock()
            begun.append(cell.faults.struck)
        if begun:
            waiting.append((cell._clock(), message))
        else:
            publish(message)

    def hand_out():
        while not over.wait(0.002):
            while waiting and cell._clock() - waiting[0][0] > growth * (waiting[0][0] - begun[0]):
                publish(waiting.popleft()[1])

    bench.server._states = type("Late", (), {"publish": staticmethod(keep), "topic": states.topic})()
    threading.Thread(target=hand_out, daemon=True).start()
    bench.undo.callback(over.set)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.verify) for name in POSSIBLE]
)
def test_fault(ros_bench, arm, tmp_path, run, measured, monkeypatch, name):  # noqa: F811
    patient = functools.partialmethod(Ros2Driver.__init__, watchdog=patience(0.5))
    monkeypatch.setattr(Ros2Driver, "__init__", patient)
    bench = ros_bench()
    faults = []
    for one in TOGETHER.get(name, (name,)):
        phase = next((phase for phase in ("streaming", "start") if phase in FAULTS.get(one, ())), "")
        if phase:
            faults.append(
                Fault(one, phase, STRIKES * (phase == "streaming"), 3 * patience(0.5) if one == "delay" else 0.0)
            )
    if name == "late samples":
        publish_late(bench)
    swing = Swing(bench, faults, tmp_path, run, arm)
    errors, code = swing.ended.errors, swing.ended.code
    assert "Traceback" not in errors
    assert swing.faults.struck is not None, errors
    took = swing.stood()
    assert swing.log.exists()
    if name in HARMLESS:
        assert code == 0, errors
        return
    measured(f"ros2: {name}: exit code, stationary after", f"{code}, {took:.2f} s", "", "", True)
    assert code == (4 if name in UNSEEN else 5), errors
    assert took <= patience(2.5 if name in (*DEAF, *GROWS) else 1.3)
