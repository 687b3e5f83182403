"""One motion on the link of CNR's programs: which samples belong to it, and when and why it ended.

The controller's milliseconds and the samples' microseconds are two clocks. Both report the same joint positions. Where
the arm moves with velocity v, a feedback's position p(t) and the samples' q(t') agree at one offset o only: with
d = p(t) - q(t + o), the next o is o + <v, d> / <v, v> (Gauss-Newton for one unknown). Every feedback in motion gives
one such offset. The median of the newest is the offset of the clocks, so that their drift does not count.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.errors import DriverError
from drivers.protocol import SampleBlock
from drivers.transports.base.samples import SampleStream
from drivers.wire.cnr import Feedback, Mode, StatusMessage
from drivers.wire.reasons import EndReason

#: The arm has begun to move when a joint is so far from where it stood [rad, or m].
_MOVED = np.radians(0.02)
#: Lowest speed (norm over joints) at which a feedback gives the time [rad/s].
_FAST = 0.05
#: The beginnings of motion that both clocks saw agree within this [s].
_REACH = 0.08
#: Remaining difference of positions that shows a failed search [rad, or m].
_ASTRAY = np.radians(0.2)
_KEPT = 10.0  # s of samples
_BATCH = 10  # feedbacks
_NEWEST, _FEWEST = 50, 5  # estimates
#: The controller counts whole milliseconds [s]; its time lies anywhere in the one that has begun.
_RESOLUTION = 0.001


class ClockMatch:
    """Aligns the clocks during one motion, from its beginning on. Bounded memory."""

    def __init__(self) -> None:
        self._feedback = _Beginning()
        self._samples = _Beginning()
        self._pending: deque[tuple[float, np.ndarray]] = deque()
        self._times: deque[np.ndarray] = deque()
        self._positions: deque[np.ndarray] = deque()
        self._estimates: deque[float] = deque(maxlen=_NEWEST)

    @property
    def controller_moved_at(self) -> float | None:
        """Controller time [s] at which a feedback saw the arm begin to move; None before."""
        return self._feedback.time

    def feedback(self, time: float, position: np.ndarray) -> None:
        """Where the arm was (n,) at a controller time [s], in whole milliseconds."""
        time += _RESOLUTION / 2
        self._feedback.look(np.array([time]), position[None, :])
        self._pending.append((time, position))
        if len(self._pending) >= _BATCH:
            self._match()

    def samples(self, times: np.ndarray, positions: np.ndarray) -> None:
        """Where the arm was (K, n) at sample times (K,) [s]."""
        self._samples.look(times, positions)
        self._times.append(times)
        self._positions.append(positions)
        while len(self._times) > 1 and self._times[0][-1] < times[-1] - _KEPT:
            self._times.popleft()
            self._positions.popleft()

    def offset(self) -> float | None:
        """How far the samples' clock is ahead of the controller's now [s]; None before the arm has moved."""
        self._match()
        return self._coarse() if len(self._estimates) < _FEWEST else float(np.median(self._estimates))

    def _coarse(self) -> float | None:
        if self._feedback.time is None or self._samples.time is None:
            return None
        return self._samples.time - self._feedback.time

    def _match(self) -> None:
        coarse = self._coarse()
        if coarse is None or not self._times:
            while len(self._pending) > 50 * _KEPT:
                self._pending.popleft()
            return
        offset = float(np.median(self._estimates)) if self._estimates else coarse
        ready = []
        while self._pending and self._pending[0][0] + offset + 2 * _REACH < self._times[-1][-1]:
            ready.append(self._pending.popleft())
        if not ready:
            return
        times, positions = np.concatenate(self._times), np.concatenate(self._positions)
        when, where = np.array([t for t, _ in ready]), np.array([p for _, p in ready])
        first = max(0, int(np.searchsorted(times, when[0] + offset - 2 * _REACH)) - 1)
        self._estimates.extend(_offsets(times[first:], positions[first:], when, where, offset))


class _Beginning:
    """When the arm began to move."""

    def __init__(self) -> None:
        self.time: float | None = None
        self._rest: np.ndarray | None = None
        self._last: tuple[float, float] | None = None

    def look(self, times: np.ndarray, positions: np.ndarray) -> None:
        if self.time is not None or len(times) == 0:
            return
        if self._rest is None:
            self._rest = positions[0]
        distances = np.abs(positions - self._rest).max(axis=1)
        beyond = np.flatnonzero(distances > _MOVED)
        if len(beyond) == 0:
            self._last = (float(times[-1]), float(distances[-1]))
            return
        k = int(beyond[0])
        if k > 0:
            self._last = (float(times[k - 1]), float(distances[k - 1]))
        time, distance = float(times[k]), float(distances[k])
        if self._last is not None:
            # From rest the way grows with the square of time.
            before, last_distance = self._last
            part = (np.sqrt(_MOVED) - np.sqrt(last_distance)) / (np.sqrt(distance) - np.sqrt(last_distance))
            time = before + float(part) * (time - before)
        self.time = time


def _offsets(
    times: np.ndarray, positions: np.ndarray, when: np.ndarray, where: np.ndarray, start: float
) -> list[float]:
    """The offsets near `start` of the feedbacks (`when`, `where`) that tell one."""
    if len(times) < 3:
        return []
    velocities = np.gradient(positions, times, axis=0)
    offset = np.full(len(when), start)
    for _ in range(4):
        at = when + offset
        q = _interpolated(at, times, positions)
        v = _interpolated(at, times, velocities)
        speed = np.sum(v**2, axis=1)
        step = np.sum(v * (where - q), axis=1) / np.maximum(speed, _FAST**2)
        offset = np.clip(offset + step, start - _REACH, start + _REACH)
    inside = (when + offset > times[0]) & (when + offset < times[-1]) & (np.abs(offset - start) < 0.99 * _REACH)
    residual = np.abs(where - _interpolated(when + offset, times, positions)).max(axis=1)
    return [float(value) for value in offset[inside & (speed > _FAST**2) & (residual < _ASTRAY)]]


def _interpolated(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(at, times, column) for column in values.T])


#: Rest that is kept before the motion [s].
_BEFORE = 0.1
#: Periods without a sample in it that cut that rest off.
_HOLE = 4.5
#: Set-points that change by less rest [rad, or m].
_STILL = np.radians(1e-4)
#: An arm that rests is seen to rest within this [rad, or m].
_REST = np.radians(0.02)
#: Without a flag from the controller, an arm counts as moving until it has rested for this time [s].
_RESTING = 0.2
#: A clock that goes back by more [s] was reset.
_BACK = 0.1
#: Number of consecutive feedbacks of a stationary arm that confirm a stop by the controller.
_BELIEVED = 10
#: A program that a person started is over when the arm has rested for this time [s]; a DELAY in it must be shorter.
HAND_REST = 2.0
#: Samples of the end that do not come within this [s] of silence do not come any more.
_DRAIN = 1.0
_LONGEST_DRAIN = 5.0  # s
_TURN = 0.05  # s: longest counted turn, so that a stall of this process is not taken for silence

#: Of `wire.CHANNELS`, in their order.
_POSITION, _TARGET, _CURRENT = 0, 2, 4


@dataclass(frozen=True, eq=False)
class CnrArm:
    """Data of the arm for the driver: joints n, sampling period [s], and torque per ampere (n, n) [N·m/A]."""

    joints: int
    period: float
    torque_per_ampere: np.ndarray


class CnrMotion(SampleStream):
    """Received data of one motion, and the part that belongs to it.

    Called from the reader thread of the sockets, unless a method says otherwise.

    Parameters
    ----------
    arm : its joints, period and torque per ampere.
    limit : bytes that may wait for the consumer.
    is_over : whether a feedback says that the motion has run to its end; None where only rest can tell.
    patience : seconds without a sample before the source counts as dead.
    silent : names what the broker lacks, for the message; None where samples come from the feedbacks.
    """

    def __init__(
        self,
        arm: CnrArm,
        limit: int,
        is_over: Callable[[Feedback], bool] | None,
        patience: float,
        silent: Callable[[], str] | None,
    ) -> None:
        super().__init__(limit)
        self.started = False  # set by the driver when the controller has said so
        self.match = None if silent is None else ClockMatch()
        self.clock_reset = False  # a clock went back: a counter was reset, and no time can be trusted
        self.begun_at: float | None = None  # sample time [s] of the first change of the set-points
        self._arm = arm
        self._is_over = is_over
        self._patience = patience
        self._silent = silent
        self._moved = self._paused = False
        self._quiet = 0
        self._time = -np.inf  # controller time of the last feedback [s]
        self._rest: tuple[float, np.ndarray] | None = None  # since when the arm rests, and where
        self._before_motion: list[tuple[np.ndarray, np.ndarray]] = []  # rest before the motion
        self._giving = False
        self._seen = -np.inf  # sample time [s] of the last sample that came
        self._target: np.ndarray | None = None
        self._sequence = 0
        self._latest: float | None = None
        self._silence = 0.0
        self._turned = time.monotonic()
        self._verdict: tuple[EndReason, str] | None = None
        self._failure: DriverError | None = None
        self._end_time = 0.0  # controller time [s]
        self._drained = 0.0
        self._cut = False  # samples went back in time: later ones do not belong to this motion

    @property
    def begun(self) -> bool:
        """Whether the arm was seen to move."""
        return self._moved or self.begun_at is not None

    @property
    def failing(self) -> bool:
        """Whether it ends with an error."""
        return self._failure is not None

    def pause(self) -> None:
        """The arm rests by intention, until `resume` (from any thread)."""
        self._paused = True

    def resume(self) -> None:
        """The arm is about to move on."""
        self._moved, self._quiet, self._paused = False, 0, False

    def fail(self, error: DriverError) -> None:
        """The motion ends with this error, once the samples up to now are there (from any thread); the first counts."""
        if self._failure is None:
            self._failure, self._end_time, self._drained = error, self._time, 0.0

    def feedbacks(self, feedbacks: list[Feedback], status: StatusMessage) -> None:
        """Take a state of the controller."""
        for feedback in feedbacks:
            now, position = feedback.time * 1e-3, np.radians(feedback.joints[: self._arm.joints])
            self.clock_reset |= now < self._time - _BACK
            if self.clock_reset:
                return
            self._time = now
            if self.match is not None:
                self.match.feedback(now, position)
            if self._verdict is not None:
                continue
            if self.match is None:  # feedbacks are the samples
                current = np.array([feedback.currents[: self._arm.joints]])
                self._hand_on(np.array([self._sequence]), np.array([now]), position[None, :], current)
                self._sequence += 1
            self._judge(feedback, status, now, position)

    def samples(self, times_us: np.ndarray, values: np.ndarray) -> None:
        """Take messages of the broker: times (K,) [µs], values (K, 5, 10) in degrees and amperes."""
        times = times_us * 1e-6
        back = np.flatnonzero(np.diff(times, prepend=self._seen) < 0.0)
        if len(back):
            self.clock_reset = self._cut = True
            times, values = times[: back[0]], values[: back[0]]
        if len(times) == 0:
            return
        self._silence = 0.0
        values = values[:, :, : self._arm.joints].copy()
        values[:, :_CURRENT] = np.radians(values[:, :_CURRENT])
        assert self.match is not None
        self.match.samples(times, values[:, _POSITION])
        self._seen = float(times[-1])
        changed = self._changes(values[:, _TARGET])
        if self.begun_at is None and len(changed):
            self.begun_at = float(times[changed[0]])
        if not self._giving:
            self._before_motion.append((times, values))
            self._wait_for_motion()
        else:
            self._give(times, values)

    def poll(self) -> DriverError | None:
        """Called continuously: ends a motion that is over; returns an error for `fail`, if there is one."""
        now = time.monotonic()
        passed, self._turned = min(now - self._turned, _TURN), now
        if self.over:
            return None
        self._silence += passed
        self._drained += passed
        if self._failure is not None:
            self._finish_failed(self._failure)
            return None
        if self.clock_reset:
            return DriverError("a clock of the controller went back while the arm moved: it was restarted; look at it")
        if self._verdict is not None:
            return self._finish(*self._verdict)
        if self._silent is None or not self.started:
            self._silence = 0.0
        elif self._silence > self._patience:
            return DriverError(f"no whole sample for {self._patience:g} s while the arm may move: {self._silent()}")
        return None

    def _finish(self, reason: EndReason, message: str) -> DriverError | None:
        """End the motion once its samples are there; return an error if they will not come."""
        lacking = 0.0 if self.match is None else self._lacking(self.match)
        if lacking > 0.0:
            if self._silence <= max(_DRAIN, self._patience):
                return None
            if reason in (EndReason.DONE, EndReason.STOPPED):
                assert self._silent is not None
                return DriverError(f"the samples end {lacking:.1f} s before the motion did: {self._silent()}")
        self.ended(reason, self._sequence, message)
        return None

    def _finish_failed(self, error: DriverError) -> None:
        """End the motion with an error once its samples are there, or no more of them can come."""
        lacking = 0.0 if self.match is None or self._cut else self._lacking(self.match)
        if lacking <= 0.0 or self._silence > _DRAIN or self._drained > _LONGEST_DRAIN:
            self.finish(error)

    def _lacking(self, match: ClockMatch) -> float:
        """Seconds of samples up to the end that have not come."""
        offset = match.offset()
        if offset is not None:
            return max(0.0, self._end_time + offset - self._seen)
        moved = match.controller_moved_at
        if moved is not None and self.begun_at is None:
            return self._end_time - moved
        return max(0.0, _DRAIN - self._drained)  # neither of the two shows motion

    # State of the controller.

    def _judge(self, feedback: Feedback, status: StatusMessage, now: float, position: np.ndarray) -> None:
        """Is it over, and why?"""
        rested = self._rested(now, position)
        over = self._is_over is not None and self._is_over(feedback)
        if feedback.is_moving or (self._is_over is None and self.begun and rested < _RESTING):
            self._moved, self._quiet = True, 0
            return
        self._quiet += 1
        if self.stopping:
            # The flag falls as the arm begins to slow down, and rises some time after a start. A DELAY is no stop.
            if self._quiet >= _BELIEVED and rested >= (HAND_REST if self._is_over is None else _RESTING):
                self._over((EndReason.STOPPED, ""), now)
        elif over and self.started:
            self._over((EndReason.DONE, ""), now)
        elif self.started and self._moved and not self._paused and self._quiet >= _BELIEVED:
            self._account_for_rest(status, now, rested)

    def _account_for_rest(self, status: StatusMessage, now: float, rested: float) -> None:
        """The arm has moved and rests, and has not said that it is at the end."""
        reason = stop_reason(status)
        if self._is_over is not None or reason is not None:
            by_hand = EndReason.STOPPED, "it rests before the end of its motion; was it stopped by hand?"
            self._over(reason or by_hand, now)
        elif rested > HAND_REST:
            self._over((EndReason.DONE, ""), now)

    def _rested(self, now: float, position: np.ndarray) -> float:
        """Time [s] for which the arm has rested."""
        if self._rest is None or np.abs(position - self._rest[1]).max() > _REST or now < self._rest[0]:
            if self._rest is not None and self._is_over is None and self.started:
                self._moved = True  # only the programs of the sockets keep `is_moving`; any program moves the arm
            self._rest = now, position
        return now - self._rest[0]

    def _over(self, end: tuple[EndReason, str], now: float) -> None:
        self._verdict, self._end_time = end, now
        self._drained = 0.0

    # Samples.

    def _changes(self, targets: np.ndarray) -> np.ndarray:
        """At which of the next set-points (K, n) they change."""
        before = targets[:1] if self._target is None else self._target[None, :]
        self._target = targets[-1]
        return np.flatnonzero(np.abs(np.diff(np.concatenate([before, targets]), axis=0)).max(axis=1) > _STILL)

    def _wait_for_motion(self) -> None:
        """Keep a little rest until the motion is started; then it is a part of it, and everything is handed on.

        Where a person starts it, the set-points tell when.
        """
        latest = self._before_motion[-1][0]
        began = float(latest[0]) if self.begun_at is None else self.begun_at
        if self.begun_at is None and (self._is_over is None or not self.started):
            while len(self._before_motion) > 1 and self._before_motion[1][0][0] < latest[-1] - _BEFORE:
                del self._before_motion[0]
            return
        times = np.concatenate([times for times, _ in self._before_motion])
        values = np.concatenate([values for _, values in self._before_motion])
        self._before_motion, self._giving = [], True
        holes = np.flatnonzero(np.diff(times[times <= began]) > _HOLE * self._arm.period)
        first = max(int(np.searchsorted(times, began - _BEFORE)), int(holes[-1]) + 1 if len(holes) else 0)
        self._give(times[first:], values[first:])

    def _give(self, times: np.ndarray, values: np.ndarray) -> None:
        if len(times) == 0:
            return
        last = times[0] - self._arm.period if self._latest is None else self._latest
        steps = np.maximum(1, np.rint(np.diff(times, prepend=last) / self._arm.period)).astype(int)
        sequence = self._sequence - 1 + np.cumsum(steps)
        self._sequence, self._latest = int(sequence[-1]) + 1, float(times[-1])
        cuts = [0, *np.flatnonzero(steps[1:] > 1) + 1, len(times)]
        for start, stop in itertools.pairwise(cuts):
            position, velocity, target, target_velocity, current = np.moveaxis(values[start:stop], 1, 0)
            part = sequence[start:stop], times[start:stop]
            self._hand_on(*part, position, current, velocity, target, target_velocity)

    def _hand_on(
        self,
        sequence: np.ndarray,
        times: np.ndarray,
        position: np.ndarray,
        current: np.ndarray,
        velocity: np.ndarray | None = None,
        target: np.ndarray | None = None,
        target_velocity: np.ndarray | None = None,
    ) -> None:
        """Give samples to the consumer; missing samples before them are lost."""
        torque = current @ self._arm.torque_per_ampere.T
        block = SampleBlock(
            sequence, times, position, velocity, torque, target, target_velocity, received=time.time(), current=current
        )
        if int(sequence[0]) > self.sequencer.expected:
            self.lost(int(sequence[0]))
        self.take(block)


def stop_reason(status: StatusMessage) -> tuple[EndReason, str] | None:
    """Reason of the controller for a stop of the arm, by its status; None if the status names none."""
    if status.e_stopped == 1:
        return EndReason.EMERGENCY_STOP, "the emergency stop is pressed"
    if status.in_error == 1:
        return EndReason.ALARM, f"error {status.error_code} is active"
    if status.drives_powered == 0:
        return EndReason.DRIVE_FAULT, "the drives are off"
    if status.mode != Mode.AUTO:
        return EndReason.MODE_CHANGED, "the selector is not at auto any more"
    if status.motion_possible == 0:
        return EndReason.PROTECTIVE_STOP, "the cell is open"
    return None
