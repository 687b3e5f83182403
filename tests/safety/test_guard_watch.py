"""The watch over a motion with a scripted link: a start, a stop, and the motion up to its end."""

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import ControllerError, SafetyError
from agent.robot import load_robot
from agent.safety.freshness import FIRST_SAMPLE_DELAY
from agent.safety.stopping import CLOSE_LINK_AFTER
from agent.safety.watch import POLL_INTERVAL, MotionWatch
from drivers.errors import DriverError, MotionStopped
from drivers.protocol import SampleBlock, Status
from tests.safety.following import HOME, PERIOD, Clock

ROBOT = load_robot("comau_ns16")


class Link:
    """A driver whose samples a test yields; `moves`: its state says that the arm does."""

    watchdog = 0.5
    gaps = ()

    def __init__(self) -> None:
        self.clock, self.warned = Clock(), []
        self.stops, self.looks = 0, 0
        self.moves = False
        self.script: Iterator[SampleBlock] = iter(())
        self.closed = threading.Event()
        self._sequence = 0
        self.watch = MotionWatch(self, ROBOT, "here", PERIOD, Content(), 100.0, self.clock, self.warned.append)

    def samples(self) -> Iterator[SampleBlock]:
        return self.script

    def stop(self) -> None:
        self.stops += 1

    def status(self) -> Status:
        self.looks += 1
        self.clock.now += 0.1 if self.watch.stopping.since is not None else 0.0
        position = HOME + (self.clock.now if self.moves else 0.0)
        return Status(True, "auto", False, (), 1.0, True, True, "p", "", position)

    def close(self) -> None:
        self.closed.set()

    def block(self, time: float, speed: float = 0.0) -> SampleBlock:
        """50 samples from `time` [s] on; `speed`: as a part of a joint's limit."""
        times = time + PERIOD * np.arange(50)
        positions = HOME + np.outer(times * speed, np.eye(6)[1] * ROBOT.max_velocity[1])
        numbers, nothing = self._sequence + np.arange(50), np.zeros_like(positions)
        self._sequence += 50
        return SampleBlock(numbers, times, positions, None, nothing, None, None)

    def turns(self, seconds: float) -> None:
        for _ in range(round(seconds / POLL_INTERVAL)):
            self.clock.now += POLL_INTERVAL
            self.watch.poll()


class Content:
    """Finds nothing wrong with a motion."""

    remaining_time = 0.0

    def take(self, block: SampleBlock) -> None:
        pass

    def judge(self) -> None:
        pass


def test_the_duration_of_a_start_is_not_sample_silence():
    link = Link()
    link.clock.now += 60.0
    stopped = []

    def script():
        link.turns(0.5)
        stopped.append(link.watch.stopping.since is not None)
        link.turns(1.0 + FIRST_SAMPLE_DELAY)
        stopped.append(link.watch.stopping.since is not None)
        yield link.block(5.0)

    link.script = script()
    with pytest.raises(ControllerError, match="no sample came within"):
        list(link.watch.samples())
    assert stopped == [False, True]


@pytest.mark.parametrize("read", [MotionWatch.samples, MotionWatch.drain])
def test_samples_of_a_stationary_arm_confirm_a_stop(read):
    """Whatever its state says."""
    link = Link()
    link.moves = True

    def script():
        yield link.block(5.0, speed=0.3)
        link.watch.stopping.request()
        for k in range(1, 8):
            link.clock.now += 0.1
            yield link.block(5.0 + 0.1 * k)

    link.script = script()
    before = link.looks
    assert len(list(read(link.watch))) == 8
    link.watch.stopping.wait(10.0)
    assert (link.stops, link.warned, link.closed.is_set()) == (1, [], False)
    assert link.watch.stopping.over
    assert link.looks - before <= 1 + 4, "only what is asked while an arm moves"


