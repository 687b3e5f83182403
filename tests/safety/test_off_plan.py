"""Faults of path, speed and servo in the emulator's arm, and motions without any: who is stopped, and how soon.

The emulator's interpolator, servos, sensors and stop are run without a wire, in the slices that it sends in real time;
the wires have the same faults in tests/faults.
"""

import time
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.excitation import Candidates, LoopProblem
from agent.motion import FlyTrajectory, FlyType, Pdl2Settings, Termination, Trajectory, ViaRegions
from agent.robot import Dynamics, load_robot
from agent.safety.adherence import MEASURED, SET_POINTS, Adherence
from drivers.protocol import SampleBlock
from drivers.wire.reasons import EndReason
from fake_controller.execution import Chain, Execution, StopSwitch
from fake_controller.faults import Fault
from fake_controller.interpolation import build_interpolator
from fake_controller.plant import Plant

ROBOT = load_robot("comau_ns16")
PERIOD = 0.002
SLICE = 10  # samples that the emulator sends at once in real time
KINDS = ("off_path", "servo_error", "off_speed", "other_motion")


@dataclass(frozen=True, eq=False)
class Drawn:
    """A loop as we planned it and as the emulator will run it; `margin` is its FLY distance [m]."""

    planned: Trajectory
    executed: Trajectory
    margin: float


@lru_cache(maxsize=64)
def drawn(seed: int, kind: str = "ours") -> Drawn:
    """A random loop of six via-points that keeps the limits, run by one of the emulator's interpolators."""
    rng = np.random.default_rng(seed)
    regions = ViaRegions.from_box(
        6, np.array([1.0, 0.0, 0.8]), np.array([0.5, 0.6, 0.4]), np.radians([0, 180, 0]), np.radians(30)
    )
    while True:
        settings = Pdl2Settings(
            fly_type=FlyType.FLY_CART,
            fly_trajectory=FlyTrajectory.FLY_TOL,
            fly_distance=float(rng.choice([0.005, 0.02, 0.05])),
            linear_speed=float(rng.uniform(0.2, 1.2)),
        )
        candidates = Candidates(LoopProblem(ROBOT, regions, settings, period=PERIOD))
        try:
            loop = candidates.loop(rng.uniform(size=candidates.problem.genes))
            theirs = build_interpolator(kind, ROBOT, seed, PERIOD).plan(loop.moves, loop.start)
        except InputError:
            continue
        return Drawn(loop.trajectory, theirs, settings.fly_distance)


class Arm:
    """The emulator's arm on its own loop, and its watch."""

    def __init__(self, loop: Drawn, seed: int) -> None:
        self.loop = loop
        plant = Plant(ROBOT, seed)
        plant.rest(loop.planned.q[0])
        self._execution = Execution(plant, Dynamics(ROBOT).tcp_pose, ROBOT.max_acceleration, PERIOD, SLICE)
        self._chains = [Chain(loop.executed, Termination.COARSE, 0.001)]
        self.astray, self.switch = self._execution.astray, StopSwitch()
        self._watch = Adherence([loop.planned], ROBOT, None, loop.margin, PERIOD)
        self.reason: str | None = None
        self.stopped = 0  # the sample that was the last when the stop was asked for
        self.given = self.measured = np.zeros((0, 6))

    def run(self, kind: str = "", after: float = 0.0, joint: int = 0, amount: float = 0.0, seen: bool = True) -> None:
        """One motion with a fault `after` a number of seconds; `seen`: with set-points."""
        given, measured, count = [], [], 0
        if kind == "other_motion":
            self.astray.apply_fault(Fault(kind, "start", value=amount, joint=joint + 1))
        for part in self._execution.run(self._chains, self.loop.planned.q[0], self.switch):
            sequence = np.arange(count, count + len(part))
            count += len(part)
            given.append(part.reference_position)
            measured.append(part.position)
            block = SampleBlock(
                sequence,
                PERIOD * sequence,
                part.position,
                part.velocity,
                part.torque,
                part.reference_position if seen else None,
                None,
            )
            if self.reason is None:
                self.reason = self._watch.take(block)
                if self.reason is not None:
                    self.stopped = count - 1
                    self.switch.request(EndReason.STOPPED, "off the plan")
            if kind and PERIOD * count >= after:
                if kind == "off_speed":
                    self.switch.speed = amount
                elif kind != "other_motion":
                    self.astray.apply_fault(Fault(kind, "streaming", value=amount, joint=joint + 1))
                kind = ""
        self.given, self.measured = np.concatenate(given), np.concatenate(measured)

    def beyond(self) -> tuple[int, np.ndarray]:
        """The first sample that is too far from every point of the path, and (S,) metres beyond the tolerance."""
        path, forward = self._watch._path, Dynamics(ROBOT).tcp_pose
        tools, q, reach = path.tool[::4], path.q[::4], path.reach[::4]
        until = self.stopped + 100 if self.stopped else len(self.given)
        out, metres = [], []
        for positions, allowed in ((self.given[:until], SET_POINTS), (self.measured[:until], MEASURED)):
            away = np.linalg.norm(forward(positions)[:, None, :3, 3] - tools, axis=2) - self.loop.margin - allowed.tool
            joints = np.ones(away.shape, dtype=bool)
            for joint in range(6):
                joints &= np.abs(positions[:, None, joint] - q[:, joint]) <= reach[:, joint] + allowed.joint
            metres.append(away.min(axis=1))
            out.append(np.flatnonzero(~np.any((away <= 0) & joints, axis=1)))
        first = min((int(each[0]) for each in out if len(each)), default=-1)
        return first, np.maximum(*metres)


