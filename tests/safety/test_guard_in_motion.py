"""The watch while an arm moves: whatever ends a motion before its end ends it in a stop."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import AgentError, ControllerError, SafetyError
from agent.motion.program import Delay
from agent.safety.guard import GuardedLink
from agent.safety.looks import Looks
from agent.safety.motion import SETTLING, PlannedProgram, pauses
from agent.safety.patience import Patience
from drivers.errors import DriverError, MotionStopped, RefusedError
from drivers.transports.tcp import TcpDriver
from drivers.wire.reasons import EndReason, Refusal
from tests.conftest import patience

HOME = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("later", "said"),
    [
        ({"emergency_stop": True}, "emergency stop"),
        ({"drives_on": False}, "drives went off"),
        ({"alarms": ("4711",)}, "4711"),
        ({"cell_closed": False}, "cell was opened"),
        ({"mode": "teach"}, "mode was changed"),
        ({"override": 0.9}, "90 %"),
        ({"override": 1.2}, "120 %"),
    ],
)
def test_what_changes_in_motion_stops_the_arm(bench, later, said, program):
    """Also where the controller itself would go on."""
    bench.controller.blocks, bench.controller.later = 50, later
    taken = []
    guard = bench.open()
    guard.send(program())
    with pytest.raises(SafetyError, match=said), guard.motion(program()) as samples:
        taken.extend(samples)
    assert bench.controller.stops >= 1
    assert bench.controller.starts == 1
    assert 3 <= len(taken) <= 6, "everything that came before the arm rested is handed out, and it rests soon"
    assert not bench.checked.has("NS16-7", program().checksum)


def test_a_state_that_cannot_be_read_any_more_stops_the_arm(bench, program):
    bench.controller.blocks, bench.controller.status_fails_later = 50, True
    with pytest.raises(ControllerError, match="cannot be read any more"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_what_the_controller_stopped_is_told_as_it_tells_it(bench, program):
    bench.controller.end = EndReason.PROTECTIVE_STOP
    with pytest.raises(MotionStopped, match=r"protective stop.*run the command again"):
        bench.run(program())


def test_the_controllers_own_word_comes_before_what_the_state_says(bench, program):
    bench.controller.blocks, bench.controller.end = 50, EndReason.EMERGENCY_STOP
    bench.controller.later = {"emergency_stop": True}
    with pytest.raises(MotionStopped, match=r"emergency stop.*as told"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_a_look_costs_a_request_and_is_taken_five_times_a_second_of_motion(bench, program, monkeypatch):
    monkeypatch.setattr("agent.safety.looks.PROMPT", 5.0)
    bench.controller.blocks, bench.controller.pushes, bench.controller.spacing = 40, True, 250_000
    guard = bench.open(clock=lambda: 0.0)
    before = bench.controller.asked.count("AskStatus") + 2  # the two before the start
    bench.run(program(), guard)
    assert 4 <= bench.controller.asked.count("AskStatus") - before <= 6


def test_a_controller_whose_time_stands_still_is_looked_at_all_the_same(bench, program, monkeypatch):
    monkeypatch.setattr("agent.safety.looks.PROMPT", 5.0)
    bench.controller.blocks, bench.controller.pushes, bench.controller.spacing = 40, True, 1
    ticks = iter(range(10**6))
    guard = bench.open(clock=lambda: 0.1 * next(ticks))
    before = bench.controller.asked.count("AskStatus") + 2
    with pytest.raises(SafetyError, match=r"over, 0\.9 s before the end of its plan"):
        bench.run(program(), guard)
    assert bench.controller.asked.count("AskStatus") - before >= 10


def test_a_motion_that_ends_before_its_plan_is_refused(bench, program):
    bench.controller.blocks = 2
    guard, received = bench.open(), []
    chosen = program()
    guard.send(chosen)
    with pytest.raises(SafetyError, match=r"over, 0\.\d s before the end of its plan"), guard.motion(chosen) as samples:
        received += samples
    assert sum(len(block) for block in received) == 200


def test_the_end_of_a_motion_may_be_lost_where_the_arm_stands_there(bench, program):
    bench.controller = replace(bench.controller, blocks=4, pushes=True, drops=(2, 3))
    assert bench.run(program()) == 200
    assert bench.guard.lost == 200
    for elsewhere in (tuple(HOME + 0.2), tuple(HOME[:5]), (np.nan,) * 6):
        bench.guard.close()
        bench.controller = replace(bench.controller, later={"position": elsewhere})
        with pytest.raises(SafetyError, match=r"over, 0\.\d s before the end of its plan"):
            bench.run(program())


def test_no_loss_on_the_way_makes_good_for_an_early_end(bench, program):
    """What was lost on the way has gone by; so has a loss at first."""
    (chain,) = program().chains
    chosen = replace(program(), chains=(replace(chain, t=2 * chain.t, qd=chain.qd / 2),))
    for drops in ((1, 2), (0, 1)):
        bench.controller = replace(bench.controller, blocks=6, pushes=True, drops=drops)
        bench.controller.moves = lambda times: chain.q[np.minimum((250 * times).astype(int), 499)]
        with pytest.raises(SafetyError, match=r"over, 0\.\d s before the end of its plan"):
            bench.run(chosen)
        bench.guard.close()


def test_a_state_that_is_not_answered_delays_no_watch(bench, program):
    """What leaves the plan is stopped while the question for the state is still open."""
    (chain,) = program().chains
    bench.controller = replace(bench.controller, blocks=40, pushes=True, status_hangs_later=True)
    bench.controller.moves = lambda times: chain.q[0] + 0.4 * np.sin(2 * times)[:, None]
    with pytest.raises(SafetyError, match="what moves is not what was planned"):
        bench.run(program())
    assert bench.controller.stops == 2, "by the watch, and on the way out"


def test_a_state_that_comes_late_stops_the_arm_without_another_sample(bench, program, monkeypatch):
    """The stop is asked for when the answer comes, not with the next block."""
    monkeypatch.setattr("agent.safety.looks.PROMPT", 0.0)
    over = threading.Event()

    class Waiting(TcpDriver):
        def samples(self):
            yield next(super().samples())
            assert over.wait(patience(5.0))

        def stop(self):
            over.set()
            super().stop()

    bench.driver = Waiting
    bench.controller.pushes, bench.controller.later = True, {"override": 0.9}
    with pytest.raises(SafetyError, match="90 %"):
        bench.run(program())


class AtOnce(TcpDriver):
    """The real driver; of its samples there is one block."""

    fails = False

    def samples(self):
        yield next(super().samples())
        if self.fails:
            raise DriverError("gone")


@pytest.mark.parametrize("fails", [True, False])
@pytest.mark.parametrize("astray", [True, False])
def test_why_it_was_stopped_comes_before_how_the_samples_end(bench, program, fails, astray):
    bench.driver = type("Told", (AtOnce,), {"fails": fails})
    bench.controller.pushes, bench.controller.later = True, {} if astray else {"override": 0.9}
    if astray:
        bench.controller.moves = lambda times: np.tile(HOME - 0.3, (len(times), 1))
    with pytest.raises(SafetyError, match="was stopped.*off the planned path" if astray else "was stopped.*90 %"):
        bench.run(program())


def test_one_stop_after_the_other(bench, program):
    """The state asks for one and, while that is on its way, somebody ends the program."""
    inside, most, second = [], [], threading.Event()

    class Slow(TcpDriver):
        def stop(self):
            inside.append(1)
            most.append(len(inside))
            if len(inside) > 1:
                second.set()
            second.wait(0.2)
            super().stop()
            inside.pop()

    bench.driver = Slow
    bench.controller.pushes, bench.controller.later = True, {"override": 0.9}
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_and_raise(guard, program(), KeyboardInterrupt, 2)
    assert most == [1, 1]


def test_one_look_at_a_time_and_what_it_raises_is_raised():
    told, asked, answer, stops = [], threading.Event(), threading.Event(), []

    def ask(now):
        told.append(now)
        asked.set()
        assert answer.wait(patience(5.0))
        if now == 3.0:
            raise ValueError("as told")
        return ControllerError(f"at {now}") if now else None

    looks = Looks(ask, lambda: stops.append(looks.found))
    looks.look(0.0)
    assert asked.wait(patience(5.0))
    looks.look(1.0)
    looks.look(2.0)
    assert told == [0.0], "the others had to wait for its answer"
    answer.set()
    assert looks.result() is None
    looks.look(4.0)
    assert str(looks.result()) == str(stops[0]) == "at 4.0"
    looks.look(3.0)
    with pytest.raises(ValueError, match="as told"):
        looks.result()
    with pytest.raises(ValueError, match="as told"):
        looks.look(5.0)


def test_a_link_that_drops_is_told_with_what_to_do(bench, program):
    bench.controller.vanish_after = 4
    with pytest.raises(DriverError, match=r"make sure that the arm rests.*run the command again") as dropped:
        bench.run(program())
    assert dropped.value.exit_code == 4
    assert bench.controller.starts == 1


def test_a_start_whose_answer_is_lost_is_not_repeated(bench, program):
    bench.controller.lose_answer = True
    with pytest.raises(DriverError, match="make sure that the arm rests"):
        bench.run(program())
    assert bench.controller.starts == 1


def test_a_start_whose_answer_is_lost_is_watched_from_its_first_sample(bench, program):
    bench.controller = replace(bench.controller, keep_answer=True, pushes=True)
    assert bench.run(program()) == 1000
    bench.guard.close()
    bench.controller.moves = lambda times: np.tile(HOME - 1.0, (len(times), 1))
    with pytest.raises(SafetyError, match="what moves is not what was planned"):
        bench.run(program())


def test_what_came_of_a_start_that_failed_is_handed_out(bench, program):
    class Failing(TcpDriver):
        def start(self, name, checksum):
            super().start(name, checksum)
            raise DriverError("the answer was garbage")

    bench.driver, taken = Failing, []
    guard = bench.open()
    guard.send(program())
    with pytest.raises(DriverError, match=r"garbage.*make sure that the arm rests"), guard.motion(program()) as samples:
        taken.extend((bench.controller.stops, len(block)) for block in samples)
    assert taken
    assert {stops for stops, _ in taken} == {1}, "it was stopped before anybody took a sample"


def test_a_start_that_failed_is_told_and_not_how_the_samples_end(bench, program):
    class Failing(TcpDriver):
        def start(self, name, checksum):
            super().start(name, checksum)
            raise DriverError("the answer was garbage")

        def samples(self):
            yield next(super().samples())
            raise DriverError("gone")

    bench.driver = Failing
    with pytest.raises(DriverError, match="the answer was garbage"):
        bench.run(program())


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


def test_a_taker_who_is_slow_is_no_silence():
    gone = []
    clock = iter(range(0, 10**6, 100))
    patience = Patience(10.0, lambda: next(clock), lambda: gone.append(1))
    taken = []
    for item in patience.each(iter([1, 2])):
        taken.append(item)
    assert taken == [1, 2]
    assert not patience.lost


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


def test_a_refused_start_is_not_repeated_and_not_stopped(bench, program):
    bench.controller.refuses = Refusal.ALARM
    with pytest.raises(RefusedError, match="alarm"):
        bench.run(program())
    assert (bench.controller.starts, bench.controller.stops) == (1, 0)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, AgentError, SystemExit])
def test_whatever_goes_wrong_with_the_samples_stops_the_arm(bench, error, program):
    guard = bench.open()
    guard.send(program())
    with pytest.raises(error):
        _take_and_raise(guard, program(), error)
    assert (bench.controller.starts, bench.controller.stops) == (1, 1)
    ended = [f"{bench.address}: the arm was stopped and stands; the log of this motion ends here"]
    assert bench.warned == ([] if issubclass(error, Exception) else ended), "somebody ended the program, or it failed"


def test_what_goes_wrong_after_the_end_stops_nothing(bench, program):
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_and_raise(guard, program(), KeyboardInterrupt, blocks=11)
    assert bench.controller.stops == 0
    assert bench.warned == []


def test_a_stop_that_is_not_confirmed_closes_the_link_and_says_so(bench, program):
    bench.controller.confirms_stop = False
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_and_raise(guard, program(), KeyboardInterrupt)
    assert len(bench.warned) == 1
    assert "not confirmed" in bench.warned[0]
    with pytest.raises(DriverError, match="connect first"):
        guard.position()


def test_a_link_that_is_closed_in_motion_stops_the_arm_first(bench, program):
    guard = bench.open()
    guard.send(program())
    left = guard.motion(program())
    next(left.__enter__())
    guard.close()
    assert bench.controller.stops == 1


def test_a_closed_link_is_closed(bench):
    guard = bench.open()
    guard.close()
    with pytest.raises(DriverError, match="connect first"):
        guard.position()


def _take_and_raise(guard: GuardedLink, chosen: PlannedProgram, error: type[BaseException], blocks: int = 1) -> None:
    with guard.motion(chosen) as samples:
        for _ in range(blocks):
            next(samples, None)
        raise error("disk full, Ctrl-C, anything")


def test_where_the_arm_stands(bench):
    np.testing.assert_array_equal(bench.open().position(), HOME)
