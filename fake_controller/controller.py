"""The controller behind every wire: stored programs, state, one motion at a time, a ring of samples."""

from __future__ import annotations

import threading
import time
import traceback
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Protocol

import numpy as np

from agent.motion import Interpolator
from agent.motion.pdl2 import Pdl2Error, Pos, Value
from agent.robot import RobotDescription
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.clock import Clock
from fake_controller.execution import CannotMove, Chain, Execution, Planner, Slice, StopSwitch
from fake_controller.faults import Fault, Faults, FaultyController
from fake_controller.plant import Plant
from fake_controller.program.frames import tool_point
from fake_controller.program.interpreter import FACTORY, Interpreter
from fake_controller.program.memory import ProgramMemory, RefusedRequest, check_program
from fake_controller.state import State, home

CONTROLLER = "fake controller"
VERSION = "1.0"
PERIOD = 0.002  # s
RING = 100_000  # samples
REMEMBERED_MOTIONS = 10_000


class Ring:
    """The last `RING` samples of a motion: parts of (sequence number of the first, controller times [ns], samples)."""

    def __init__(self) -> None:
        self.size = 0
        self._parts: deque[tuple[int, np.ndarray, Slice]] = deque()

    def append(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Keep samples; drop the oldest if the buffer is full."""
        self._parts.append((first, time_ns, samples))
        self.size += len(samples)
        while self.size > RING:
            self.size -= len(self._parts.popleft()[2])

    def find(self, first: int) -> tuple[int, np.ndarray, Slice] | None:
        """The part that has sample `first`, or the earliest after it."""
        return next((part for part in self._parts if part[0] + len(part[2]) > first), None)


class Listener(Protocol):
    """Receiver of a motion's events, called in the motion's thread."""

    def on_samples(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Samples from sequence number `first` on, with their controller times (K,) [ns]."""

    def on_end(self, reason: EndReason, samples: int, message: str) -> None:
        """The arm rests; the motion had this number of samples."""


class Controller(FaultyController):
    """One robot controller. Thread-safe: servers call it from any thread.

    Args:
        robot: whom it drives.
        plant: that robot; put to rest at the calibration pose here.
        interpolator: the controller's own, at `PERIOD`.
        forward: (S, n) joint positions to (S, 4, 4) TCP poses.
        clock: controller time.
        serial: of the arm.
        faults: what goes wrong, and when.
        system: system variables by name, as an earlier program has left them; as the controller comes if not given.

    `position` [rad] and `torque` [N·m] (n,) were measured last, joint side; `reference` (n,) [rad] is the set-point
    that was given last.
    """

    def __init__(
        self,
        robot: RobotDescription,
        plant: Plant,
        interpolator: Interpolator,
        forward: Callable[[np.ndarray], np.ndarray],
        clock: Clock,
        serial: str,
        faults: Faults | None = None,
        system: Mapping[str, Value] = FACTORY,
    ) -> None:
        super().__init__(faults)
        self.robot, self.name, self.serial = robot, robot.name, serial
        self.clock, self.forward, self.state = clock, forward, State()
        self.when_restarting: list[Callable[[], object]] = []
        self._system = dict(system)
        self._counter_zero = self._count = 0
        self._planner = Planner(interpolator)
        self._execution = Execution(plant, forward, robot.max_acceleration, PERIOD, clock.slice_samples)
        self._machine, self._lock = plant.machine, threading.RLock()
        self._programs = ProgramMemory(robot)
        self._motion_ids: OrderedDict[bytes, None] = OrderedDict()
        self._ring = Ring()
        self._switch: StopSwitch | None = None
        self._thread: threading.Thread | None = None
        self._rests = threading.Event()
        self._rests.set()
        self.reference = home(robot)
        plant.rest(self.reference)
        self.position = plant.position
        self.torque = plant.resting.torque[-1]

    @property
    def moving(self) -> bool:
        return self._switch is not None

    @property
    def temperatures(self) -> tuple[float, ...]:
        """(n,) of the motors [°C], or none where nothing on this machine warms up."""
        return self._machine.temperatures

    @property
    def frames(self) -> tuple[tuple[float, ...], ...]:
        """$BASE, $UFRAME and $TOOL as they are now: x, y, z [mm], a, e, r [deg] each."""
        values = [self._system[name] for name in ("$BASE", "$UFRAME", "$TOOL")]
        return tuple(value.fields for value in values if isinstance(value, Pos))

    def tool_point(self, position: np.ndarray) -> tuple[float, ...]:
        """Where the tool is at joint positions (n,), in the frames of now: x, y, z [mm], a, e, r [deg] in $UFRAME."""
        base, uframe, tool = self.frames
        return tool_point(self.forward(position[None])[0], base, tool, uframe).pos

    @property
    def recorded(self) -> int:
        """Samples of the last motion that can still be fetched."""
        return self._ring.size

    @property
    def stored(self) -> tuple[str, str]:
        """Name and SHA-256 (hex) of the program that was stored last; empty if there is none."""
        with self._lock:
            last = self._programs.last
        return ("", "") if last is None else (last.name, last.checksum)

    def text(self, name: str) -> bytes:
        """The stored text of a program; empty if there is none."""
        with self._lock:
            stored = self._programs.find(name)
        return b"" if stored is None else stored.text

    def check_upload(self, name: str, size: int) -> None:
        """Raises:
        RefusedRequest: a program of this name and size cannot be stored now.
        """
        self.reach("upload")
        check_program(name, size)
        with self._lock:
            if self.moving:
                raise RefusedRequest(Refusal.MOVING, "no program is stored while one runs; stop it first")
            self._programs.check_room(name, size)

    def store(self, name: str, data: bytes) -> str:
        """Translate and store a program; returns the SHA-256 (hex) of the stored text.

        Raises:
            RefusedRequest: not a program, or it cannot be stored now.
        """
        program = self._programs.translate(name, data)
        with self._lock:
            self.check_upload(name, len(data))
            return self._programs.keep(name, program, data).checksum

    def start(self, name: str, checksum: str, motion_id: bytes, listener: Listener) -> None:
        """Begin to run a stored program; `listener` hears the rest.

        Raises:
            RefusedRequest: the state forbids motion, another program or text is stored, this motion id was used
                before, or the first moves cannot be carried out. Nothing moves then.
        """
        self.reach("start")
        with self._lock:
            if motion_id in self._motion_ids:
                raise RefusedRequest(Refusal.REPEATED_MOTION, "this motion command was given before; it acts once")
            self._motion_ids[motion_id] = None
            if len(self._motion_ids) > REMEMBERED_MOTIONS:
                self._motion_ids.popitem(last=False)
            if self.moving:
                raise RefusedRequest(Refusal.MOVING, "the arm moves already")
            self.state.check_ready()
            stored = self._programs.find(name)
            if stored is None:
                raise RefusedRequest(Refusal.UNKNOWN_PROGRAM, f"no program {name!r} is stored")
            if stored.checksum != checksum.lower():
                raise RefusedRequest(Refusal.CHECKSUM, f"the stored {name} is another text than the checksum's")
            statements = Interpreter(stored.program, self.robot, self._system).run()
            chains = self._planner.chains(statements, self.reference)
            try:
                first = next(chains, None)
            except (CannotMove, Pdl2Error) as error:
                raise RefusedRequest(Refusal.MOTION, str(error), error.line) from None
            planned = chain([] if first is None else [first], chains)
            self._ring = Ring()
            self._switch = StopSwitch(self.state.override)
            self._count = self._counter_zero = 0
            self.motions_started += 1
            self._rests.clear()
            self._thread = threading.Thread(
                target=self._move, args=(planned, self._switch, listener), name="motion", daemon=True
            )

    def go(self) -> None:
        """Let the motion that `start` prepared begin. Apart from it, so that the answer goes out before samples."""
        assert self._thread is not None
        self._thread.start()

    def stop(self, reason: EndReason, message: str) -> None:
        """Bring the arm to rest on its path; nothing to do where it rests."""
        if reason is EndReason.STOPPED:
            self.reach("stop")
        switch = self._switch
        if switch is not None and (self._obeys or reason is not EndReason.STOPPED):
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
        began, time_ns, samples = part
        begin = max(first - began, 0)
        chosen = slice(begin, begin + count)
        return began + begin, time_ns[chosen], samples.part(chosen)

    def wait(self, timeout: float) -> bool:
        """Wait until the arm rests and its client has heard of it; False if that takes longer [s]."""
        return self._rests.wait(timeout)

    def shut_down(self) -> None:
        """Bring the arm to rest and wait for that."""
        self.stop(EndReason.SHUTDOWN, "the controller is switched off")
        self.wait(10.0)

    def _apply_fault(self, fault: Fault) -> None:
        stop = self.state.apply_fault(fault.name)
        if stop is not None:
            self.stop(*stop)
        self._execution.astray.apply_fault(fault)
        match fault.name:
            case "override" | "off_speed":  # the second without a word
                if fault.name == "override":
                    self.state.override = fault.amount
                if self._switch is not None:
                    self._switch.speed = fault.amount
            case "restart":
                self._restart()
            case "reset_counters":
                self._counter_zero = self._count
                self._ring = Ring()
            case "wrong_program" if fault.phase == "upload":
                self._programs.alter_next = True
            case "wrong_program":
                with self._lock:
                    self._programs.alter()
            case "wrong_robot":
                self.name = f"{self.name}_other"
            case "full_memory":
                self._programs.full = True
            case "untranslatable":
                self._programs.refused_line = round(fault.amount)

    def _restart(self) -> None:
        """Power off and on: connections, programs and memory are gone, and the drives are off."""
        for cut in self.when_restarting:  # first: a controller that is off has no visible state
            cut()
        self.stop(EndReason.SHUTDOWN, "the controller restarts")
        with self._lock:
            self._programs.clear()
            self._motion_ids.clear()
            self._ring = Ring()
            self.state = State(drives_on=False, emulator=self.state.emulator)

    def _move(self, chains: Iterator[Chain], switch: StopSwitch, listener: Listener) -> None:
        period_ns = round(PERIOD * 1e9)
        origin = self.clock.now() + period_ns
        reason, message = EndReason.DONE, ""
        try:
            for samples in self._execution.run(chains, self.reference, switch):
                count = self._count
                time_ns = origin + period_ns * np.arange(count, count + len(samples), dtype=np.int64)
                self.clock.wait_until(int(time_ns[-1]))
                if self._slowness > 1.0:
                    time.sleep((self._slowness - 1.0) * PERIOD * len(samples))
                first = count - self._counter_zero
                with self._lock:
                    self._ring.append(first, time_ns, samples)
                    self.position, self.torque = samples.position[-1], samples.torque[-1]
                    self.reference = samples.reference_position[-1]
                self._tell(listener, first, time_ns, samples)
                self._count = count + len(samples)
                self.reach("streaming", self._count * PERIOD)
        except (CannotMove, Pdl2Error) as error:
            reason, message = EndReason.PROGRAM_ERROR, f"line {error.line}: {error}" if error.line else str(error)
        except Exception as error:  # the client must hear that the motion is over, also after an error here
            traceback.print_exc()
            reason, message = EndReason.PROGRAM_ERROR, f"the controller failed: {type(error).__name__}: {error}"
        if reason is EndReason.DONE and switch.reason is not None:
            reason, message = switch.reason, switch.message
        with self._lock:
            self._switch = None
            self.ends.append(reason)
        try:
            if "no_end" not in self._lies:
                listener.on_end(reason, self._count - self._counter_zero, message)
        finally:
            self._rests.set()

    def _tell(self, listener: Listener, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Report samples truthfully, apart from faults."""
        if "mute" in self._lies:
            return
        if "clock_back" in self._lies:
            time_ns = time_ns - round(1e9 * self._lies["clock_back"].amount)
        samples = self._reported(samples)
        if "columns" in self._lies:
            samples = Slice(*(column[:, :-1] for column in samples.columns))
        listener.on_samples(first, time_ns, samples)
