"""How the fake controller carries out a program: chains, plans, stops on the path, time."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.motion import Delay, JointTarget, Move, MoveType, Trajectory
from fake_controller.clock import FastClock, RealClock
from fake_controller.execution import Planner, retimed

PERIOD = 0.002
LIMITS = np.array([4.0, 8.0])


def sine(seconds: float, phase: float) -> tuple[np.ndarray, np.ndarray]:
    t = PERIOD * np.arange(int(seconds / PERIOD))[:, None] + phase
    frequency = np.array([2.0, 3.0])
    return 0.2 * np.sin(frequency * t), 0.2 * frequency * np.cos(frequency * t)


@given(st.floats(0, 3), st.floats(0.3, 5))
@settings(max_examples=50, deadline=None)
def test_a_stop_stays_on_the_path_and_ends_stationary(phase, seconds):
    position, velocity = sine(seconds, phase)
    ramp = np.linspace(1, 0, len(position))[:, None]  # a trajectory ends at standstill
    velocity = velocity * ramp
    position = position[0] + PERIOD * np.cumsum(velocity, axis=0)
    q, qd = (part[1:] for part in retimed(position, velocity, 0.0, LIMITS, PERIOD))
    np.testing.assert_allclose(qd[-1], 0, atol=1e-9)
    # Set-points go on from the last one without a step, and velocity is the derivative of position.
    joined = np.vstack([position[:1], q])
    np.testing.assert_allclose(np.diff(joined, axis=0)[0], velocity[0] * PERIOD, atol=2e-4)
    np.testing.assert_allclose(np.gradient(joined, PERIOD, axis=0)[1:-1], qd[:-1], atol=0.02)
    # Every point of it is a point of the path.
    away = np.abs(q[:, None, :] - position[None]).max(axis=2).min(axis=1)
    assert away.max() <= np.abs(velocity).max() * PERIOD
    assert np.all(np.abs(np.diff(qd, axis=0)).max(axis=0) / PERIOD <= 1.02 * LIMITS)


def test_a_stop_near_the_end_ends_at_the_end():
    position = np.linspace(0, 1, 6)[:, None] * [1e-3, 2e-3]
    q, qd = retimed(position, np.gradient(position, PERIOD, axis=0), 0.0, LIMITS, PERIOD)
    np.testing.assert_array_equal(q[-1], position[-1])
    np.testing.assert_array_equal(qd[-1], 0)


@given(begin=st.integers(0, 990), ratio=st.sampled_from([0.1, 0.5, 0.9, 2.0]))
@settings(max_examples=50, deadline=None)
def test_an_override_change_keeps_path_and_limits(begin, ratio):
    """Whenever it comes: at the beginning the arm still gains speed, at the end it has little way left."""
    t = np.linspace(0, np.pi, 1000)[:, None]
    limits = np.array([4.0, 8.0])
    velocity = limits * 999 * PERIOD / np.pi * np.sin(t)  # asks for all of the acceleration, first and last
    position = PERIOD * np.cumsum(velocity, axis=0)
    q, qd = retimed(position[begin:], velocity[begin:], ratio, limits, PERIOD)
    np.testing.assert_array_equal(q[0], position[begin])
    np.testing.assert_allclose(q[-1], position[-1], atol=1e-9)
    np.testing.assert_allclose(qd[-1], 0, atol=1e-9)
    np.testing.assert_allclose(q[:, 1], 2 * q[:, 0], atol=1e-6)
    assert np.all(np.abs(np.diff(qd, axis=0)).max(axis=0) / PERIOD <= 1.02 * max(1.0, ratio) ** 2 * limits)
    middle = len(q) // 2
    if begin < 100 and ratio != 0.9:
        planned = np.interp(q[middle, 0], position[:, 0], velocity[:, 0])
        assert qd[middle, 0] == pytest.approx(ratio * planned, rel=0.02)


class Recorder:
    """An interpolator that notes what it is asked: jumps to the last target."""

    def __init__(self):
        self.planned = []

    def plan(self, statements, start):
        self.planned.append(len(statements))
        q = np.vstack([start, statements[-1].target.position])
        rest = np.zeros_like(q)
        none = np.zeros(2)
        return Trajectory(none, q, rest, rest, np.zeros((2, 4, 4)), none, none)


def move(a: float, fly: bool = False) -> Move:
    return Move(MoveType.JOINT, JointTarget(np.array([a, -a])), fly=fly)


def test_a_fly_chain_ends_at_a_stop():
    recorder = Recorder()
    statements = [move(1), move(2, fly=True), move(3, fly=True), move(4), Delay(0.5), move(5, fly=True)]
    chains = list(Planner(recorder).chains(statements, np.zeros(2)))
    assert recorder.planned == [1, 3, 1]
    assert [chain.hold for chain in chains] == [0, 0, 0.5, 0]
    np.testing.assert_array_equal(chains[1].trajectory.q[0], [1, -1])
    np.testing.assert_array_equal(chains[3].trajectory.q[0], [4, -4])


def test_a_delay_ends_a_fly_chain():
    recorder = Recorder()
    list(Planner(recorder).chains([move(1, fly=True), Delay(0.1), move(2)], np.zeros(2)))
    assert recorder.planned == [1, 1]


def test_plans_a_repeated_cycle_once():
    recorder = Recorder()

    def cycles():
        for _ in range(100):
            yield from (move(1, fly=True), move(2, fly=True), move(0))

    chains = Planner(recorder).chains(cycles(), np.zeros(2))
    assert sum(1 for _ in chains) == 100
    assert recorder.planned == [3]


def test_caches_a_limited_number_of_plans():
    recorder = Recorder()
    planner = Planner(recorder, remembered=3)
    list(planner.chains((move(k) for k in range(50)), np.zeros(2)))
    assert len(planner._plans) == 3


def test_a_fast_clock_takes_no_time_and_never_goes_back():
    clock = FastClock()
    clock.wait_until(3_600_000_000_000)
    clock.wait_until(5)
    assert clock.now() == 3_600_000_000_000


def test_a_real_clock_waits():
    clock = RealClock()
    moment = clock.now() + 5_000_000
    clock.wait_until(moment)
    assert clock.now() >= moment
