"""Whether an arm that was told to stop does so is what its samples say, not what its controller answers."""

import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core.errors import SafetyError
from agent.robot import load_robot
from agent.safety.freshness import Freshness
from agent.safety.stopping import (
    CLOSE_LINK_AFTER,
    MAX_SAMPLE_AGE,
    MISSING_END_AFTER,
    RESEND_AFTER,
    SPEED_WINDOW,
    STANDSTILL_DEADLINE,
    STATIONARY_SHARE,
    Braking,
    Stopping,
)
from drivers.errors import DriverError
from drivers.protocol import SampleBlock, Status
from drivers.transports.tcp.driver import TcpDriver
from tests.conftest import patience
from tests.safety.following import HOME, Clock, at

ROBOT = load_robot("comau_ns16")
PERIOD = 0.002


class Arm:
    """A driver whose arm goes at `speed` [part of a limit] and brakes within `brakes` [s] of the first stop, or never.

    `answers`: whether a stop is confirmed; `state`: what its state says of its position, None where it says nothing.
    """

    watchdog = 0.5
    gaps = ()

    def __init__(self, brakes: float | None, speed: float = 0.5, answers: bool = True) -> None:
        self.clock, self.warned = Clock(), []
        self.stops, self.closed = 0, threading.Event()
        self.brakes, self.speed, self.answers = brakes, speed, answers
        self.corner = None  # s between two corners of its path
        self._ways: deque[np.ndarray] = deque()  # positions that are seen later than their stamps say
        self.state = lambda: None
        self._asked = threading.Event()
        self._position, self._stopped_at, self._sequence = 0.0, None, 0
        self._time = 3.0
        self.freshness = Freshness(PERIOD, self.watchdog, self.clock)
        self.stopping = Stopping(self, ROBOT, "here", self.freshness, self.clock, self.warned.append)

    def stop(self) -> None:
        self.stops += 1
        self._asked.set()
        if not self.answers:
            raise DriverError("no answer")

    def status(self) -> Status:
        position = self.state()
        if position is None:
            raise DriverError("no state")
        return Status(True, "auto", False, (), 1.0, True, False, "p", "", position)

    def close(self) -> None:
        self.closed.set()

    def request(self) -> None:
        self.stopping.request()
        assert self._asked.wait(10.0)
        self._stopped_at = self._time

    def turns(self, count: int, seen: bool = False) -> None:
        """So many turns of the watch, each of which waits for what the state says."""
        for _ in range(count):
            self.run(0.02, seen)
            self.stopping._look.exception()

    def delay(self, seconds: float) -> None:
        """Its positions stand still for this time [s], and are late by it from then on."""
        self._ways.extend([np.full(10, self._position)] * round(seconds / 0.02))

    def run(self, seconds: float, seen: bool = True) -> None:
        """Let time pass, with a block of samples each 20 ms where they are `seen`, and turns of the watch."""
        for _ in range(round(seconds / 0.02)):
            times = self._time + PERIOD * np.arange(1, 11)
            part = np.zeros(10)
            if self.brakes is not None and self._stopped_at is not None:
                part = np.clip((times - self._stopped_at) / self.brakes, 0.0, 1.0)
            if self.corner is not None and self._stopped_at is not None:
                part = 0.4 - 0.4 * np.cos(2 * np.pi * (times - self._stopped_at) / self.corner)
            way = self._position + np.cumsum(PERIOD * self.speed * (1 - part))
            self._time, self._position = float(times[-1]), float(way[-1])
            self.clock.now += 0.02
            self._ways.append(way)
            if seen:
                positions = np.outer(self._ways.popleft(), np.eye(6)[1] * ROBOT.max_velocity[1])
                nothing = np.zeros_like(positions)
                numbers = self._sequence + np.arange(10)
                self.stopping.take(SampleBlock(numbers, times, positions, None, nothing, None, None))
                self.freshness.judged(self._time)
            self._sequence += 10
            self.stopping.poll()


def stopped(brakes: float | None = None, **options) -> Arm:
    """An arm that has moved for 0.3 s and is told to stop."""
    arm = Arm(brakes, **options)
    arm.run(0.3)
    arm.request()
    return arm


def test_a_braking_arm_gets_one_stop_and_keeps_its_link():
    arm = stopped(brakes=0.6)
    arm.run(1.5)
    arm.stopping.finish(failed=False)
    arm.clock.now += STANDSTILL_DEADLINE
    arm.stopping.poll()
    assert (arm.stops, arm.stopping.failure, arm.warned) == (1, "", [])
    assert not arm.closed.is_set()


