"""The watch over an arm in motion: its samples and how old they are, its state, its temperatures, its end."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, wait
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING

import numpy as np

from agent.core import AgentError, ControllerError, SafetyError
from agent.safety.adherence import Adherence
from agent.safety.freshness import EXCUSED, Freshness
from agent.safety.preconditions import unsafe_in_motion
from agent.safety.stopping import Stopping, run_in_thread
from drivers.errors import DriverError, MotionStopped
from drivers.protocol import Driver, ReportsSettings, ReportsTemperatures, SampleBlock, Status

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Interval between two looks at the controller's state while the arm moves [s], of its time and of ours.
WATCH_INTERVAL = 0.2
#: Time before the end of its plan [s] at which a motion may end, where it does not wait for the arm to arrive.
EARLY_END_TOLERANCE = 0.25
#: Interval between two questions for temperatures [s]: motors warm up slowly.
TEMPERATURE_INTERVAL = 5.0
#: Interval between two looks at age and stop [s], by a thread that nobody keeps waiting.
POLL_INTERVAL = 0.05
#: Time that the samples wait for an answer [s]; a later one counts when it comes.
STATUS_WAIT = 0.05


class MotionWatch:
    """Hands out the samples of one motion, and stops the arm where something is not as it must be.

    Parameters
    ----------
    driver : of the motion.
    robot : that moves.
    address : for messages.
    period : of samples [s].
    adherence : whether the arm does what was planned.
    longest : time that the motion may last [s], by the controller's clock.
    clock : our time [s].
    warn : tells what a person should know at once.
    """

    def __init__(
        self,
        driver: Driver,
        robot: RobotDescription,
        address: str,
        period: float,
        adherence: Adherence,
        longest: float,
        clock: Callable[[], float],
        warn: Callable[[str], None],
    ) -> None:
        self._driver = driver
        self._robot = robot
        self._address = address
        self._period = period
        self._adherence = adherence
        self._longest = longest
        self._clock = clock
        self._fault: AgentError | None = None
        self._lock = threading.Lock()
        self._began: float | None = None  # controller time of the first sample
        self._now, self._last = -np.inf, -1  # time and number of the last one
        self._looked, self._looked_at = -np.inf, clock()
        self._asked: Future[None] = Future()  # the last look at the state
        self._asked.set_result(None)
        self._turned, self._excused = clock(), 0.0
        self._samples_ended = False  # the last sample has come
        #: The end was asked for, so it comes before that of the plan.
        self.stopped = False
        self._settings: Mapping[str, str] = {}  # at the controller, when they were read last
        #: What was set anew at the controller: controller time [s], name, and texts before and after.
        self.changes: list[tuple[float, str, str, str]] = []
        self._warn = warn
        #: (controller time [s], (n,) [°C]), where the controller measures temperatures.
        self.temperatures: list[tuple[float, np.ndarray]] = []
        self._freshness = Freshness(period, driver.watchdog, clock)
        self._listener: threading.Thread | None = None
        self._heard: deque[SampleBlock] = deque()  # judged while the motion was being started
        self._lost: Exception | None = None  # of the thread that judged them
        self._started = threading.Event()
        self._until_started = ExitStack()
        self._source: Iterator[SampleBlock] | None = None
        #: The stop of this motion.
        self.stopping = Stopping(driver, robot, address, self._freshness, clock, warn)

    def listen(self) -> None:
        """Judge samples while the motion is being started, in a thread, until `samples` or `drain` takes over."""
        self._freshness.hold()
        self._source = self._driver.samples()
        self._until_started.enter_context(self._watched())
        self._listener = threading.Thread(target=self._hear, name="listener", daemon=True)
        self._listener.start()

    def _hear(self) -> None:
        assert self._source is not None
        try:
            for block in self._source:
                if self._judge(block):
                    self._heard.append(block)
                if self._started.is_set():
                    break
        except Exception as error:  # whatever it is, it is raised where the samples are read
            self._lost = error
            self.stopping.request()

    def settle(self, limit: float | None = None) -> None:
        """The start has ended: the thread that listened hands over, with the next block; after `limit` [s] at most."""
        self._started.set()
        if self._listener is not None:
            self._listener.join(limit)
        self._until_started.close()

    def _judged(self) -> Iterator[SampleBlock]:
        """Samples for the log: those that came while the motion was being started, and all that follow."""
        self._started.set()
        while self._listener is not None and self._listener.is_alive():  # until its next block, which may never come
            yield from self._handed_out()
            self._listener.join(POLL_INTERVAL)
        self.settle()
        yield from self._handed_out()
        if self._lost is not None:
            raise self._lost
        self._source = self._driver.samples() if self._source is None else self._source
        for block in self._source:
            if self._judge(block):
                yield block

    def _handed_out(self) -> Iterator[SampleBlock]:
        while self._heard:
            yield self._heard[0]  # and once more after an interruption: whoever took it may have lost it
            self._heard.popleft()

    def samples(self) -> Iterator[SampleBlock]:
        """The samples, with a look at the controller's state now and then; what is left after a stop comes too.

        Raises:
            SafetyError: why the arm was stopped, or that it did not obey.
            ControllerError: the link is too slow or silent, or sends what is no sample of this arm.
            DriverError: the link failed, or the controller ended the motion.
        """
        dropped: DriverError | None = None
        self._freshness.begin()
        with self._watched():
            try:
                for block in self._judged():
                    yield block
                    now = float(block.time[-1])  # what is judged may be further by now
                    recently = now - self._looked < WATCH_INTERVAL
                    if not (recently and self._clock() - self._looked_at < WATCH_INTERVAL):
                        self._look_at_state()
                        self._looked, self._looked_at = now, self._clock()
            except DriverError as error:
                dropped = error
            self._samples_ended = True
            self._asked.result()
            self._finish(dropped)
        self._raise_fault(dropped)
        with suppress(DriverError):  # the motion is over and recorded
            self._read_temperatures(self._now, 0.0)

    def drain(self) -> Iterator[SampleBlock]:
        """What is left of the samples after a stop, until the arm stands or the link is closed. Never raises."""
        self.stopping.request()
        failed: Exception | None = None
        with self._watched():
            try:
                self.settle()
                while self._heard:
                    yield self._heard.popleft()
                if isinstance(self._source, Generator):
                    self._source.close()  # what it has not handed out comes once more
                for block in self._driver.samples():
                    if int(block.sequence[-1]) <= self._last:
                        yield block  # once more: whoever was interrupted may not have taken it
                    elif self._defect(block) is None:
                        self._note(block)
                        yield block
            except Exception as error:  # whatever it is, the arm is followed to its end
                failed = error
            self._finish(failed)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """A thread looks at the age of the samples, and at an arm that was told to stop."""
        over = threading.Event()

        def watch() -> None:
            while not over.wait(POLL_INTERVAL):
                self.poll()

        thread = threading.Thread(target=watch, name="watch", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def poll(self) -> None:
        """One iteration of that thread."""
        now = self._clock()
        # A stall of this whole process is no delay of the link: what came meanwhile is judged first, which takes time.
        passed, self._turned = now - self._turned, now
        stalled = max(0.0, passed - 2 * POLL_INTERVAL)
        self._excused = min(self._excused + stalled, EXCUSED) if stalled else max(0.0, self._excused - passed)
        if self.stopping.since is not None:
            self.stopping.poll(stalled)
        elif not self._samples_ended and (reason := self._freshness.fault(self._excused)) is not None:
            self._blame(
                ControllerError(
                    f"{self._address}: the arm was stopped, as nobody could watch it: {reason}; check the link, then "
                    "run the command again"
                )
            )

    def _judge(self, block: SampleBlock) -> bool:
        """Judge a block; whether it belongs into the log."""
        if (broken := self._defect(block)) is not None:
            self._blame(
                ControllerError(
                    f"{self._address}: the arm was stopped: the controller {broken}; look for the fault there, then "
                    "run the command again"
                )
            )
            return False
        self._began = float(block.time[0]) if self._began is None else self._began
        if self._fault is None:
            reason = self._overdue(block, self._began) or self._adherence.take(block)
            if reason is not None:
                self._blame(SafetyError(f"{self._address}: the arm was stopped: {reason}"))
        self._note(block)
        return True

    def _note(self, block: SampleBlock) -> None:
        self._now, self._last = float(block.time[-1]), int(block.sequence[-1])
        self.stopping.take(block)
        self._freshness.judged(self._now)

    def _defect(self, block: SampleBlock) -> str | None:
        """Reason why a block cannot be judged or recorded as samples of this arm; None if it can."""
        joints = self._robot.dof
        arrays = [values for values in vars(block).values() if isinstance(values, np.ndarray) and values.ndim != 1]
        for values in arrays:
            if values.shape != (len(block.time), joints):
                return f"sent samples of {values.shape[-1]} joints, {self._robot.name} has {joints}"
        back = np.diff(block.time, prepend=self._now)
        if not np.all(back >= 0.0):
            return f"set its clock back by {-back.min():.3g} s while the arm moved"
        return None

    def _blame(self, fault: AgentError) -> None:
        """Stop the arm for this reason; the first one counts."""
        with self._lock:
            self._fault = self._fault or fault
        self.stopping.request()

    def _finish(self, dropped: Exception | None) -> None:
        if self.stopping.since is not None:
            self.stopping.finish(failed=not (dropped is None or isinstance(dropped, MotionStopped)))

    def _raise_fault(self, dropped: DriverError | None) -> None:
        """Why the motion did not end as planned, if it did not."""
        fault = self._fault
        known = isinstance(fault, SafetyError) and not isinstance(dropped, MotionStopped)
        if dropped is not None and not (known or self.stopping.failure):
            raise dropped
        if fault is None and (reason := self._adherence.judge() or self._early_end(self._last)) is not None:
            fault = SafetyError(f"{self._address}: {reason}")
        if self.stopping.disobeyed:
            raise SafetyError(f"{fault or self._address}; {self.stopping.failure}")
        if fault is not None:
            raise type(fault)(f"{fault}; {self.stopping.failure}" if self.stopping.failure else str(fault))

    def _overdue(self, block: SampleBlock, began: float) -> str | None:
        """Why to stop, where the motion has lasted too long: by the stamps of its samples, or by their number."""
        lasted = max(float(block.time[-1]) - began, float(block.sequence[-1]) * self._period)
        if lasted <= self._longest:
            return None
        return (
            f"the motion has lasted {lasted:.0f} s, its plan takes {self._longest:.0f} s at most, stops and all: look "
            "at the program that runs there, then run the command again"
        )

    def _early_end(self, last: int) -> str | None:
        """What is wrong with a motion that has ended by itself before its plan, with sample number `last`.

        What came after that may be lost; then the arm has to stand at the end of the plan.
        """
        remaining = 0.0 if self.stopped else self._adherence.remaining_time
        if remaining <= EARLY_END_TOLERANCE:
            return None
        lost = self._period * sum(gap.count for gap in self._driver.gaps if gap.first > last)
        if remaining <= EARLY_END_TOLERANCE + lost and self._adherence.ends_at(self._driver.status().position):
            return None
        return (
            f"the controller says that the motion is over, {remaining:.1f} s before the end of its plan: look at the "
            "program and at the messages there, then run the command again"
        )

    def _read_temperatures(self, now: float, interval: float = TEMPERATURE_INTERVAL) -> None:
        """Ask for temperatures where that was not done within the interval [s] of controller time `now`."""
        if not isinstance(self._driver, ReportsTemperatures):
            return
        if not self.temperatures or not now - self.temperatures[-1][0] <= interval:
            values = self._driver.temperatures()
            if values is not None:
                self.temperatures.append((now, values))

    def read_settings(self, now: float) -> None:
        """Tell what was set anew at the controller since the last time: no position shows it.

        Raises:
            DriverError: the link failed.
        """
        if not isinstance(self._driver, ReportsSettings):
            return
        settings = self._driver.settings()
        for name, text in settings.items():
            before = self._settings.get(name, text)
            if text != before:
                self.changes.append((now, name, before, text))
                self._warn(
                    f"{self._address}: the {name} was set anew at the controller in motion, from {before} to {text}; "
                    "the log notes it"
                )
        self._settings = settings

    def _look_at_state(self) -> None:
        """Ask for the state in a thread of its own, one question at a time; raises what the last question raised."""
        if self._asked.done():
            self._asked.result()
            self._asked = run_in_thread("state", self._judge_state, self._now)
            wait([self._asked], STATUS_WAIT)

    def _judge_state(self, now: float) -> None:
        try:
            status: Status = self._driver.status()
            self._read_temperatures(now)
            self.read_settings(now)
        except DriverError as error:
            if self.stopping.since is not None:  # the link may have been closed by now: no reason for that stop
                return
            self._blame(
                ControllerError(
                    f"{self._address}: the controller's state cannot be read any more while the arm moves, so it was "
                    f"stopped: {error}; check the link, then run the command again"
                )
            )
            return
        reason = unsafe_in_motion(status)
        if reason is not None:
            self._blame(SafetyError(f"{self._address}: the arm was stopped: {reason}"))