def draw(rng: np.random.Generator, length: float) -> tuple[str, float, int, float]:
    """Kind, time, joint and amount of a fault, larger than any tolerance and early enough to show."""
    kind, after, joint = str(rng.choice(KINDS)), float(rng.uniform(0.05, 0.5)) * length, int(rng.integers(6))
    least = 0.15 if joint < 3 else 0.6  # the wrist turns far before the tool goes far
    amount = {
        "off_path": rng.uniform(least, 1.0) * rng.choice([-1, 1]),
        "servo_error": rng.uniform(least + 0.1, 1.0) * rng.choice([-1, 1]),
        "off_speed": rng.choice([rng.uniform(0.2, 0.55), rng.uniform(1.5, 3.0)]),
        "other_motion": rng.choice([rng.uniform(-1.0, 0.4), rng.uniform(1.6, 3.0)]),
    }[kind]
    return kind, after, joint, float(amount)


def run_faults(seeds, loops) -> tuple[int, int, list[float], list[float], list[str]]:
    """Stopped, faults, delays [s] and ways [m] past the tolerance of path and servo, and those that were missed."""
    stopped, count, delays, ways, missed = 0, 0, [], [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        arm = Arm(drawn(1000 + seed % loops), seed)
        kind, after, joint, amount = draw(rng, arm.loop.planned.duration)
        arm.run(kind, after, joint, amount)
        first, metres = (-1, np.zeros(0)) if kind == "off_speed" else arm.beyond()
        if kind != "off_speed" and first < 0:
            continue  # the joint hardly moves on this loop, so it makes no other way
        count += 1
        if arm.reason is None:
            missed.append(f"{seed}: {kind} of {amount:.2f} at {after:.2f} s, joint {joint + 1}")
            continue
        stopped += 1
        if kind != "off_speed":
            delays.append(PERIOD * (arm.stopped - first))
            ways.append(float(metres[arm.stopped]))
    return stopped, count, delays, ways, missed


def test_stops_an_arm_that_leaves_the_path():
    stopped, count, delays, ways, missed = run_faults(range(3), 1)
    assert stopped == count >= 2, missed
    assert np.median(delays) <= 0.05
    assert np.median(ways) <= 0.005


def test_stops_a_slow_program_run_1_5_times_too_fast():
    stopped, count, _, _, missed = run_faults([249], 40)
    assert stopped == count == 1, missed


@pytest.mark.parametrize("seen", [True, False])
def test_does_not_stop_an_arm_that_follows_the_plan(seen):
    arm = Arm(drawn(1000), 3)
    arm.run(seen=seen)
    assert arm.reason is None


@pytest.mark.parametrize("seed", [3, 8, 14, 36, 143])
def test_tolerates_another_blend_and_time_law(seed):
    arm = Arm(drawn(seed, "second"), seed)
    arm.run()
    assert arm.reason is None


@pytest.mark.verify
def test_stops_a_thousand_random_faults(measured):
    stopped, count, delays, ways, missed = run_faults(range(1000), 40)
    delay, way = 1000 * float(np.median(delays)), 1000 * float(np.median(ways))
    measured(
        "off the plan: faults of path, speed and servo that were stopped",
        f"{stopped} of {count}",
        "",
        "all",
        not missed,
    )
    measured("off the plan: median from the tolerance to the stop", delay, "ms", "at most 50 ms", delay <= 50)
    measured("off the plan: median way past the tolerance", way, "mm", "at most 5 mm", way <= 5)
    assert not missed
    assert delay <= 50
    assert way <= 5


@pytest.mark.verify
def test_cpu_time_of_the_watch(measured):
    spent, seconds = 0.0, 0.0
    for seed in range(5):
        loop = drawn(1000 + seed)
        q, nothing = loop.executed.q, np.zeros_like(loop.executed.q)
        watch = Adherence([loop.planned], ROBOT, None, loop.margin, PERIOD)
        began = time.process_time()
        for first in range(0, len(q), SLICE):
            part = slice(first, first + SLICE)
            sequence = np.arange(len(q))[part]
            block = SampleBlock(sequence, PERIOD * sequence, q[part], None, nothing[part], q[part], None)
            assert watch.take(block) is None
        spent += time.process_time() - began
        seconds += PERIOD * len(q)
    share = 100 * spent / seconds
    measured("the watch over six joints at 500 Hz", share, "% of a core", "below 5 %", share < 5)
    assert share < 5


@pytest.mark.verify
def test_stops_none_of_two_hundred_healthy_motions(measured):
    stopped = []
    for seed in range(200):
        arm = Arm(drawn(1000 + seed), seed)
        arm.run(seen=seed % 4 != 0)
        if arm.reason is not None:
            stopped.append(f"{seed}: {arm.reason}")
    measured("off the plan: healthy motions that were stopped", len(stopped), "of 200", "none", not stopped)
    assert not stopped