def test_waits_for_a_stop_in_progress_and_cleans_up():
    """Or it would be taken for one that failed, once the link is closed."""
    before = set(threading.enumerate())
    arm = Arm(brakes=0.2)
    goes_on, stop, done = threading.Event(), arm.stop, []

    def slowly() -> None:
        stop()
        assert goes_on.wait(10.0)
        done.append(None)

    arm.stop = slowly
    arm.run(0.3)
    arm.request()
    arm.run(0.4)
    threading.Timer(0.1, goes_on.set).start()
    arm.stopping.finish(failed=False)
    assert done
    for thread in set(threading.enumerate()) - before:
        thread.join(10.0)
        assert not thread.is_alive()


@pytest.mark.parametrize("reacts", [0.0, 0.1])
def test_a_slowly_braking_arm_gets_more_time(reacts):
    """Reaction, 1.2 s from full speed, and 0.2 s on the way here: the slowest that counts as obedient."""
    arm = stopped(brakes=1.2, speed=1.0)
    arm._stopped_at += 0.2 + reacts
    arm.run(2.0)
    assert (arm.stopping.failure, arm.warned) == ("", [])


def test_a_stall_of_this_process_is_not_counted_against_the_arm():
    """But no more of it than half a second."""
    arm = stopped()
    arm.clock.now += 0.4
    arm.stopping.poll(stalled=0.4)
    arm.run(RESEND_AFTER - 0.06)
    assert arm.stops == 1
    arm.clock.now += CLOSE_LINK_AFTER
    arm.stopping.poll(stalled=CLOSE_LINK_AFTER)
    arm.run(0.1)
    assert arm.closed.wait(10.0)
    assert arm.stops == 2


@pytest.mark.parametrize("brakes", [None, 20.0])
def test_an_arm_that_does_not_brake_gets_a_second_stop_then_loses_the_link(brakes):
    arm = stopped(brakes)
    arm.run(RESEND_AFTER - 0.06)
    assert arm.stops == 1
    arm.run(0.1)
    assert not arm.closed.is_set()
    arm.run(CLOSE_LINK_AFTER - RESEND_AFTER)
    assert arm.closed.wait(10.0)
    assert arm.stops == 2
    assert arm.stopping.disobeyed
    assert "PRESS THE EMERGENCY STOP NOW" in arm.warned[0]
    arm.run(1.0)
    assert (arm.stops, len(arm.warned)) == (2, 1), "said once"
    arm.state = lambda: pytest.fail("nobody answers at a closed link")
    arm.stopping.finish(failed=False)
    assert arm.stopping._look.exception() is None


def test_slowing_for_a_corner_is_not_braking():
    arm = stopped()
    arm.corner = 1.2
    arm.run(0.72)
    assert (arm.stops, arm.closed.is_set()) == (1, False), "it slows down until then"
    arm.run(0.24)
    assert arm.closed.wait(10.0)
    assert (arm.stops, arm.stopping.disobeyed) == (2, True)


@pytest.mark.parametrize(("brakes", "late"), [(0.3, 0.3), (0.3, 0.4), (0.6, 0.3)])
def test_an_arm_that_slows_down_late_is_said_to_be_seen_late_perhaps(brakes, late):
    """As its positions stood still for a moment, it seemed to rest when it was told to stop."""
    arm = Arm(brakes)
    arm.run(1.0)
    arm.delay(late)
    arm.run(late)
    assert arm.stopping._from_samples.speed == pytest.approx(0.0, abs=1e-9)
    arm.request()
    arm.run(CLOSE_LINK_AFTER + 0.1)
    assert arm.closed.wait(10.0), "whatever it is, it is stopped by every means"
    assert (arm.stops, arm.stopping.disobeyed) == (2, True)
    assert "It slows down, so what is seen of it may be late" in arm.warned[0]
    assert "PRESS THE EMERGENCY STOP NOW" in arm.warned[0], "an arm that runs its program slows down, too"


def test_an_arm_that_is_seen_late_and_goes_on_is_said_to_disobey():
    arm = Arm(None)
    arm.run(1.0)
    arm.delay(0.3)
    arm.run(0.3)
    arm.request()
    arm.run(CLOSE_LINK_AFTER + 0.1)
    assert arm.stopping.disobeyed


