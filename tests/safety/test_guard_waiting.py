"""A motion has an end: how long it may last, and how long it may be silent."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import SafetyError
from agent.motion.program import Delay
from agent.safety.motion import SETTLING, pauses
from agent.safety.patience import Patience
from drivers.errors import DriverError
from drivers.transports.tcp import TcpDriver


def test_a_motion_that_does_not_end_is_stopped(bench, program):
    chosen = program()
    (chain,) = chosen.chains
    bench.controller = replace(
        bench.controller, blocks=10**6, moves=lambda times: np.tile(chain.q[-1], (len(times), 1))
    )
    with pytest.raises(SafetyError, match=r"has lasted 1\d s, its plan takes 14 s at most"):
        bench.run(chosen)
    assert bench.controller.stops >= 1


def test_a_motion_whose_clock_stands_still_is_stopped_too(bench, program):
    chosen = program()
    bench.controller = replace(bench.controller, blocks=10**6, spacing=0)
    ticks = iter(range(10**6))
    with pytest.raises(SafetyError, match="has lasted"):
        bench.run(chosen, bench.open(clock=lambda: 0.3 * next(ticks)))


def test_pauses_and_stops_belong_to_the_time_that_a_motion_may_take(program):
    chosen = program()
    statements = [Delay(2.0), Delay(3.5)]
    assert pauses(statements) == 5.5
    assert replace(chosen, pauses=5.5).longest == pytest.approx(chosen.longest + 5.5)
    assert replace(chosen, chains=chosen.chains * 2).longest > chosen.longest + SETTLING + chosen.duration


def test_a_controller_that_lives_and_sends_no_samples_is_stopped(bench, program):
    class Mute(TcpDriver):
        def samples(self):
            motion = super().samples()
            yield next(motion)
            for _ in motion:
                pass  # whatever comes gets lost; the last of it is that the arm rests

    bench.driver = Mute
    bench.controller.blocks = 10**6
    ticks = iter(range(10**6))
    with pytest.raises(SafetyError, match="no sample came for 10 s"):
        bench.run(program(), bench.open(clock=lambda: 5.0 * next(ticks)))
    assert bench.controller.stops >= 1


@pytest.mark.parametrize("fails", [True, False])
@pytest.mark.parametrize(("later", "said"), [({}, "no sample came for 10 s"), ({"override": 0.9}, "90 %")])
def test_silence_is_told_and_hides_no_other_reason(bench, program, fails, later, said):
    """However the samples end once it is over."""

    class Stuck(TcpDriver):
        stops = 0

        def samples(self):
            yield next(super().samples())
            over.wait()
            if fails:
                raise DriverError("gone")

        def stop(self):
            self.stops += 1
            if self.stops > len(later):  # one that the state asked for is answered, and nothing ends
                over.set()
                super().stop()

    over = threading.Event()
    bench.driver = Stuck
    bench.controller.pushes, bench.controller.later = True, later
    ticks = iter(range(10**6))
    with pytest.raises(SafetyError, match=said):
        bench.run(program(), bench.open(clock=lambda: 5.0 * next(ticks)))


def test_a_taker_who_is_slow_is_no_silence_and_a_silence_after_it_is_one(monkeypatch):
    monkeypatch.setattr("agent.safety.patience._TURN", 0.001)
    looks, gone, now = threading.Semaphore(0), threading.Event(), [0.0]

    class Looks(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            looks.release()
            return super().wait(timeout)

    def items():
        yield 1
        now[0] = 200.0
        assert gone.wait(5.0)
        yield 2

    patience = Patience(10.0, lambda: now[0], gone.set)
    patience._over = Looks()
    for item in patience.each(items()):
        if item == 1:
            now[0] = 100.0
            assert all(looks.acquire(timeout=5.0) for _ in range(3))
            assert not patience.lost
    assert patience.lost


def test_who_is_waited_for_no_longer_than_the_limit_is_not_given_up(monkeypatch):
    monkeypatch.setattr("agent.safety.patience._TURN", 0.001)
    asked, looked, gone = [], threading.Event(), []

    def clock():
        asked.append(1)
        if len(asked) > 5:
            looked.set()
        return 0.0

    def items():
        yield 1
        assert looked.wait(5.0)
        yield 2

    waiting = Patience(10.0, clock, lambda: gone.append(1) or looked.set())
    assert list(waiting.each(items())) == [1, 2]
    assert not waiting.lost
    assert gone == []


def test_a_clock_that_shows_no_time_is_none_to_wait_by(monkeypatch):
    monkeypatch.setattr("agent.safety.patience._TURN", 0.001)
    gone = threading.Event()

    def items():
        assert gone.wait(5.0)
        yield 1

    waiting = Patience(10.0, lambda: np.nan, gone.set)
    assert list(waiting.each(items())) == [1]
    assert waiting.lost


def test_a_stop_that_is_on_its_way_is_waited_for():
    """Or it would meet the next motion."""
    asked, answered, done = threading.Event(), threading.Event(), []

    def stop():
        asked.set()
        assert answered.wait(5.0)
        done.append(1)

    def items():
        yield 1
        assert asked.wait(5.0)
        threading.Timer(0.05, answered.set).start()

    clock = iter(range(0, 10**6, 100))
    assert list(Patience(10.0, lambda: next(clock), stop).each(items())) == [1]
    assert done == [1]
