"""The controller behind every wire: stored programs, state, one motion at a time, a ring of samples."""

from __future__ import annotations

import hashlib
import re
import threading
import traceback
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from agent.motion.interpolator import Interpolator
from agent.motion.pdl2 import Pdl2Error, Program, parse_program
from agent.robot import RobotDescription
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.clock import Clock
from fake_controller.execution import CannotMove, Chain, Execution, Planner, Slice, StopSwitch
from fake_controller.plant import Plant

CONTROLLER = "fake controller"
VERSION = "1.0"
PERIOD = 0.002  # s
MAX_PROGRAM = 1024 * 1024  # bytes of one program
MEMORY = 4 * 1024 * 1024  # bytes of all programs
MAX_PROGRAMS = 64
RING = 100_000  # samples kept for whoever missed them
REMEMBERED_MOTIONS = 10_000

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,31}")
_CALIBRATION_POSE = {"comau_ns16": np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])}


class RefusedRequest(Exception):
    """A request that the controller does not carry out; line and column belong to program text, 0 for none."""

    def __init__(self, reason: Refusal, message: str, line: int = 0, column: int = 0) -> None:
        super().__init__(message)
        self.reason = reason
        self.line = line
        self.column = column


class Listener(Protocol):
    """Who hears about a motion, in the motion's own thread."""

    def on_samples(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Samples from sequence number `first` on, with their controller times (K,) [ns]."""

    def on_end(self, reason: EndReason, samples: int, message: str) -> None:
        """The arm rests; there were so many samples."""


@dataclass
class State:
    """What a person at the cell can change, and what the controller reports of it."""

    drives_on: bool = True
    mode: str = "auto"
    emergency_stop: bool = False
    alarms: tuple[str, ...] = ()
    override: float = 1.0
    cell_closed: bool = True


@dataclass(frozen=True, eq=False)
class _Stored:
    """A translated program; `size` in bytes and `checksum`, SHA-256 (hex), of its text."""

    program: Program
    size: int
    checksum: str


@dataclass(frozen=True, eq=False)
class _Recorded:
    first: int
    time_ns: np.ndarray
    samples: Slice


@dataclass
class _Ring:
    """The last samples of a motion."""

    size: int = 0
    parts: deque[_Recorded] = field(default_factory=deque)

    def append(self, part: _Recorded) -> None:
        self.parts.append(part)
        self.size += len(part.samples)
        while self.size > RING:
            self.size -= len(self.parts.popleft().samples)

    def find(self, first: int) -> _Recorded | None:
        """The part that has sample `first`, or the earliest after it."""
        return next((part for part in self.parts if part.first + len(part.samples) > first), None)


class Controller:
    """One robot controller. Thread-safe: servers call it from any thread.

    Args:
        robot: whom it drives.
        plant: that robot; put to rest at the calibration pose here.
        interpolator: the controller's own, at `PERIOD`.
        forward: (S, n) joint positions to (S, 4, 4) TCP poses.
        clock: controller time.
        serial: of the arm.
    """

    def __init__(
        self,
        robot: RobotDescription,
        plant: Plant,
        interpolator: Interpolator,
        forward: Callable[[np.ndarray], np.ndarray],
        clock: Clock,
        serial: str,
    ) -> None:
        self.robot = robot
        self.serial = serial
        self.state = State()
        self.motions_started = 0
        self._clock = clock
        self._planner = Planner(interpolator)
        self._execution = Execution(plant, forward, robot.max_acceleration, PERIOD, clock.slice_samples)
        self._lock = threading.RLock()
        self._programs: dict[str, _Stored] = {}
        self._last_stored = ""
        self._motion_ids: OrderedDict[bytes, None] = OrderedDict()
        self._ring = _Ring()
        self._switch: StopSwitch | None = None
        self._thread: threading.Thread | None = None
        self._reference = home(robot)
        plant.rest(self._reference)
        self._position = plant.position

    @property
    def moving(self) -> bool:
        """Whether a program runs."""
        return self._switch is not None

    @property
    def position(self) -> np.ndarray:
        """(n,) measured, joint side [rad]."""
        return self._position

    @property
    def stored(self) -> tuple[str, str]:
        """Name and SHA-256 (hex) of the program that was stored last; empty where there is none."""
        with self._lock:
            stored = self._programs.get(self._last_stored.lower())
            return ("", "") if stored is None else (self._last_stored, stored.checksum)

    def check_upload(self, name: str, size: int) -> None:
        """Raises:
        RefusedRequest: a program of this name and size cannot be stored now.
        """
        if not _NAME.fullmatch(name):
            raise RefusedRequest(
                Refusal.BAD_REQUEST,
                f"{name!r} cannot name a program: 1 to 32 letters, digits or _, the first no digit",
            )
        if size > MAX_PROGRAM:
            raise RefusedRequest(Refusal.TOO_LARGE, f"{size} bytes; a program may have {MAX_PROGRAM}")
        with self._lock:
            if self.moving:
                raise RefusedRequest(Refusal.MOVING, "no program is stored while one runs; stop it first")
            others = [stored.size for key, stored in self._programs.items() if key != name.lower()]
            if len(others) >= MAX_PROGRAMS or sum(others) + size > MEMORY:
                raise RefusedRequest(Refusal.MEMORY_FULL, "the program memory is full; delete programs")

    def store(self, name: str, data: bytes) -> str:
        """Translate and store a program; returns the SHA-256 (hex) of what is stored.

        Raises:
            RefusedRequest: not a program, or it cannot be stored now.
        """
        try:
            program = parse_program(data.decode("utf-8"), name, self.robot)
        except UnicodeDecodeError:
            raise RefusedRequest(Refusal.SYNTAX, f"program {name} is not UTF-8 text") from None
        except Pdl2Error as error:
            message = f"{error.word}: {error.reason}" if error.word else error.reason
            raise RefusedRequest(Refusal.SYNTAX, message, error.line, error.column) from None
        stored = _Stored(program, len(data), hashlib.sha256(data).hexdigest())
        with self._lock:
            self.check_upload(name, len(data))
            self._programs[name.lower()] = stored
            self._last_stored = name
        return stored.checksum

    def start(self, name: str, checksum: str, motion_id: bytes, listener: Listener) -> None:
        """Begin to run a stored program; `listener` hears the rest.

        Raises:
            RefusedRequest: the state forbids motion, another program or text is stored, this motion id was used
                before, or the first moves cannot be carried out. Nothing moves then.
        """
        with self._lock:
            if motion_id in self._motion_ids:
                raise RefusedRequest(Refusal.REPEATED_MOTION, "this motion command was given before; it acts once")
            self._motion_ids[motion_id] = None
            if len(self._motion_ids) > REMEMBERED_MOTIONS:
                self._motion_ids.popitem(last=False)
            self._check_ready()
            stored = self._programs.get(name.lower())
            if stored is None:
                raise RefusedRequest(Refusal.UNKNOWN_PROGRAM, f"no program {name!r} is stored")
            if stored.checksum != checksum.lower():
                raise RefusedRequest(Refusal.CHECKSUM, f"the stored {name} is another text than the checksum's")
            chains = self._planner.chains(stored.program.run(), self._reference)
            try:
                first = next(chains, None)
            except (CannotMove, Pdl2Error) as error:
                raise RefusedRequest(Refusal.MOTION, str(error), error.line) from None
            self._ring = _Ring()
            self._switch = StopSwitch()
            self.motions_started += 1
            self._thread = threading.Thread(
                target=self._move, args=(_chain(first, chains), self._switch, listener), name="motion", daemon=True
            )

    def go(self) -> None:
        """Let the motion that `start` prepared begin. Apart from it, so that the answer goes out before samples."""
        assert self._thread is not None
        self._thread.start()

    def stop(self, reason: EndReason, message: str) -> None:
        """Bring the arm to rest on its path; nothing to do where it rests."""
        switch = self._switch
        if switch is not None:
            switch.request(reason, message)

    def fetch(self, first: int, count: int) -> tuple[int, np.ndarray, Slice]:
        """At least one and at most `count` recorded samples, the first at or after sequence number `first`.

        Raises:
            RefusedRequest: there are none.
        """
        with self._lock:
            part = self._ring.find(first)
        if part is None or count < 1:
            raise RefusedRequest(Refusal.NOT_AVAILABLE, f"there are no samples from {first} on")
        begin = max(first - part.first, 0)
        chosen = slice(begin, begin + count)
        return part.first + begin, part.time_ns[chosen], _part(part.samples, chosen)

    def shut_down(self) -> None:
        """Bring the arm to rest and wait for that."""
        self.stop(EndReason.SHUTDOWN, "the controller is switched off")
        thread = self._thread
        if thread is not None and thread.is_alive():
            thread.join(10.0)

    def _check_ready(self) -> None:
        state = self.state
        if self.moving:
            raise RefusedRequest(Refusal.MOVING, "the arm moves already")
        if state.emergency_stop:
            raise RefusedRequest(Refusal.EMERGENCY_STOP, "the emergency stop is pressed")
        if state.alarms:
            raise RefusedRequest(Refusal.ALARM, f"active alarms: {', '.join(state.alarms)}")
        if state.mode != "auto":
            raise RefusedRequest(Refusal.TEACH_MODE, f"the mode is {state.mode}; programs start in auto only")
        if not state.drives_on:
            raise RefusedRequest(Refusal.DRIVES_OFF, "the drives are off")
        if not state.cell_closed:
            raise RefusedRequest(Refusal.CELL_OPEN, "the cell is open")

    def _move(self, chains: Iterator[Chain], switch: StopSwitch, listener: Listener) -> None:
        period_ns = round(PERIOD * 1e9)
        origin = self._clock.now() + period_ns
        count = 0
        reason, message = EndReason.DONE, ""
        try:
            for samples in self._execution.run(chains, self._reference, switch):
                time_ns = origin + period_ns * np.arange(count, count + len(samples), dtype=np.int64)
                self._clock.wait_until(int(time_ns[-1]))
                with self._lock:
                    self._ring.append(_Recorded(count, time_ns, samples))
                    self._position = samples.position[-1]
                    self._reference = samples.reference_position[-1]
                listener.on_samples(count, time_ns, samples)
                count += len(samples)
        except (CannotMove, Pdl2Error) as error:
            reason, message = EndReason.PROGRAM_ERROR, f"line {error.line}: {error}" if error.line else str(error)
        except Exception as error:  # the client must hear that the motion is over, whatever went wrong in here
            traceback.print_exc()
            reason, message = EndReason.PROGRAM_ERROR, f"the controller failed: {type(error).__name__}: {error}"
        if reason is EndReason.DONE and switch.reason is not None:
            reason, message = switch.reason, switch.message
        with self._lock:
            self._switch = None
        listener.on_end(reason, count, message)


def home(robot: RobotDescription) -> np.ndarray:
    """(n,) where a robot stands when it is switched on: its calibration pose, or zero within its limits."""
    lower, upper = robot.position_limits
    return _CALIBRATION_POSE.get(robot.name, np.clip(np.zeros(robot.dof), lower, upper))


def _chain(first: Chain | None, others: Iterator[Chain]) -> Iterator[Chain]:
    if first is not None:
        yield first
        yield from others


def _part(samples: Slice, chosen: slice) -> Slice:
    return Slice(
        samples.position[chosen],
        samples.velocity[chosen],
        samples.torque[chosen],
        samples.reference_position[chosen],
        samples.reference_velocity[chosen],
    )
