"""Starts that fail and motions that are ended before their end: one start, and a stop."""

import gc
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import AgentError, SafetyError
from agent.safety import GuardedLink, PlannedProgram
from drivers.errors import DriverError, RefusedError
from drivers.transports.tcp.driver import TcpDriver
from drivers.wire.reasons import Refusal
from tests.conftest import patience
from tests.safety.following import HOME


def test_follows_a_stop_already_in_progress(bench, program):
    """The state asks for one and, while that is on its way, somebody ends the program: no command comes between."""
    sent, second = [], threading.Event()

    class Slow(TcpDriver):
        def stop(self):
            sent.append(1)
            second.wait(0.2)
            super().stop()

    bench.driver = Slow
    bench.controller.pushes, bench.controller.later = True, {"override": 0.9}
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_and_raise(guard, program(), KeyboardInterrupt, 2)
    assert sent == [1]


@pytest.mark.parametrize("told", [{"vanish_after": 4}, {"lose_answer": True}])
def test_a_lost_link_is_reported_with_what_to_do_and_no_start_is_repeated(bench, program, told):
    bench.controller = replace(bench.controller, **told)
    with pytest.raises(DriverError, match=r"make sure that the arm rests.*run the command again") as dropped:
        bench.run(program())
    assert dropped.value.exit_code == 4
    assert bench.controller.starts == 1


def test_a_start_without_an_answer_is_watched_from_its_first_sample(bench, program):
    bench.controller = replace(bench.controller, keep_answer=True, pushes=True)
    assert bench.run(program()) == 1000
    bench.guard.close()
    bench.controller.moves = lambda times: np.tile(HOME - 1.0, (len(times), 1))
    with pytest.raises(SafetyError, match="what moves is not what was planned"):
        bench.run(program())


@pytest.mark.parametrize("drops", [False, True])
def test_delivers_the_samples_of_a_failed_start_and_reports_it(bench, program, drops):
    went_on, taken = threading.Event(), []

    class Failing(TcpDriver):
        def start(self, name, checksum):
            super().start(name, checksum)
            raise DriverError("the answer was garbage")

        def stop(self):
            went_on.wait(0.1)
            super().stop()

        def samples(self):
            for block in super().samples():
                yield block
                if drops:
                    raise DriverError("gone")

    bench.driver = Failing
    guard = bench.open()
    guard.send(program())
    with pytest.raises(DriverError, match=r"garbage.*make sure that the arm rests"), guard.motion(program()) as samples:
        taken.extend((bench.controller.stops, went_on.set()) for _ in samples)
    assert taken
    assert {stops for stops, _ in taken} == {1}, "it was stopped before anybody took a sample"


def test_a_refused_start_is_not_repeated_and_not_stopped(bench, program):
    bench.controller.refuses = Refusal.ALARM
    with pytest.raises(RefusedError, match="alarm"):
        bench.run(program())
    assert (bench.controller.starts, bench.controller.stops) == (1, 0)


def test_a_failed_start_sends_a_stop(bench, program):
    """Who knows whether it arrived."""
    bench.controller.loses_start = True
    guard = bench.build()
    guard._driver._start_timeout = 0.5
    guard.open()
    with pytest.raises(DriverError, match=r"did not answer start.*Make sure that the arm rests"):
        bench.run(program(), guard)
    assert (bench.controller.starts, bench.controller.stops) == (1, 1)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, AgentError, SystemExit])
def test_any_sample_error_stops_the_arm(bench, error, program):
    asked, order, began, since = threading.Event(), [], time.monotonic(), []

    class Told(TcpDriver):
        def stop(self):
            since.append(time.monotonic())
            asked.set()
            super().stop()

        def samples(self):
            order.append("samples")
            try:
                yield from super().samples()
            finally:
                order.append(f"ended, stop asked for: {asked.wait(patience(2.0))}")

    bench.driver = Told
    # Our time begins with the stop, so that nobody else asks for one before.
    guard = bench.open(clock=lambda: began + (time.monotonic() - since[0] if since else 0.0))
    guard.send(program())
    with pytest.raises(error):
        _take_and_raise(guard, program(), error)
    assert (bench.controller.starts, bench.controller.stops) == (1, 1)
    assert order == ["samples", "ended, stop asked for: True"] * 2
    ended = [f"{bench.address}: the arm was stopped and stands; the log of this motion ends here"]
    assert bench.warned == ([] if issubclass(error, Exception) else ended), "somebody ended the program, or it failed"


def test_an_error_after_the_end_sends_no_stop(bench, program):
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_and_raise(guard, program(), KeyboardInterrupt, blocks=11)
    assert bench.controller.stops == 0
    assert bench.warned == []


def test_an_unconfirmed_stop_closes_the_link_with_a_message(bench, program):
    bench.controller.confirms_stop = False
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_and_raise(guard, program(), KeyboardInterrupt)
    assert len(bench.warned) == 1
    assert "not confirmed" in bench.warned[0]
    with pytest.raises(DriverError, match="connect first"):
        guard.position()
    bench.controller = replace(bench.controller, blocks=10**6, later={"override": 0.9})
    with pytest.raises(SafetyError, match=r"90 %.*the stop was not confirmed"):
        bench.run(program())


def test_closing_in_motion_stops_the_arm_first(bench, program):
    """And in motion nothing that was there before is looked through for garbage: nobody watches meanwhile."""
    guard = bench.open()
    guard.send(program())
    gc.unfreeze()
    left = guard.motion(program())
    next(left.__enter__())
    assert gc.get_freeze_count() > 0
    guard.close()
    assert bench.controller.stops == 1
    assert gc.get_freeze_count() == 0
    with pytest.raises(DriverError, match="connect first"):
        guard.position()


def test_a_kept_exception_does_not_keep_the_watch_thread_alive(bench, program):
    """The end of the program would wait for it for ever: its thread does not go on then."""
    guard = bench.open()
    guard.send(program())
    with pytest.raises(OSError, match="disk full") as kept:
        _take_and_raise(guard, program(), OSError, 2)
    assert kept.value.__traceback__ is not None
    assert "patience" not in {thread.name for thread in threading.enumerate()}


def _take_and_raise(guard: GuardedLink, chosen: PlannedProgram, error: type[BaseException], blocks: int = 1) -> None:
    with guard.motion(chosen) as samples:
        for _ in range(blocks):
            next(samples, None)
        raise error("disk full, Ctrl-C, anything")


def test_reports_the_position_of_the_arm(bench):
    np.testing.assert_array_equal(bench.open().position(), HOME)
