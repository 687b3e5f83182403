"""Faults of a shop floor on command: at the wire and at the machine.

A fault waits for its phase and acts once. Those of the wire sit between a server and its sockets: servers send every
frame through `Faults.send` and take what came through `Faults.heard`. Those of the machine are applied by the
controller. Neither knows which wire it is; each wire says what makes no sense on it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.wire.reasons import EndReason

#: When a fault strikes: at the greeting, upload of a program or start, after some time of motion, on a stop.
PHASES = ("connect", "upload", "start", "streaming", "stop")
_EVERY = frozenset(PHASES)

#: Faults of the wire, with the phases in which they make sense.
WIRE = {
    "refuse": frozenset({"connect"}),  # no server listens
    "silent": _EVERY,  # nothing is sent any more, heartbeats neither
    "drop": _EVERY,  # the connection ends in mid-frame
    "delay": _EVERY,  # by `value` seconds
    "reorder": _EVERY,  # a frame comes after the one behind it
    "duplicate": _EVERY,
    "corrupt": _EVERY,  # one byte
    "lost_client": _EVERY,  # nothing of what the client sends arrives
    "broker_gone": frozenset({"connect", "streaming"}),  # samples go by a broker, and none comes through any more
    "topic_missing": frozenset({"connect", "streaming"}),  # one of its topics is not published any more
    "queue_full": frozenset({"upload"}),  # of points; it stays full
    "sequence_error": frozenset({"upload"}),  # a point is taken for another than the next
}
#: Of these, those that go on until another client comes; a server asks whether they act.
LASTING = ("broker_gone", "topic_missing", "queue_full", "sequence_error")
#: Faults of the machine and its controller.
MACHINE = {
    "emergency_stop": _EVERY,
    "drive_fault": _EVERY,
    "alarm": _EVERY,
    "protective_stop": _EVERY,
    "teach_mode": _EVERY,
    "override": _EVERY,  # turned to `value`; the arm continues at that speed
    "restart": _EVERY,
    "reset_counters": frozenset({"streaming"}),
    "slow": frozenset({"streaming"}),  # everything takes `value` times as long
    "off_path": frozenset({"streaming"}),  # the set-points of a joint go off by `value` rad
    "off_speed": frozenset({"streaming"}),  # `value` times the planned speed, without a report
    "servo_error": frozenset({"streaming"}),  # a joint goes off its set-points by `value` rad
    "mute": frozenset({"streaming"}),  # samples stop, state and heartbeat go on
    "disobey": frozenset({"streaming"}),  # a stop on command is confirmed, but the arm continues
    "no_end": frozenset({"streaming"}),  # that the motion is over is never said
    "clock_back": frozenset({"streaming"}),  # stamps go back by `value` seconds
    "frozen": frozenset({"streaming"}),  # positions and set-points are told as they were; stamps and speeds run on
    "no_numbers": frozenset({"streaming"}),  # invalid torques
    "columns": frozenset({"start", "streaming"}),  # samples with one joint less
    "other_motion": frozenset({"start"}),  # a joint makes `value` times its way, under the name of the program
    "wrong_program": frozenset({"upload", "start"}),  # the stored text is another
    "wrong_robot": frozenset({"connect"}),
    "full_memory": frozenset({"upload"}),
    "untranslatable": frozenset({"upload"}),  # its translator does not take line `value`
}
FAULTS = {**WIRE, **MACHINE}
#: Faults of the samples only.
LIES = ("mute", "no_end", "clock_back", "frozen", "no_numbers", "columns")
_DEFAULT_VALUE = {
    "delay": 0.1,
    "override": 0.5,
    "slow": 3.0,
    "clock_back": 3600.0,
    "off_path": 0.3,
    "off_speed": 0.5,
    "servo_error": 0.3,
    "other_motion": 2.0,
    "untranslatable": 2.0,
}
_TOO_LONG = 60.0  # s; longer than anybody waits


@dataclass(frozen=True)
class Fault:
    """`name` out of `FAULTS`, striking in `phase`; while streaming, it strikes `after` this time of motion [s].

    `value`: seconds of a delay, the override as a fraction, how many times slower, or what the fault says; 0 takes the
    usual one. `joint`: which, counted from 1, where the fault is one joint's.

    Raises:
        ValueError: no such fault or phase, or a phase that makes no sense for it.
    """

    name: str
    phase: str
    after: float = 0.0
    value: float = 0.0
    joint: int = 1

    def __post_init__(self) -> None:
        if self.name not in FAULTS:
            raise ValueError(f"there is no fault {self.name!r}; there are {', '.join(FAULTS)}")
        if self.phase not in FAULTS[self.name]:
            fitting = [phase for phase in PHASES if phase in FAULTS[self.name]]
            raise ValueError(f"{self.name} strikes in phase {' or '.join(fitting)}, not in {self.phase!r}")

    @property
    def amount(self) -> float:
        """`value`, or the usual one."""
        return self.value or _DEFAULT_VALUE.get(self.name, 0.0)


def check_wire(faults: Iterable[Fault], wire: str, impossible: Mapping[str, str]) -> None:
    """Check that all faults make sense on a wire; `impossible` has those that do not, and why.

    Raises:
        ValueError: one does not.
    """
    for fault in faults:
        if fault.name in impossible:
            raise ValueError(f"{fault.name} makes no sense on {wire}: {impossible[fault.name]}")


class Faults:
    """Waiting faults, and the state of the wire. Thread-safe."""

    def __init__(self, faults: Sequence[Fault] = ()) -> None:
        self._lock = threading.Lock()
        self._waiting = list(faults)
        self._armed: list[Fault] = []
        self._delayed: bytes | None = None
        self._lasting: set[str] = set()
        self._silent = self._deaf = False

    @property
    def waiting(self) -> tuple[Fault, ...]:
        """Faults that have not struck yet."""
        return tuple(self._waiting)

    @property
    def refusing(self) -> bool:
        """Whether no server should listen."""
        return any(fault.name == "refuse" for fault in self._waiting)

    def strike(self, phase: str, motion_time: float = 0.0) -> list[Fault]:
        """A phase is reached, `motion_time` [s] into the motion; returns the faults that act now."""
        with self._lock:
            due = [f for f in self._waiting if f.phase == phase and motion_time >= f.after and f.name != "refuse"]
            for fault in due:
                self._waiting.remove(fault)
                if fault.name == "silent":
                    self._silent = True
                elif fault.name == "lost_client":
                    self._deaf = True
                elif fault.name in LASTING:
                    self._lasting.add(fault.name)
                elif fault.name in WIRE:
                    self._armed.append(fault)
        return [fault for fault in due if fault.name in MACHINE]

    def acts(self, name: str) -> bool:
        """Whether a fault that lasts until another client comes has struck."""
        return name in self._lasting

    def heard(self, data: bytes) -> bytes:
        """The part of a client's bytes that arrives."""
        return b"" if self._deaf else data

    def heal(self) -> None:
        """A new client finds the wire in order; faults that did not strike yet still wait."""
        with self._lock:
            self._armed.clear()
            self._delayed = None
            self._lasting.clear()
            self._silent = self._deaf = False

    def send(self, frame: bytes, transmit: Callable[[bytes], object], cut: Callable[[], None], spare: bool) -> None:
        """Send a frame as the wire lets it through.

        Args:
            transmit: puts bytes on the wire.
            cut: ends the connection.
            spare: this frame is none that a single fault is spent on (a heartbeat).

        Raises:
            ConnectionResetError: the connection was cut.
            OSError: from `transmit`.
        """
        if self._silent:
            return
        if spare:
            transmit(frame)
            return
        with self._lock:
            armed, self._armed = self._armed, []
            held, self._delayed = self._delayed, None
        for fault in armed:
            if fault.name == "drop":
                transmit(frame[: len(frame) // 2])
                cut()
                raise ConnectionResetError("the fault 'drop' cut the connection")
            if fault.name == "delay":
                threading.Event().wait(min(fault.amount, _TOO_LONG))
            elif fault.name == "corrupt":
                frame = _damaged(frame)
            elif fault.name == "duplicate":
                transmit(frame)
            elif fault.name == "reorder":
                self._delayed = frame
                return
        transmit(frame)
        if held is not None:
            transmit(held)


class FaultyController:
    """What faults act on in a controller of any vendor; `motions_started` and `ends` count its motions."""

    def __init__(self, faults: Faults | None) -> None:
        self.faults = faults or Faults()
        self.motions_started = 0
        self.ends: list[EndReason] = []
        self._lies: dict[str, Fault] = {}
        self._frozen: tuple[np.ndarray, np.ndarray] | None = None  # what is told of positions and set-points
        self._obeys, self._slowness = True, 1.0

    @property
    def moving(self) -> bool:
        """Whether a program runs."""
        raise NotImplementedError

    def history(self) -> str:
        """How often the arm was set in motion and how that ended, in one line."""
        ends = ", ".join(reason.name.lower() for reason in self.ends)
        where = "moving" if self.moving else "at rest"
        return f"motions started {self.motions_started}; ended: {ends or 'none'}; {where}"

    def reach(self, phase: str, motion_time: float = 0.0) -> None:
        """A phase of `PHASES` is reached: its faults strike now.

        A server says `connect` as it greets a client, before it answers; the other phases are the controller's own.
        """
        for fault in self.faults.strike(phase, motion_time):
            if fault.name in LIES:
                self._lies[fault.name] = fault
            self._obeys = self._obeys and fault.name != "disobey"
            self._slowness = fault.amount if fault.name == "slow" else self._slowness
            self._apply_fault(fault)

    def _reported(self, samples: Any) -> Any:
        """Samples (`fake_controller.execution.Slice`) as they are reported."""
        if "frozen" in self._lies:
            if self._frozen is None:
                self._frozen = samples.position[:1], samples.reference_position[:1]
            position, reference = (np.repeat(values, len(samples), axis=0) for values in self._frozen)
            samples = replace(samples, position=position, reference_position=reference)
        if "no_numbers" in self._lies:
            samples = replace(samples, torque=np.full_like(samples.torque, np.nan))
        return samples

    def _apply_fault(self, fault: Fault) -> None:
        """What a fault does here."""
        raise NotImplementedError


def _damaged(frame: bytes) -> bytes:
    middle = len(frame) // 2
    return frame[:middle] + bytes([frame[middle] ^ 0x10]) + frame[middle + 1 :]
