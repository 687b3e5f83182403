"""The watch while an arm moves: its state and its end are looked at, and what is wrong ends in a stop."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import ControllerError, SafetyError
from drivers.errors import DriverError, MotionStopped
from drivers.transports.tcp.driver import TcpDriver
from drivers.wire.reasons import EndReason
from tests.conftest import patience
from tests.safety.following import HOME


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
def test_a_state_change_in_motion_stops_the_arm(bench, later, said, program):
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


def test_an_unreadable_state_stops_the_arm(bench, program):
    bench.controller.blocks, bench.controller.status_fails_later = 50, True
    with pytest.raises(ControllerError, match="cannot be read any more"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_reports_a_controller_stop_in_its_own_words(bench, program):
    bench.controller.end = EndReason.PROTECTIVE_STOP
    with pytest.raises(MotionStopped, match=r"protective stop.*run the command again"):
        bench.run(program())


def test_the_controllers_reason_takes_precedence_over_the_state(bench, program):
    bench.controller.blocks, bench.controller.end = 50, EndReason.EMERGENCY_STOP
    bench.controller.later = {"emergency_stop": True}
    with pytest.raises(MotionStopped, match=r"emergency stop.*as told"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_polls_the_state_five_times_per_second_of_motion(bench, program, monkeypatch):
    """And the next samples wait for a prompt answer."""
    monkeypatch.setattr("agent.safety.watch.STATUS_WAIT", 5.0)
    went_on, early = threading.Event(), []

    class Told(TcpDriver):
        def status(self):
            went_on.clear()
            early.append(went_on.wait(0.05))
            return super().status()

    bench.driver = Told
    bench.controller.blocks, bench.controller.pushes, bench.controller.spacing = 40, True, 250_000
    guard = bench.open(clock=lambda: 0.0)
    before = bench.controller.asked.count("AskStatus") + 2  # the two before the start
    guard.send(program())
    with guard.motion(program()) as samples:
        for _ in samples:
            went_on.set()
    assert not any(early)
    assert 4 <= bench.controller.asked.count("AskStatus") - before <= 6


def test_polls_a_controller_with_a_constant_clock(bench, program, monkeypatch):
    monkeypatch.setattr("agent.safety.watch.STATUS_WAIT", 5.0)
    bench.controller.blocks, bench.controller.pushes, bench.controller.spacing = 40, True, 1
    ticks = iter(range(10**6))
    guard = bench.open(clock=lambda: 0.1 * next(ticks))
    before = bench.controller.asked.count("AskStatus") + 2
    with pytest.raises((ControllerError, SafetyError), match=r"samples were late|no sample came|before the end of its"):
        bench.run(program(), guard)
    assert bench.controller.asked.count("AskStatus") - before >= 10


def test_reports_a_motion_that_ends_before_its_plan(bench, program):
    bench.controller.blocks = 2
    guard, received = bench.open(), []
    chosen = program()
    guard.send(chosen)
    with pytest.raises(SafetyError, match=r"over, 0\.\d s before the end of its plan"), guard.motion(chosen) as samples:
        received += samples
    assert sum(len(block) for block in received) == 200


def test_accepts_lost_last_samples_if_the_arm_is_at_the_end(bench, program):
    bench.controller = replace(bench.controller, blocks=4, pushes=True, drops=(2, 3))
    assert bench.run(program()) == 200
    assert bench.guard.lost == 200
    for elsewhere in (tuple(HOME + 0.2), tuple(HOME[:5]), (np.nan,) * 6):
        bench.guard.close()
        bench.controller = replace(bench.controller, later={"position": elsewhere})
        with pytest.raises(SafetyError, match=r"over, 0\.\d s before the end of its plan"):
            bench.run(program())


def test_samples_lost_earlier_do_not_excuse_an_early_end(bench, program):
    """What was lost on the way has gone by; so has a loss at first."""
    (chain,) = program().chains
    chosen = replace(program(), chains=(replace(chain, t=2 * chain.t, qd=chain.qd / 2),))
    for drops in ((1, 2), (0, 1)):
        bench.controller = replace(bench.controller, blocks=6, pushes=True, drops=drops)
        bench.controller.moves = lambda times: chain.q[np.minimum((250 * times).astype(int), 499)]
        with pytest.raises(SafetyError, match=r"over, 0\.\d s before the end of its plan"):
            bench.run(chosen)
        bench.guard.close()


def test_an_unanswered_state_request_does_not_delay_the_watch(bench, program):
    """What leaves the plan is stopped while the question for the state is still open."""
    (chain,) = program().chains
    bench.controller = replace(bench.controller, blocks=40, pushes=True, status_hangs_later=True)
    bench.controller.moves = lambda times: chain.q[0] + 0.4 * np.sin(2 * times)[:, None]
    with pytest.raises(SafetyError, match="what moves is not what was planned"):
        bench.run(program())
    assert bench.controller.stops == 2, "by the watch, and on the way out"


def test_a_late_state_stops_the_arm_before_the_next_sample(bench, program, monkeypatch):
    """The stop is asked for when the answer comes, not with the next block."""
    monkeypatch.setattr("agent.safety.watch.STATUS_WAIT", 0.0)
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
def test_the_stop_reason_takes_precedence_over_the_end_of_samples(bench, program, fails, astray):
    bench.driver = type("Told", (AtOnce,), {"fails": fails})
    bench.controller.pushes, bench.controller.later = True, {} if astray else {"override": 0.9}
    if astray:
        bench.controller.moves = lambda times: np.tile(HOME - 0.3, (len(times), 1))
    with pytest.raises(SafetyError, match="was stopped.*off the planned path" if astray else "was stopped.*90 %"):
        bench.run(program())


class Asked(TcpDriver):
    """The real driver; looks at the state in motion are counted, and the first of them `raises` or is not answered."""

    raises = False

    def start(self, name, checksum):
        self.looks, self.looked, self.released = 0, threading.Event(), threading.Event()
        super().start(name, checksum)

    def status(self):
        if hasattr(self, "looks"):
            self.looks += 1
            self.looked.set()
            if self.looks == 1 and self.raises:
                raise ValueError("as told")
            assert self.raises or self.released.wait(patience(5.0))
        return super().status()

    def samples(self):
        yield from super().samples()
        assert self.looked.wait(patience(5.0)), "all of them may have come before anybody looked"
        if not self.raises:
            assert self.looks == 1, "the others had to wait for its answer"
        self.released.set()


@pytest.mark.parametrize("raises", [True, False])
def test_polls_one_at_a_time_and_passes_on_exceptions(bench, program, raises):
    bench.driver, bench.controller.pushes = type("Told", (Asked,), {"raises": raises}), True
    if not raises:
        assert bench.run(program()) == 1000
        return
    with pytest.raises(ValueError, match="as told"):
        bench.run(program())
    assert bench.controller.stops >= 1