def test_closes_the_link_of_an_arm_that_never_comes_to_rest():
    arm = stopped(brakes=2 * STANDSTILL_DEADLINE)
    for _ in range(10):
        arm.run(STANDSTILL_DEADLINE / 10)
    assert arm.closed.wait(10.0)
    assert arm.stopping.disobeyed


def test_closes_the_link_if_the_end_is_never_reported():
    arm = stopped(brakes=0.3)
    arm.run(MISSING_END_AFTER)
    assert not arm.closed.is_set()
    arm.run(0.5)
    assert arm.closed.wait(10.0)
    assert "does not report the end" in arm.stopping.failure
    assert (arm.stopping.disobeyed, arm.warned) == (False, [])


def test_a_refused_stop_closes_the_link():
    arm = stopped(brakes=None, answers=False)
    assert arm.closed.wait(10.0)
    assert "not confirmed (no answer)" in arm.warned[0]
    assert not arm.stopping.disobeyed


@pytest.mark.parametrize(("moves", "said"), [(True, "still moves"), (False, ""), (None, "nothing shows")])
def test_without_samples_braking_is_judged_by_the_state(moves, said):
    arm = Arm(brakes=None if moves else 0.2)
    if moves is not None:
        arm.state = lambda: HOME + (2.0 * arm.clock.now if moves else 0.0)
    arm.run(0.3)
    arm.request()
    arm.turns(60)
    assert said in arm.stopping.failure
    assert arm.stopping.disobeyed is (moves is True)
    assert arm.closed.wait(10.0) if said else not arm.closed.is_set()


def test_a_slowly_updated_state_still_shows_braking():
    arm = stopped()
    began = arm.clock.now

    def state():
        passed = np.floor((arm.clock.now - began) / 0.12) * 0.12
        return HOME + 0.5 * (min(passed, 1.2) - min(passed, 1.2) ** 2 / 2.4) * np.eye(6)[1] * ROBOT.max_velocity[1]

    arm.state = state
    arm.turns(75)
    assert (arm.stopping.failure, arm.warned) == ("", [])


@pytest.mark.parametrize("silent", [True, False])
def test_late_samples_do_not_hide_the_state(silent):
    """On a link that lags they still show the motion when the arm stands."""
    arm = Arm(brakes=None)
    arm.run(0.3)
    arm.clock.now += 0.8
    arm.state = lambda: HOME
    arm.request()
    arm.turns(150, seen=True)
    assert (arm.stopping.failure, arm.warned, arm.stops) == ("", [], 1), "and they belong into the log"
    assert not arm.closed.is_set()
    if silent:
        arm.turns(50)
    else:  # who knows when the clock is no number
        arm.state, arm.clock.now = lambda: None, np.nan
        arm.stopping.poll()
    assert "does not report the end" in arm.stopping.failure


@pytest.mark.parametrize("answers", [True, False], ids=["state as late", "no state"])
def test_an_arm_seen_late_is_not_accused(answers):
    """A lag that grows 10 % a second to 0.7 s: the arm obeys at once, and what comes shows it in motion still."""
    arm = Arm(brakes=0.16)
    seen = [arm._time]

    def late(block: SampleBlock) -> None:
        position = HOME + block.position[-1]
        arm.state = (lambda: position) if answers else (lambda: None)
        seen.append(float(block.time[-1]))

    take, arm.stopping.take = arm.stopping.take, lambda block: (take(block), late(block))
    arm.run(0.3)
    arm.clock.now += 0.7  # what has come since is as old as that
    arm.request()
    arm._stopped_at += 0.7
    arm.turns(40, seen=True)
    assert arm.closed.is_set()
    assert not arm.stopping.disobeyed
    (said,) = arm.warned
    assert "obey" not in said
    assert "EMERGENCY" not in said
    assert "nothing shows what the arm does: the newest sample is 0.7 s old" in said


@pytest.mark.parametrize("took", [0.0, MAX_SAMPLE_AGE + 0.05])
def test_a_state_is_as_old_as_its_question(took):
    """Without samples the state alone shows the arm; one that was long on its way accuses nobody."""
    arm = Arm(brakes=None)
    arm.run(0.3)
    arm.run(2 * MAX_SAMPLE_AGE, seen=False)

    def state():
        position = HOME + 2.0 * arm.clock.now
        arm.clock.now += took
        return position

    arm.state = state
    arm.request()
    arm.turns(60)
    assert arm.stopping.disobeyed is (took == 0.0)


