"""The watch over an arm in motion: its samples, its state, its temperatures, and how long it may take."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np

from agent.core import AgentError, ControllerError, SafetyError
from agent.safety.adherence import Adherence
from agent.safety.background_poll import BackgroundPoll
from agent.safety.patience import Patience
from agent.safety.preconditions import unsafe_in_motion
from drivers.errors import DriverError, MotionStopped
from drivers.protocol import Driver, ReportsTemperatures, SampleBlock, Status

#: The controller's state is looked at so often while the arm moves [s], of its time and of ours.
WATCH_INTERVAL = 0.2
#: No sample for so long [s] while the arm may move: nobody watches it then.
SILENCE = 10.0
#: A motion may end so long [s] before its plan, where it does not wait for the arm to arrive.
EARLY = 0.25
#: Motors warm up slowly: their temperatures are asked for so often [s].
TEMPERATURE_INTERVAL = 5.0


class MotionWatch:
    """Hands out the samples of one motion, and stops the arm where something is not as it must be.

    Args:
        driver: the motion's.
        address: for messages.
        period: of samples [s].
        adherence: whether the arm does what was planned.
        longest: the motion may last so long [s], of controller time.
        clock: seconds.
        stop: asks for a stop.
    """

    def __init__(
        self,
        driver: Driver,
        address: str,
        period: float,
        adherence: Adherence,
        longest: float,
        clock: Callable[[], float],
        stop: Callable[[], object],
    ) -> None:
        self._driver = driver
        self._address = address
        self._period = period
        self._adherence = adherence
        self._longest = longest
        self._clock = clock
        self._stop = stop
        #: The end was asked for, so it comes before that of the plan.
        self.stopped = False
        #: (controller time [s], (n,) [°C]), where the controller measures temperatures.
        self.temperatures: list[tuple[float, np.ndarray]] = []

    def samples(self) -> Iterator[SampleBlock]:
        """The samples, with a look at the controller's state now and then; what is left after a stop comes too.

        Raises:
            SafetyError: why the arm was stopped.
            ControllerError: the state cannot be read any more.
            DriverError: the link failed, or the controller ended the motion.
        """
        fault: AgentError | None = None
        began: float | None = None
        patience = Patience(SILENCE, self._clock, self._stop)
        looked, looked_at = -np.inf, self._clock()
        now, last = np.nan, -1
        polling = BackgroundPoll(self._poll_status, self._stop)
        try:
            for block in patience.each(self._driver.samples()):
                began = float(block.time[0]) if began is None else began
                fault = fault or polling.found
                reason = self._overdue(block, began) or self._adherence.take(block) if fault is None else None
                if reason is not None:
                    fault = SafetyError(f"{self._address}: the arm was stopped: {reason}")
                    self._stop()
                yield block
                now, last = float(block.time[-1]), int(block.sequence[-1])
                recently = now - looked < WATCH_INTERVAL and self._clock() - looked_at < WATCH_INTERVAL
                if not recently:
                    polling.poll(now)
                    looked, looked_at = now, self._clock()
            fault = fault or polling.result()
        except DriverError as error:
            fault = fault or polling.result()
            if not patience.lost and (not isinstance(fault, SafetyError) or isinstance(error, MotionStopped)):
                raise
        if patience.lost and fault is None:
            fault = SafetyError(
                f"{self._address}: the arm was stopped: no sample came for {SILENCE:g} s while it may have moved; "
                "check the link, then run the command again"
            )
        if fault is None and (reason := self._adherence.judge() or self._early(last)) is not None:
            fault = SafetyError(f"{self._address}: {reason}")
        if fault is not None:
            raise fault
        with suppress(DriverError):  # the motion is over and recorded
            self._read_temperatures(now, 0.0)

    def _overdue(self, block: SampleBlock, began: float) -> str | None:
        """Why to stop, where the motion has lasted too long: by the stamps of its samples, or by their number."""
        lasted = max(float(block.time[-1]) - began, float(block.sequence[-1]) * self._period)
        if lasted <= self._longest:
            return None
        return (
            f"the motion has lasted {lasted:.0f} s, its plan takes {self._longest:.0f} s at most, stops and all: look "
            "at the program that runs there, then run the command again"
        )

    def _early(self, last: int) -> str | None:
        """What is wrong with a motion that has ended by itself before its plan, with sample number `last`.

        What came after that may be lost; then the arm has to stand at the end of the plan.
        """
        left = 0.0 if self.stopped else self._adherence.left
        if left <= EARLY:
            return None
        lost = self._period * sum(gap.count for gap in self._driver.gaps if gap.first > last)
        if left <= EARLY + lost and self._adherence.ends_at(self._driver.status().position):
            return None
        return (
            f"the controller says that the motion is over, {left:.1f} s before the end of its plan: look at the "
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

    def _poll_status(self, now: float) -> AgentError | None:
        try:
            status: Status = self._driver.status()
            self._read_temperatures(now)
        except DriverError as error:
            return ControllerError(
                f"{self._address}: the controller's state cannot be read any more while the arm moves, so it was "
                f"stopped: {error}; check the link, then run the command again"
            )
        reason = unsafe_in_motion(status)
        return None if reason is None else SafetyError(f"{self._address}: the arm was stopped: {reason}")
