"""A motion has an end: how long it may last, and how long it may be silent or late."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core.errors import ControllerError, SafetyError
from agent.motion.program import Delay
from agent.robot import load_robot
from agent.safety.freshness import DRIFT, FIRST_SAMPLE_DELAY, PROCESS_STALL, Freshness
from agent.safety.planned_program import SETTLING, pauses
from agent.safety.preconditions import check_throughput
from agent.safety.watch import POLL_INTERVAL, MotionWatch
from drivers.protocol import Identity
from drivers.transports.tcp.driver import TcpDriver
from tests.safety.following import PERIOD, Clock

WATCHDOG = 0.5


def test_a_motion_that_does_not_end_is_stopped(bench, program):
    chosen = program()
    (chain,) = chosen.chains
    bench.controller = replace(
        bench.controller, blocks=10**6, moves=lambda times: np.tile(chain.q[-1], (len(times), 1))
    )
    with pytest.raises(SafetyError, match=r"has lasted 1\d s, its plan takes 14 s at most"):
        bench.run(chosen)
    assert bench.controller.stops >= 1


def test_the_time_limit_includes_pauses_and_stops(program):
    chosen = program()
    statements = [Delay(2.0), Delay(3.5)]
    assert pauses(statements) == 5.5
    assert replace(chosen, pauses=5.5).longest == pytest.approx(chosen.longest + 5.5)
    assert replace(chosen, chains=chosen.chains * 2).longest > chosen.longest + SETTLING + chosen.duration


def fresh(watchdog: float = WATCHDOG) -> tuple[Freshness, Clock]:
    clock = Clock()
    freshness = Freshness(PERIOD, watchdog, clock)
    freshness.begin()
    return freshness, clock


def watched(delays, rate=1.0, every=0.02):
    """When a motion is stopped [s] whose samples come with these delays [s], one block each; None if it is not."""
    freshness, clock = fresh()
    for k, delay in enumerate(delays):
        clock.now = 100.0 + every * k + delay
        if freshness.fault() is not None:
            return every * k
        freshness.judged(7.0 + rate * every * k)
    return None


@given(st.floats(0.0, 5.0), st.lists(st.floats(0.0, 0.4), min_size=1, max_size=200))
def test_tolerates_a_nearly_constant_delay(always, changes):
    assert watched([always / 10 + change for change in changes]) is None


@given(st.floats(0.01, 5.0))
def test_a_growing_delay_stops_the_arm(growth):
    """At 1 % a second too slow as well."""
    limit = WATCHDOG + PROCESS_STALL
    stopped = watched([growth * 0.02 * k for k in range(int(50 * 2 * limit / growth) + 50)])
    assert stopped is not None
    assert 0.9 * limit < growth * stopped < 1.1 * limit + 0.05 * growth


def test_tolerates_an_hour_of_clock_drift_and_a_faster_clock():
    """As an emulator's may be."""
    assert watched([DRIFT * 0.9 * 0.5 * k for k in range(7200)], every=0.5) is None
    assert watched([0.0] * 500, rate=10.0) is None


def test_delayed_first_samples_do_not_hide_a_later_delay():
    held = [FIRST_SAMPLE_DELAY, FIRST_SAMPLE_DELAY / 2] + [0.0] * 50
    late = [0.02 * k for k in range(100)]
    stopped = watched(held + late)
    assert stopped == pytest.approx(0.02 * len(held) + WATCHDOG + PROCESS_STALL, abs=0.03)


@pytest.mark.parametrize("samples", [0, 1])
def test_tolerates_silence_up_to_the_watchdog_time(samples):
    freshness, clock = fresh(watchdog=2.0)
    for _ in range(samples):
        freshness.judged(7.0)
        clock.now += 0.02
        freshness.judged(1000.0)  # a controller whose time runs faster is never late, but may fall silent
    clock.now += 2.0
    assert freshness.fault() is None
    clock.now += PROCESS_STALL - 0.01 + (FIRST_SAMPLE_DELAY if samples == 0 else 0.0)
    assert freshness.fault() is None
    clock.now += 0.02
    assert "no sample came" in freshness.fault()
    assert freshness.fault(excused=3.0) is None, "nobody could look for so long"


