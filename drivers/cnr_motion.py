"""One motion on the link of CNR's programs: which samples belong to it, and when and why it ended."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.cnr_clock import ClockMatch
from drivers.errors import DriverError
from drivers.motion import Motion
from drivers.protocol import SampleBlock
from drivers.wire.cnr import Feedback, Mode, Status
from drivers.wire.reasons import EndReason

#: Rest that is kept before the set-points begin to change [s].
_BEFORE = 0.1
#: Set-points that change by less rest [rad, or m].
_STILL = np.radians(1e-4)
#: An arm that rests is seen to rest within this [rad, or m].
_REST = np.radians(0.02)
#: Without a flag that says so, an arm is moving until it has rested for so long [s].
_RESTING = 0.2
#: So many feedbacks in a row say that the arm rests before a stop by the controller is believed.
_BELIEVED = 10
#: A program that a person started is over when the arm has rested for so long [s]; a DELAY in it must be shorter.
HAND_REST = 2.0
#: Samples of the end that do not come within this [s] of silence do not come any more.
_DRAIN = 1.0
_TURN = 0.05  # s: no turn counts for more, so that a stall of this process is nobody's silence

#: Positions, velocities, target positions, target velocities, currents: as `wire.CHANNELS` has them.
_POSITION, _VELOCITY, _TARGET, _TARGET_VELOCITY, _CURRENT = range(5)


@dataclass(frozen=True, eq=False)
class Arm:
    """What the driver knows of the arm: joints n, sampling period [s], and torque per ampere (n, n) [N·m/A]."""

    joints: int
    period: float
    torque_per_ampere: np.ndarray


class CnrMotion:
    """What came of one motion; called from the reader thread of the sockets, but for what is said otherwise.

    Args:
        arm: see there.
        limit: bytes that may wait for the consumer.
        broker: whether samples come from the broker; from the feedbacks otherwise.
        is_over: whether a feedback says that the motion has run to its end; None where only rest can tell.
        patience: s without a sample before the source is taken for dead.
        silent: names what the broker lacks, for the message.
    """

    def __init__(
        self,
        arm: Arm,
        limit: int,
        broker: bool,
        is_over: Callable[[Feedback], bool] | None,
        patience: float,
        silent: Callable[[], str],
    ) -> None:
        self.motion = Motion(limit)
        self.started = False  # set by the driver when the controller has said so
        self.match = ClockMatch() if broker else None
        self.begun_at: float | None = None  # sample time [s] of the first change of the set-points
        self._arm = arm
        self._is_over = is_over
        self._patience = patience
        self._silent = silent
        self._moved = False
        self._quiet = 0
        self._rest: tuple[float, np.ndarray] | None = None  # since when the arm rests, and where
        self._before: list[tuple[np.ndarray, np.ndarray]] = []
        self._target: np.ndarray | None = None
        self._sequence = 0
        self._latest: float | None = None
        self._silence = 0.0
        self._turned = time.monotonic()
        self._end: tuple[EndReason, str] | None = None
        self._end_time = 0.0  # controller time [s]
        self._drained = 0.0

    @property
    def begun(self) -> bool:
        """Whether the arm was seen to move."""
        return self._moved or self.begun_at is not None

    def feedbacks(self, feedbacks: list[Feedback], status: Status) -> None:
        """What the controller said of itself."""
        for feedback in feedbacks:
            now, position = feedback.time * 1e-3, np.radians(feedback.joints[: self._arm.joints])
            if self.match is not None:
                self.match.feedback(now, position)
            if self._end is not None:
                continue
            if self.match is None:
                self._from_feedback(feedback, now, position)
            self._judge(feedback, status, now, position)

    def samples(self, times_us: np.ndarray, values: np.ndarray) -> None:
        """What the broker had: times (K,) [µs], values (K, 5, 10) in degrees and amperes."""
        if len(times_us) == 0:
            return
        self._silence = 0.0
        times = times_us * 1e-6
        values = values[:, :, : self._arm.joints].copy()
        values[:, :_CURRENT] = np.radians(values[:, :_CURRENT])
        assert self.match is not None
        self.match.samples(times, values[:, _POSITION])
        if self.begun_at is None:
            times, values = self._wait_for_motion(times, values)
        self._give(times, values)

    def turn(self) -> DriverError | None:
        """Called all the time: ends the motion where it is over; returns what is wrong, if anything is."""
        now = time.monotonic()
        passed, self._turned = min(now - self._turned, _TURN), now
        if self.motion.over:
            return None
        self._silence += passed
        if self._end is not None:
            self._drained += passed
            if self.match is None or self._is_complete(self.match):
                reason, message = self._end
                self.motion.ended(reason, self._sequence, message)
        elif self.match is None or not self.started:
            self._silence = 0.0
        elif self._silence > self._patience:
            return DriverError(f"no whole sample for {self._patience:g} s while the arm may move: {self._silent()}")
        return None

    # What the controller says.

    def _judge(self, feedback: Feedback, status: Status, now: float, position: np.ndarray) -> None:
        """Is it over, and why?"""
        rested = self._rested(now, position)
        over = self._is_over is not None and self._is_over(feedback)
        if feedback.is_moving or (self._is_over is None and self.begun and rested < _RESTING):
            self._moved, self._quiet = True, 0
            return
        self._quiet += 1
        stopping = self.motion.stopping
        if not (self.started or stopping):
            return
        if over:
            self._over(EndReason.DONE, "", now)
        elif stopping:
            if self._quiet > 1:
                self._over(EndReason.STOPPED, "", now)
        elif (
            self._moved and self._quiet >= _BELIEVED and (self._is_over is not None or stop_reason(status) is not None)
        ):
            reason, message = stop_reason(status) or (
                EndReason.STOPPED,
                f"it rests after point {feedback.last_point_processed}, before the end; was it stopped by hand?",
            )
            self._over(reason, message, now)
        elif self._is_over is None and self.begun and rested > HAND_REST:
            self._over(EndReason.DONE, "", now)

    def _rested(self, now: float, position: np.ndarray) -> float:
        """For how long [s] the arm has rested."""
        if self._rest is None or np.abs(position - self._rest[1]).max() > _REST or now < self._rest[0]:
            if self._rest is not None and self._is_over is None and self.started:
                self._moved = True  # only the programs of the sockets keep `is_moving`; any program moves the arm
            self._rest = now, position
        return now - self._rest[0]

    def _over(self, reason: EndReason, message: str, now: float) -> None:
        self._end, self._end_time = (reason, message), now
        self._drained = 0.0

    def _is_complete(self, match: ClockMatch) -> bool:
        """Whether the samples up to the end have come, or will not come."""
        if self._silence > max(_DRAIN, self._patience):
            return True
        alignment = match.alignment()
        if alignment is None:  # nothing has moved, as far as one of the two can tell
            return self._drained > _DRAIN
        return self._seen >= alignment.sample_time(self._end_time)

    # Samples.

    @property
    def _seen(self) -> float:
        return -np.inf if self._latest is None else self._latest

    def _wait_for_motion(self, times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nothing while the set-points rest; with their first change, all of it and a little of the rest before."""
        targets = values[:, _TARGET]
        before = targets[:1] if self._target is None else self._target[None, :]
        steps = np.abs(np.diff(np.concatenate([before, targets]), axis=0)).max(axis=1)
        self._target = targets[-1]
        self._before.append((times, values))
        changed = np.flatnonzero(steps > _STILL)
        if len(changed) == 0:
            while len(self._before) > 1 and self._before[1][0][0] < times[-1] - _BEFORE:
                del self._before[0]
            return times[:0], values[:0]
        start = len(times) - int(changed[0])
        times = np.concatenate([t for t, _ in self._before])
        values = np.concatenate([v for _, v in self._before])
        self._before = []
        self.begun_at = float(times[len(times) - start])
        holes = np.flatnonzero(np.diff(times[: len(times) - start + 1]) > 1.5 * self._arm.period)
        first = max(int(np.searchsorted(times, self.begun_at - _BEFORE)), int(holes[-1]) + 1 if len(holes) else 0)
        return times[first:], values[first:]

    def _give(self, times: np.ndarray, values: np.ndarray) -> None:
        if self._end is not None:
            times, values = self._before_the_end(times, values)
        if len(times) == 0:
            return
        last = times[0] - self._arm.period if self._latest is None else self._latest
        steps = np.maximum(1, np.rint(np.diff(times, prepend=last) / self._arm.period)).astype(int)
        sequence = self._sequence - 1 + np.cumsum(steps)
        self._sequence, self._latest = int(sequence[-1]) + 1, float(times[-1])
        cuts = [0, *np.flatnonzero(steps[1:] > 1) + 1, len(times)]
        for start, stop in itertools.pairwise(cuts):
            part = values[start:stop]
            self._take(
                SampleBlock(
                    sequence=sequence[start:stop],
                    time=times[start:stop],
                    position=part[:, _POSITION],
                    velocity=part[:, _VELOCITY],
                    torque=part[:, _CURRENT] @ self._arm.torque_per_ampere.T,
                    reference_position=part[:, _TARGET],
                    reference_velocity=part[:, _TARGET_VELOCITY],
                    received=time.time(),
                    current=part[:, _CURRENT],
                )
            )

    def _before_the_end(self, times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Without what came after the arm rested; the first sample after it is kept, it says that all are there."""
        assert self.match is not None
        alignment = self.match.alignment()
        if alignment is None:
            return times, values
        end = alignment.sample_time(self._end_time)
        count = int(np.searchsorted(times, end)) + 1 if self._seen < end else 0
        return times[:count], values[:count]

    def _from_feedback(self, feedback: Feedback, now: float, position: np.ndarray) -> None:
        current = np.array([feedback.currents[: self._arm.joints]])
        self._take(
            SampleBlock(
                sequence=np.array([self._sequence]),
                time=np.array([now]),
                position=position[None, :],
                velocity=None,
                torque=current @ self._arm.torque_per_ampere.T,
                reference_position=None,
                reference_velocity=None,
                received=time.time(),
                current=current,
            )
        )
        self._sequence += 1

    def _take(self, block: SampleBlock) -> None:
        first = int(block.sequence[0])
        if first > self.motion.sequencer.expected:
            self.motion.lost(first)
        self.motion.take(block, 0)


def stop_reason(status: Status) -> tuple[EndReason, str] | None:
    """Why the controller would have stopped the arm, by its status; None where that says nothing."""
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