def test_an_outdated_state_is_not_evidence_of_braking():
    arm = Arm(brakes=None)
    arm.run(0.3)
    arm.run(2 * MAX_SAMPLE_AGE, seen=False)
    arm.request()
    until = arm.clock.now + CLOSE_LINK_AFTER - MAX_SAMPLE_AGE - 0.04
    arm.state = lambda: HOME + 2.0 * arm.clock.now if arm.clock.now < until else None
    arm.turns(60)
    assert "nothing shows" in arm.stopping.failure
    assert not arm.stopping.disobeyed


@pytest.mark.parametrize("answers", [True, False])
def test_a_nan_clock_gives_no_extra_time(answers):
    arm = stopped()
    arm.state = lambda: HOME + 2.0 * arm.clock.now if answers or arm.clock.now > 0 else None
    arm.turns(10 if answers else 24)  # or until its state has shown a speed
    arm.clock.now = np.nan
    arm.stopping.poll()
    arm.stopping.poll()
    assert arm.closed.wait(10.0)
    arm.stopping.wait(10.0)
    assert arm.stops == 2
    assert "nothing shows" in arm.stopping.failure


def test_reports_a_stop_failure_after_the_link_closed_once():
    arm = Arm(brakes=None)
    told = arm.stop

    def stop() -> None:
        told()
        assert arm.closed.wait(10.0)
        raise DriverError("closed by this end")

    arm.stop = stop
    arm.run(0.3)
    arm.request()
    arm.run(1.0)
    arm.stopping.wait(10.0)
    assert len(arm.warned) == 1
    assert "PRESS THE EMERGENCY STOP" in arm.warned[0]


def test_a_first_stop_that_fails_leaves_the_link_to_the_second():
    arm, second = Arm(brakes=None), threading.Event()

    def stop() -> None:
        arm.stops += 1
        arm._asked.set()
        if arm.stops == 2:
            second.set()
            return
        assert second.wait(10.0)
        raise DriverError("no answer")

    arm.stop = stop
    arm.run(0.3)
    arm.request()
    arm.run(RESEND_AFTER + 0.06)
    arm.stopping._sent[0].join(10.0)
    assert (arm.stops, arm.warned, arm.closed.is_set()) == (2, [], False)


def test_ignores_a_stop_failure_after_the_arm_came_to_rest(monkeypatch):
    monkeypatch.setattr("agent.safety.stopping.STOP_ANSWER_TIMEOUT", 0.01)
    arm, goes_on = Arm(brakes=0.2), threading.Event()
    told = arm.stop

    def stop() -> None:
        told()
        assert goes_on.wait(10.0)
        raise DriverError("closed by this end")

    arm.stop = stop
    arm.run(0.3)
    arm.request()
    arm.run(0.4)
    arm.stopping.finish(failed=False)
    goes_on.set()
    arm.stopping.wait(10.0)
    assert (arm.warned, arm.closed.is_set()) == ([], False)


def test_reports_a_link_closed_while_waiting_for_the_end_once():
    arm = stopped()
    arm.clock.now += 1.0

    def state():
        arm.clock.now += SPEED_WINDOW / 2
        arm.stopping.poll()
        return HOME + arm.clock.now

    arm.state = state
    arm.stopping.finish(failed=False)
    assert arm.closed.wait(10.0)
    assert len(arm.warned) == 1


def test_does_not_query_a_failed_link():
    arm, looks = Arm(brakes=None), []
    arm.run(0.3)
    arm.request()
    arm.clock.now += 1.0
    arm.state = lambda: looks.append(None)
    arm.stopping.finish(failed=True)
    assert (looks, arm.stopping.failure, arm.stopping.over) == ([], "", True)


def test_rest_before_a_silence_is_not_rest_at_the_end():
    arm = stopped(brakes=None, speed=0.0)
    arm.clock.now += 1.0

    def state():
        arm.clock.now += SPEED_WINDOW
        return HOME + arm.clock.now

    arm.state = state
    arm.stopping.finish(failed=False)
    assert arm.stopping.disobeyed


@pytest.mark.parametrize("state", [HOME[:5], np.full(6, np.nan)])
def test_a_state_without_a_position_is_not_evidence_of_rest(state):
    arm = stopped()
    arm.state = lambda: state
    arm.turns(60)
    assert "nothing shows" in arm.stopping.failure


def test_samples_before_the_stop_are_ignored():
    """A link that lags shows what the arm did then."""
    arm = stopped()
    arm.clock.now += 2.0
    arm.run(0.1)
    assert "nothing shows" in arm.stopping.failure
    assert not arm.stopping.disobeyed