@pytest.mark.parametrize(("stall", "stopped_after"), [(0.6, 0.25), (3.0, 0.0)])
def test_a_stall_of_this_process_leaves_time_to_judge_the_backlog(stall, stopped_after):
    """But no more of it than half a second, or a computer that stalls all the time would watch nothing."""
    clock, stopped = Clock(), threading.Event()
    driver = SimpleNamespace(watchdog=WATCHDOG, stop=stopped.set)
    watch = MotionWatch(driver, load_robot("comau_ns16"), "here", PERIOD, None, 100.0, clock, print)

    def turns(seconds):
        for _ in range(round(seconds / POLL_INTERVAL)):
            clock.now += POLL_INTERVAL
            watch.poll()

    turns(0.3)
    clock.now += stall + 2 * POLL_INTERVAL
    watch.poll()
    turns(stopped_after - POLL_INTERVAL)
    assert (watch.stopping.since is None) is (stopped_after > 0)
    turns(3 * POLL_INTERVAL)
    assert stopped.wait(10.0)


def test_a_nan_clock_is_a_fault():
    for samples in (0, 1):
        freshness, clock = fresh()
        for _ in range(samples):
            freshness.judged(7.0)
        clock.now = np.nan
        assert freshness.fault() is not None


class Mute(TcpDriver):
    """The real driver; of its samples `shown` blocks come through."""

    shown = 1

    def samples(self):
        for number, block in enumerate(super().samples()):
            if number < self.shown:
                yield block


@pytest.mark.parametrize("shown", [0, 1])
def test_stops_a_controller_that_sends_heartbeats_but_no_samples(bench, program, shown):
    bench.driver = type("Told", (Mute,), {"shown": shown})
    bench.controller = replace(bench.controller, blocks=10**6)
    ticks = iter(range(10**6))
    with pytest.raises(ControllerError, match="no sample came"):
        bench.run(program(), bench.open(clock=lambda: 0.01 * next(ticks)))
    assert bench.controller.stops >= 1


def test_a_slow_consumer_stops_the_arm(bench, program):
    """A disk or a terminal that takes nothing: nobody judges samples meanwhile."""
    bench.controller.blocks = 10**6
    stopped = threading.Event()

    class Told(TcpDriver):
        def stop(self):
            super().stop()
            stopped.set()

    bench.driver = Told
    clock = Clock()
    guard, chosen = bench.open(clock=clock), program()
    guard.send(chosen)

    def take_slowly() -> None:
        with guard.motion(chosen) as samples:
            for _ in samples:
                if not stopped.is_set():
                    clock.now += 60.0
                    assert stopped.wait(30.0)

    with pytest.raises(ControllerError, match="no sample came for"):
        take_slowly()


class Slow(TcpDriver):
    """The real driver, on a wire that carries this many samples a second."""

    carries = 499.0

    def throughput(self):
        return self.carries


def test_repeats_the_throughput_measurement_after_a_delay():
    carried = [331.0, 800.0]
    driver = type("Held", (Slow,), {"throughput": lambda self: carried.pop(0)})("127.0.0.1:1")
    check_throughput(driver, Identity("r", "s", "c", "1", ("a",), PERIOD), "here")
    assert carried == []


@pytest.mark.parametrize("carries", [499.0, np.nan])
def test_a_link_slower_than_the_samples_prevents_motion(bench, carries):
    bench.driver = type("Told", (Slow,), {"carries": carries})
    with pytest.raises(ControllerError, match=r"carries (499|nan) samples/s now, the controller makes 500"):
        bench.open()
    assert bench.controller.starts == 0


def test_accepts_a_fast_link_and_one_that_cannot_be_measured(bench):
    bench.driver = type("Told", (Slow,), {"carries": 500.0})
    bench.open()
    identity = Identity("r", "s", "c", "v", ("a",), 0.002)
    check_throughput(object(), identity, "here")