@pytest.mark.parametrize("dropped", [None, DriverError("the link dropped")])
def test_uses_a_state_answered_after_the_last_sample(dropped):
    link, asked = Link(), threading.Event()

    def status():
        asked.set()
        while not link.watch._samples_ended:
            threading.Event().wait(0.001)
        link.turns(2.0)
        return replace(Link.status(link), override=0.5)

    def script():
        yield link.block(5.0)
        assert asked.wait(10.0)
        if dropped is not None:
            raise dropped

    link.status, link.script = status, script()
    with pytest.raises(SafetyError, match="override"):  # and no word of samples that did not come meanwhile
        list(link.watch.samples())


@pytest.mark.parametrize(
    ("ended", "looks"),
    [(None, True), (MotionStopped("stopped at the controller"), True), (DriverError("the link dropped"), False)],
)
def test_reports_an_arm_that_moves_after_a_stop_and_an_end(ended, looks):
    link = Link()
    link.moves = True

    def script():
        yield link.block(5.0, speed=0.3)
        link.watch.stopping.request()
        link.clock.now += 1.0
        if ended is not None:
            raise ended

    link.script = script()
    with pytest.raises(SafetyError if looks else DriverError, match="^here; .*does not obey" if looks else "dropped"):
        list(link.watch.samples())
    assert link.watch.stopping.disobeyed is looks


@pytest.mark.parametrize(
    ("times", "joints", "said"),
    [((5.0,), 5, "sent samples of 5 joints"), ((5.0, 4.0, 2.0), 6, r"back by 1\.1 s"), ((np.nan,), 6, "back by nan s")],
)
def test_reports_the_first_fault_of_samples(times, joints, said):
    link = Link()
    blocks = [link.block(time) for time in times]
    link.script = iter([replace(block, position=block.position[:, :joints]) for block in blocks])
    with pytest.raises(ControllerError, match=said):
        list(link.watch.samples())


def test_a_block_delivered_before_a_stop_is_delivered_again():
    """Whoever was interrupted may not have taken it."""
    link = Link()
    blocks = [link.block(5.0 + 0.1 * k) for k in range(3)]
    link.script = iter(blocks)
    given = link.watch.samples()
    assert next(given) is blocks[0]
    given.close()
    link.script = iter(blocks)
    assert list(link.watch.drain()) == blocks
    assert link.warned == []


def test_a_closed_link_is_no_fault_of_an_arm_that_was_told_to_stop():
    """A start that fails stops the arm and closes the link: the state cannot be read then, and that is not why."""
    link, asked = Link(), []

    def status() -> Status:
        asked.append(link.watch.stopping.since)
        raise DriverError("the link is not open")

    link.status, link.script = status, iter([link.block(5.0), link.block(6.0)])
    link.watch.stopped = True
    link.watch.stopping.request()
    list(link.watch.samples())
    assert asked
    assert None not in asked


def test_polling_ends_with_the_motion():
    """It could blame an arm that is no longer watched."""
    link = Link()
    entered, release, done = threading.Event(), threading.Event(), []

    def poll():
        entered.set()
        done.append(release.wait(10.0))

    def script():
        assert entered.wait(10.0)
        threading.Timer(0.1, release.set).start()
        yield link.block(5.0)

    link.watch.poll, link.script = poll, script()
    list(link.watch.samples())
    assert done


@pytest.mark.parametrize("obeys", [True, False])
def test_reports_a_clock_set_back_as_fault_and_an_ignored_stop_as_danger(obeys):
    link = Link()

    def script():
        yield link.block(5.0, speed=0.3)
        yield link.block(4.0, speed=0.3)
        for k in range(1, 3 + round(CLOSE_LINK_AFTER / 0.1)):
            link.turns(0.1)
            yield link.block(5.0 + 0.1 * k, speed=0.0 if obeys else 0.3)

    link.script = script()
    kind, said = (ControllerError, "set its clock back by 1.1 s") if obeys else (SafetyError, "does not obey")
    with pytest.raises(kind, match=said):
        list(link.watch.samples())
    assert obeys or link.closed.wait(10.0)


def test_closes_the_link_of_an_arm_that_moves_after_the_last_samples():
    link = Link()
    link.moves = True
    link.script = iter([link.block(5.0, speed=0.3)])
    assert len(list(link.watch.drain())) == 1
    assert "does not obey" in link.warned[0]
    assert link.closed.wait(10.0)
    assert link.watch.stopping.disobeyed