@pytest.mark.parametrize("moves", [True, False])
def test_a_reported_end_needs_an_observed_standstill(moves):
    arm = stopped()
    began = arm.clock.now

    looks = []

    def state():
        arm.clock.now += SPEED_WINDOW / 2
        looks.append(None)
        return HOME + (arm.clock.now - began if moves else 0.0)

    arm.state = state
    arm.stopping.finish(failed=False)
    assert moves or len(looks) < 5, "it was seen to stand"
    assert arm.stopping.disobeyed is moves
    assert arm.closed.wait(10.0) if moves else not arm.closed.is_set()
    assert ("after the controller reported the end" in arm.stopping.failure) is moves


@given(st.floats(0.02, 1.0), st.integers(1, 40))
def test_speed_is_the_highest_joint_speed(speed, chunk):
    braking = Braking(ROBOT.max_velocity)
    times = PERIOD * np.arange(200)
    way = np.outer(times, ROBOT.max_velocity * np.linspace(0.2, 1.0, 6) * speed)
    for first in range(0, 200, chunk):
        braking.take(times[first : first + chunk], way[first : first + chunk])
    assert braking.speed == pytest.approx(speed, rel=1e-6)
    assert braking.is_stationary is (speed <= STATIONARY_SHARE)


@pytest.mark.parametrize("times", [[1.0, np.nan], [1.0, 0.5]])
def test_non_finite_times_are_not_evidence_of_rest(times):
    braking = Braking(ROBOT.max_velocity)
    for when in times:
        braking.take(np.array([when]), HOME[None])
    assert (braking.is_stationary, braking.speed) == (False, None)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, None])
def test_keeps_samples_of_the_stop_and_reports_an_ignored_stop(bench, program, error, monkeypatch):
    """Whoever ends the motion: the log gets what came after the stop, and the exit code tells what was seen."""
    monkeypatch.setattr(
        "agent.safety.stopping.MAX_SAMPLE_AGE", patience(10 * MAX_SAMPLE_AGE)
    )  # a collection of garbage takes as long
    chosen = program()
    (chain,) = chosen.chains

    class Deaf(TcpDriver):
        def stop(self):
            bench.controller.stops += 1

        def status(self):
            told = super().status()
            moves = bench.controller.stops > 0
            return replace(told, position=HOME + 0.1 * (time.monotonic() % 1e3)) if moves else told

    bench.driver = Deaf
    slow = replace(chosen, chains=(replace(chain, t=20 * chain.t, qd=chain.qd / 20),))
    bench.controller = replace(bench.controller, blocks=10**6)
    bench.controller.moves = lambda times: at(chain, (times / 2) % 1.0)
    guard, kept = bench.open(), []
    guard.send(slow)

    def ended() -> None:
        try:
            with guard.motion(slow, kept.append) as samples:
                next(samples)
                if error is not None:
                    raise error("ended")
                kept.extend(samples)
        except KeyboardInterrupt:  # would end the whole session of tests
            pytest.fail("the interruption came out, and not what was seen of the arm")

    with pytest.raises(SafetyError, match="does not obey" if error else "was stopped: .*does not obey"):
        ended()
    assert kept
    assert bench.controller.stops >= 2
    assert bench.controller.starts == 1
    with pytest.raises(DriverError, match="connect first"):
        guard.position()


def test_a_clock_change_restarts_the_speed_estimate():
    """Or the way between two clocks would be a speed."""
    braking = Braking(ROBOT.max_velocity)
    braking.take(10.0 + PERIOD * np.arange(100), np.tile(HOME, (100, 1)))
    assert braking.is_stationary
    braking.take(500.0 + PERIOD * np.arange(10), np.tile(HOME + 1.0, (10, 1)))
    assert (braking.is_stationary, braking.speed, braking.stationary_time) == (False, None, 0.0)


def test_non_finite_positions_show_neither_braking_nor_rest():
    braking = Braking(ROBOT.max_velocity)
    braking.before = 0.5
    braking.take(PERIOD * np.arange(100), np.full((100, 6), np.nan))
    assert not braking.is_braking
    assert not braking.is_stationary


def test_an_arm_of_unknown_earlier_speed_is_not_braking():
    braking = Braking(ROBOT.max_velocity)
    way = np.outer(PERIOD * np.arange(100), ROBOT.max_velocity)
    braking.take(PERIOD * np.arange(100), way)
    assert not braking.is_braking
    braking.take(PERIOD * np.arange(100, 200), np.repeat(way[-1:], 100, axis=0))
    assert braking.is_stationary
