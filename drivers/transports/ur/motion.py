"""One motion of a UR program: which samples belong to it, and when and why it ended."""

from __future__ import annotations

import time

import numpy as np

from drivers.errors import DriverError, MotionStopped
from drivers.protocol import SampleBlock
from drivers.transports.base.samples import SampleStream
from drivers.wire import ur_rtde as rtde
from drivers.wire.reasons import EndReason
from drivers.wire.ur_primary import ProgramChange, ProgramFault

#: `runtime_state`, `robot_mode` and `safety_mode` of a robot that is well.
STOPPED, PLAYING, RUNNING, NORMAL = 1, 2, 7, 1
SAFEGUARD = 5
EMERGENCY_STOPS = (6, 7)
_SAFETY = (
    "NORMAL",
    "REDUCED",
    "PROTECTIVE_STOP",
    "RECOVERY",
    "SAFEGUARD_STOP",
    "SYSTEM_EMERGENCY_STOP",
    "ROBOT_EMERGENCY_STOP",
    "VIOLATION",
    "FAULT",
)
#: A second with less than this part of its samples is recorded by a controller that skips most of them: the next slower
#: rate of RTDE is a half.
_ENOUGH = 0.75
#: A set-point that changes more slowly rests [rad/s]; settling time of the arm [s].
STILL, _SETTLED = 1e-6, 0.1


def safety_text(mode: int) -> str:
    """The controller's word for a safety mode."""
    return _SAFETY[mode - 1] if 1 <= mode <= len(_SAFETY) else f"safety mode {mode}"


