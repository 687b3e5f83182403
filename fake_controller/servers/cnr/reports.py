"""Reports of the socket programs and the C5G Open node about the arm, stationary or moving, and who answers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.wire.cnr import AXES, Feedback, Mode, StatusMessage
from drivers.wire.reasons import EndReason
from fake_controller.controller import PERIOD, Controller
from fake_controller.execution import Slice
from fake_controller.servers.base import IDLE_LIMIT
from fake_controller.servers.cnr.node import JointPublisher
from fake_controller.servers.cnr.sockets import LockStep

TICK = 0.02  # s between two records of a stationary arm
PROGRAM_ERROR = 2  # error code of a program that could not be run, or not to its end
_PERIOD_NS = round(PERIOD * 1e9)
_EVERY = round(TICK / PERIOD)  # samples from one feedback record to the next
_REST = 250  # stationary samples before and after a motion if the clock does not wait; limit of samples made up for
_LATE = 3  # ticks without a record of a moving arm after which the last one is published again


class Reports:
    """Publishes every sample and sends the records of both lock-step ports, in a thread of its own while the arm rests.

    While the arm is stationary, the last sample is repeated instead of simulated.

    Args:
        controller: whose arm it is.
        feedback, status: the two ports.
        publisher: of the samples.
        cut: ends the connections of a client that is gone.
        watchdog: a moving arm stops if no feedback was answered for this time [s].
        waits: the arm waits for its clients, and time does not wait for the wall.
    """

    def __init__(
        self,
        controller: Controller,
        feedback: LockStep,
        status: LockStep,
        publisher: JointPublisher,
        cut: Callable[[], None],
        watchdog: float,
        waits: bool,
    ) -> None:
        self.moving = self.program_error = self._by_hand = False
        self.last_point = 0
        self.silence = 0.0  # s since feedback was answered
        self._controller, self._feedback, self._status, self._publisher = controller, feedback, status, publisher
        self._cut, self._watchdog, self._waits = cut, watchdog, waits
        self._finished = 0  # last point once the program has run to its end
        self._next_sample = 0
        self._counted_from = 0  # ns; where times were counted from since the counters were reset
        self._index = controller.clock.now() // _PERIOD_NS  # of the last sample, on the grid of the period
        still = np.zeros((1, controller.robot.dof))
        self._last = Slice(controller.position[None], still, controller.torque[None], controller.reference[None], still)
        self._offered: Feedback | None = None  # the record that was offered last
        self._offered_at = 0.0  # s, monotonic
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._telling = threading.Lock()  # records go out in the order in which they were true
        self._thread = threading.Thread(target=self._rest, name="reports", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Say nothing more."""
        self._closing.set()
        self._thread.join(5.0)

    @property
    def flag(self) -> bool:
        """Flag of the records for a moving arm."""
        return self.moving and not self._by_hand

    def begin(self, last_point: int, by_hand: bool = False) -> None:
        """The arm is about to move; `last_point` is what is published once its program has run to the end.

        Of a motion that somebody started by hand the socket programs know nothing.
        """
        with self._lock:
            self.moving, self.program_error, self._by_hand = True, False, by_hand
            self.last_point, self._finished = 0, last_point
            self.silence, self._next_sample = 0.0, 0
            self._pass_time()

    # Listener: in the motion's thread.

    def on_samples(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Publish what the arm just did, and tell where it is."""
        if first < self._next_sample:
            self._counted_from, self.last_point = int(time_ns[0]), 0
        self._next_sample = first + len(samples)
        with self._lock:
            index = max(self._index + 1, round(int(time_ns[0]) / _PERIOD_NS))
            self._repeat_until(index - 1)
            self._publish(index, samples, spare=False)
            self._last = _last_of(samples)
        for k in range(_EVERY - 1, len(samples), _EVERY):
            with self._telling:
                self._tell(time_ns[k], samples.position[k], samples.torque[k])
            if self._waits and self.silence < self._watchdog:
                self._feedback.wait(self._watchdog)

    def on_end(self, reason: EndReason, samples: int, message: str) -> None:
        """Tell that the arm rests."""
        with self._lock:
            self._pass_time()
            self.program_error = reason is EndReason.PROGRAM_ERROR
            if reason is EndReason.DONE:
                self.last_point = self._finished
            self.moving = False

    # At rest.

    def _rest(self) -> None:
        answers = 0
        while not self._closing.wait(TICK):
            heard, answers = self._feedback.answers != answers, self._feedback.answers
            # A stall of this process is not the client's silence: no turn counts for more than it should last.
            self.silence = self.silence + TICK if self._feedback.unanswered and not heard else 0.0
            self._status.offer(self._state(), spare=True)
            if self.moving:
                if self.silence >= self._watchdog:
                    silent = f"no feedback was answered for {self._watchdog * 1000:.0f} ms"
                    self._controller.stop(EndReason.WATCHDOG, silent)
                self._tell_again()
                continue
            if self.silence >= IDLE_LIMIT:
                self.silence = 0.0
                self._cut()
            with self._lock:
                if not self.moving:
                    self._pass_time(_EVERY)
            with self._telling:
                if not self.moving:
                    self._tell(self._controller.clock.now(), self._controller.position, self._last.torque[0])

    def _pass_time(self, samples: int = _REST) -> None:
        """Keep the arm stationary until now, or for a number of samples if the clock does not run by itself."""
        clock = self._controller.clock
        if self._waits:
            clock.wait_until((self._index + samples) * _PERIOD_NS)
        self._repeat_until(clock.now() // _PERIOD_NS)

    def _repeat_until(self, index: int) -> None:
        count = min(index - self._index, _REST)
        if count > 0:
            still = Slice(*(np.repeat(values, count, axis=0) for values in self._last.columns))
            self._publish(index - count + 1, still, spare=True)

    def _publish(self, index: int, samples: Slice, spare: bool) -> None:
        times = (index + np.arange(len(samples), dtype=np.int64)) * _PERIOD_NS - self._counted_from
        self._publisher.publish(times, samples, spare)
        self._index = index + len(samples) - 1

    def _tell(self, time_ns: int, position: np.ndarray, torque: np.ndarray) -> None:
        base, user, tool = self._controller.frames
        record = Feedback(
            arm=1,
            base=base,
            user=user,
            tool=tool,
            joints=_ten(np.degrees(position)),
            currents=_ten(self._publisher.currents(torque)),
            cartesian=self._controller.tool_point(position),
            last_point_processed=self.last_point,
            time=(int(time_ns) - self._counted_from) // 1_000_000,
            is_moving=int(self.flag),
        )
        self._offered, self._offered_at = record, time.monotonic()
        self._feedback.offer(record, spare=not self.moving)

    def _tell_again(self) -> None:
        """The feedback program does not wait for an arm whose next moves are still planned."""
        with self._telling:
            if self._offered is not None and time.monotonic() - self._offered_at > _LATE * TICK:
                record = replace(self._offered, is_moving=int(self.flag), last_point_processed=self.last_point)
                self._feedback.offer(record, spare=True)

    def _state(self) -> StatusMessage:
        state = self._controller.state
        in_error = bool(state.alarms) or self.program_error
        auto = state.mode == "auto"
        return StatusMessage(
            drives_powered=int(state.drives_on),
            e_stopped=int(state.emergency_stop),
            error_code=_code(state.alarms[0]) if state.alarms else PROGRAM_ERROR * int(self.program_error),
            in_error=int(in_error),
            in_motion=int(self.flag),
            mode=Mode.AUTO if auto else Mode.MANUAL,
            motion_possible=int(state.drives_on and auto and state.cell_closed and not in_error),
        )


def _code(alarm: str) -> int:
    """The number that leads an alarm's text; 1 where none does."""
    word = alarm.split(maxsplit=1)[0] if alarm.strip() else ""
    return int(word) if word.isascii() and word.isdigit() and len(word) < 10 else 1


def _ten(values: np.ndarray) -> tuple[float, ...]:
    return (*values.tolist(), *[0.0] * (AXES - len(values)))


def _last_of(samples: Slice) -> Slice:
    """Its last sample, with the arm stationary."""
    last = samples.part(slice(-1, None))
    return replace(last, velocity=np.zeros_like(last.velocity), reference_velocity=np.zeros_like(last.velocity))