class UrMotion(SampleStream):
    """Received data of one motion. Called from the thread of the link.

    Args:
        program: its name on the controller.
        period: of samples [s].
        torque_per_ampere: (n, n) [N·m/A].
        limit: bytes that may wait for the consumer.
    """

    def __init__(self, program: str, period: float, torque_per_ampere: np.ndarray, limit: int) -> None:
        super().__init__(limit)
        self.begun = False  # the next sample is the first of the motion, or one after it
        self.permitted = False  # the program may move
        self.loaded = False  # the controller says that the program has started; it waits for its permit
        self.withheld = False  # the heartbeat, as the arm did not obey
        self.fault: ProgramFault | None = None
        self.markers: list[float] = []  # controller time [s] at which cycles began
        self._program = program
        self._period = period
        self._torque_per_ampere = torque_per_ampere
        self._error_text = ""  # the controller's last error text
        self._first: float | None = None
        self._number = -1
        self._second = (0, 0)  # number and count of samples when it began
        self._count = 0
        self.slow: DriverError | None = None  # that most samples are missing, once they are
        self.foreign: DriverError | None = None  # that another program moves the arm, once one does
        self._cycle: int | None = None
        self._idle = 0
        self._verdict: tuple[EndReason, str] | None = None

    def message(self, message: ProgramChange | ProgramFault) -> None:
        """Take the controller's text about the program."""
        if isinstance(message, ProgramChange):
            if self.loaded and message.started and not self.stopping:
                self.foreign = self.foreign or MotionStopped(
                    f"program {message.name} was started at the controller and replaced the one that was sent, so the "
                    "arm was stopped: find out who sent it"
                )
            self.loaded = self.loaded or (message.started and message.name == self._program)
        else:
            self._error_text = str(message)
            self.fault = message if message.fatal and self.fault is None else self.fault

    def samples(self, samples: np.ndarray) -> None:
        """Samples (K,) of `rtde.FIELDS`, in the order in which they came."""
        if not self.begun or self.over:
            return
        self._first = float(samples["timestamp"][0]) if self._first is None else self._first
        numbers = np.rint((samples["timestamp"] - self._first) / self._period).astype(np.int64)
        new = numbers > np.maximum.accumulate(
            np.concatenate(([self._number], numbers[:-1]))
        )  # repeated stamps are dropped
        samples, numbers = samples[new], numbers[new]
        if len(samples) == 0:
            return
        self._verdict = self._verdict or _unsafe(samples[-1])  # the first one counts
        if not (self.permitted or self.stopping) and np.abs(samples["target_qd"]).max() >= STILL:
            self.foreign = self.foreign or MotionStopped(
                "the arm moved before the program that was sent was allowed to, so it was stopped: find out which "
                "program runs there"
            )
        still = (samples["runtime_state"] != PLAYING) & np.all(np.abs(samples["target_qd"]) < STILL, axis=1)
        runs = np.arange(1, len(still) + 1) - np.maximum.accumulate(np.where(still, 0, np.arange(1, len(still) + 1)))
        runs = np.where(np.cumsum(~still) == 0, runs + self._idle, runs)
        ending = self.permitted or self.stopping  # before, the controller only gets ready
        settled = np.flatnonzero(runs * self._period >= _SETTLED) if ending else np.empty(0, dtype=int)
        last = int(settled[0]) + 1 if len(settled) else len(samples)
        self._idle = int(runs[last - 1])
        self._give(samples[:last], numbers[:last])
        if len(settled) and self.foreign is not None:
            self.finish(self.foreign)
        elif len(settled):
            reason, text = self._verdict or (EndReason.STOPPED if self.stopping else EndReason.DONE, "")
            if self.fault is not None and reason is EndReason.DONE:
                reason = EndReason.PROGRAM_ERROR
            self.ended(reason, self._number + 1, "; ".join(part for part in (self._error_text, text) if part))

    @property
    def unsafe(self) -> bool:
        """Whether the controller has interrupted the motion, so that the program is to be ended for good."""
        return self._verdict is not None

    def _give(self, samples: np.ndarray, numbers: np.ndarray) -> None:
        """Deliver runs without gaps; missing samples never come, because RTDE sends nothing twice."""
        cycles = samples[rtde.CYCLE]
        changed = np.flatnonzero(np.diff(cycles, prepend=cycles[0] if self._cycle is None else self._cycle))
        self.markers += samples["timestamp"][changed[cycles[changed] >= 0]].tolist()
        self._cycle = int(cycles[-1])
        received = time.time()
        for part in np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers) > 1) + 1):
            chosen = samples[part]
            self.lost(int(numbers[part[0]]))
            current = chosen["actual_current"].astype(float)
            self.take(
                SampleBlock(
                    numbers[part],
                    chosen["timestamp"].astype(float),
                    chosen["actual_q"].astype(float),
                    chosen["actual_qd"].astype(float),
                    current @ self._torque_per_ampere.T,
                    chosen["target_q"].astype(float),
                    chosen["target_qd"].astype(float),
                    received,
                    current,
                )
            )
        self._number, self._count = int(numbers[-1]), self._count + len(numbers)
        passed, came = self._number - self._second[0], self._count - self._second[1]
        if passed * self._period >= 1.0:
            self._second = self._number, self._count
            if came < _ENOUGH * passed:
                self.slow = DriverError(
                    f"the controller sent {came} of the last {passed} samples; the motion was stopped: is another "
                    "client of RTDE there, or has the controller too much else to do?"
                )


def _unsafe(sample: np.void) -> tuple[EndReason, str] | None:
    """Why an arm in motion is being stopped by the controller."""
    safety, state = int(sample["safety_mode"]), int(sample["runtime_state"])
    if safety in EMERGENCY_STOPS:
        return EndReason.EMERGENCY_STOP, f"{safety_text(safety)}: release it, then power the arm on"
    if safety != NORMAL:
        return (
            EndReason.PROTECTIVE_STOP,
            f"{safety_text(safety)}: look for the cause, then unlock it at the pendant",
        )
    if int(sample["robot_mode"]) != RUNNING:
        return EndReason.DRIVE_FAULT, f"robot mode {int(sample['robot_mode'])}, and 7 (running) is expected"
    if state in (3, 4):
        return EndReason.STOPPED, "the program was paused"
    return None
