"""A UR controller and its arm: one thread lives through its cycles, carries out scripts and tells what it measured."""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from agent.robot import RobotDescription
from drivers.wire.reasons import EndReason
from fake_controller.clock import Clock, FastClock
from fake_controller.execution import Astray, between, follow
from fake_controller.faults import LASTING, Fault, Faults
from fake_controller.plant import Plant
from fake_controller.state import State
from fake_controller.ur.arm import Unreachable
from fake_controller.ur.fields import Cycles
from fake_controller.ur.functions import script_functions
from fake_controller.ur.law import CB3, E_SERIES, PlannedSetpoints, UrInterpolator, UrMove
from fake_controller.ur.messages import error_message, exception_message, key_message, text_message
from fake_controller.ur.script import Go, Request, Run, Script, ScriptError
from fake_controller.ur.state import SWITCHED_ON, UrState, Version

UNLOCK_AFTER = 5.0  # s
#: Faults that make no sense here, and why.
IMPOSSIBLE = {
    **dict.fromkeys(LASTING, "samples come by no broker there, points in no queue"),
    **dict.fromkeys(("wrong_program", "full_memory"), "no program is stored there"),
    "columns": "its fields have their number of joints",
    "reorder": "each of its ports is a stream of its own",
}
_TURNS = 5000  # of loops and calls that a thread may make in one cycle
_TOOL_SPEED, _TOLERATED = 1.5, 1.02  # m/s, factory safety limit; share of a limit
_SLIDER_SLEW, _STOP_SLEW, _LOWEST_SLIDER = 0.3, 0.15, 0.01  # s, s, share of full speed
_WARNING, _VIOLATION, _FAULT = 2, 3, 4  # levels of an error message


class CellListener(Protocol):
    """Who hears of a cell, in the cell's own thread."""

    def on_cycles(self, cycles: Cycles) -> None:
        """What was measured."""

    def on_message(self, message: bytes) -> None:
        """A message of the primary interface."""


@dataclass(eq=False)
class _Thread:
    run: Run
    handle: int
    wake: int = 0
    waits_for: str = ""  # "motion", "rest", or nothing
    answer: Any = None
    held: Request | Go | None = None
    over: bool = False


@dataclass(eq=False)
class _Program:
    script: Script
    threads: list[_Thread]
    watched: list[_Watched] = field(default_factory=list)


@dataclass(eq=False)
class _Watched:
    name: str
    patience: float
    action: str
    updates: int
    silence: float = 0.0


@dataclass(eq=False)
class _Moving:
    """Set-points that are being carried out: `at` says how far, `blend` where the next move takes over."""

    thread: _Thread
    after: UrMove | None
    deferred: list[Request]
    position: np.ndarray
    velocity: np.ndarray
    blend: int
    at: float = 0.0


class UrCell(UrState):
    """One arm with its controller. Thread-safe: servers call it from any thread.

    Args:
        robot: one of `MODELS`.
        plant: that robot, at the period of the controller's generation.
        clock: controller time.
        serial: digits.
        seed: of what is drawn for this individual.
        version: of PolyScope; major 3 is a CB3, 5 an e-Series.
        faults: what goes wrong, and when.
        shortest_watchdog: [s] that a program's watchdog is granted at least.
    """

    def __init__(
        self,
        robot: RobotDescription,
        plant: Plant,
        clock: Clock,
        serial: str,
        seed: int,
        version: Version,
        faults: Faults | None = None,
        shortest_watchdog: float = 0.05,
    ) -> None:
        super().__init__(robot, plant.machine, serial, seed, version, faults)
        self.clock = clock
        self.listeners: list[CellListener] = []
        self.when_cut: list[Callable[[], object]] = []  # every connection, as at a restart
        self.when_local: list[Callable[[], object]] = []
        self.shortest_watchdog = shortest_watchdog
        self.updates: dict[str, int] = {}
        self._plant, self._astray = plant, Astray(6, self.period)
        self._functions = script_functions(self)
        self._lock, self._wake, self._closing = threading.RLock(), threading.Event(), threading.Event()
        self._refused_line = 0
        self._hidden_rate, self._clock_back = 1.0, 0.0
        self._program: _Program | None = None
        self._moving: _Moving | None = None
        self._next_script: Script | None = None
        self._stopped_at, self._slew = 0, _SLIDER_SLEW
        self._moved = 0.0
        self._looked = time.monotonic()
        plant.rest(self.reference)
        self._interpolator = UrInterpolator(
            self.kinematics, E_SERIES if self.e_series else CB3, self.period, self.reference
        )
        self._origin = clock.now()
        self._thread = threading.Thread(target=self._live, name="ur cell", daemon=True)
        self._thread.start()

    # What is asked of it

    @property
    def mute(self) -> bool:
        """Whether no samples go out any more."""
        return "mute" in self._lies

    @property
    def _threads(self) -> list[_Thread]:
        return [] if self._program is None else self._program.threads

    def hurry(self) -> None:
        """Somebody looks: the next samples come at once, where the clock is fast and nothing moves."""
        self._wake.set()

    def take_script(self, text: str) -> None:
        """A script came by one of the ports; in local mode nothing happens."""
        if text.startswith("sec "):
            self._take_secondary(text)
            return
        self.reach("upload")
        if not self.remote:
            return
        try:
            if self._refused_line:
                raise ScriptError("compile_error_syntax_error", self._refused_line)
            script = Script(text, self._functions)
        except ScriptError as error:
            self._tell(exception_message(self.time, error.line, error.column, str(error)))
            return
        self.reach("start")
        with self._lock:
            if self.robot_mode != 7 or self.safety_mode not in (1, 2):
                self._tell(error_message(self.time, 210, 0, _WARNING, "The robot is not ready to run a program"))
                return
            self._end_program(EndReason.STOPPED)
            self._next_script = script
        self._wake.set()

    def _take_secondary(self, text: str) -> None:
        """Carry out a secondary program within one cycle, while a program runs: it cannot move or wait."""
        if not self.remote:
            return
        try:
            run, answer = Script(text.replace("sec ", "def ", 1), self._functions).run(), None
            with self._lock, contextlib.suppress(StopIteration):
                while True:
                    request = run.send(answer)
                    if not isinstance(request, Request):
                        raise ScriptError("runtime_error: a secondary program cannot move or wait", 1)
                    answer = request.act(self, None)
        except ScriptError as error:
            self._tell(exception_message(self.time, error.line, error.column, str(error)))

    def stop(self, reason: EndReason, message: str) -> None:
        """End the program, the arm coming to rest on its path."""
        if reason is EndReason.STOPPED:
            self.reach("stop")
        with self._lock:
            if self._obeys or reason is not EndReason.STOPPED:
                self._end_program(reason)

    def stop_program(self) -> None:
        """As a client asks for it."""
        self.stop(EndReason.STOPPED, "a client stopped the program")

    def pause(self, paused: bool) -> bool:
        """Pause the program, or let it go on; False where it cannot be."""
        with self._lock:
            if self._program is None or not (paused or (self._paused and self.safety_mode in (1, 2))):
                return False
            self._paused = paused
        return True

    def protective_stop(self, why: str) -> None:
        """Come to rest at once; the program is paused."""
        with self._lock:
            if not self.protected:
                self.protected, self._stopped_at = True, self.cycle
                self._paused, self._slew = self.running, _STOP_SLEW
                self._tell(error_message(self.time, 153, 1, _WARNING, f"Protective stop: {why}"))

    def unlock(self) -> bool:
        """Release a protective stop; False within 5 s of it."""
        with self._lock:
            if self.protected and (self.cycle - self._stopped_at) * self.period < UNLOCK_AFTER:
                return False
            self.protected = False
        return True

    def power(self, drives_on: bool, idle: bool) -> None:
        """Switch the arm on or off, its brakes released or not."""
        with self._lock:
            if not drives_on:
                self._end_program(EndReason.DRIVE_FAULT)
            self.state.drives_on, self.idle = drives_on and not self.state.emergency_stop, idle

    def watch(self, name: str, frequency: float, action: str) -> None:
        """rtde_set_watchdog; a frequency of 0 leaves the one there is."""
        if self._program is not None and frequency > 0:
            self._program.watched = [w for w in self._program.watched if w.name != name]
            patience = max(1.0 / frequency, self.shortest_watchdog)
            self._program.watched.append(_Watched(name, patience, action, self.updates.get(name, 0)))

    def updated(self, name: str) -> None:
        """An input came in."""
        self.updates[name] = self.updates.get(name, 0) + 1

    def sleep(self, thread: _Thread, seconds: float) -> None:
        """Go on with a thread after this time, in the next cycle at the earliest."""
        thread.wake = self.cycle + max(1, round(seconds / self.period))

    def brake(self, thread: _Thread, deceleration: float) -> None:
        """Come to rest [rad/s² or m/s²]; the thread waits for that."""
        if self._moving is not None:
            speed = float(np.abs(self.reference_velocity).max())
            self._stopping, self._slew = True, max(speed / max(deceleration, 1e-3), self.period)
            thread.waits_for = "rest"

    def start_thread(self, run: Run) -> int:
        """The handle of a new thread of the program."""
        threads = self._threads
        threads.append(_Thread(run, 1 + max(other.handle for other in threads), self.cycle))
        return threads[-1].handle

    def end_thread(self, handle: int, kill: bool) -> bool:
        """Whether the thread of a handle is over, which `kill` sees to."""
        named = [thread for thread in self._threads[1:] if thread.handle == handle]
        for thread in named:
            thread.over = thread.over or kill
        return all(thread.over for thread in named)

    def halt(self) -> None:
        """End the program as if it had come to its end."""
        self._threads[0].over = True
        self._end_program(EndReason.DONE)

    def tell_text(self, text: str) -> None:
        """textmsg."""
        self._tell(text_message(self.time, text))

    def shut_down(self) -> None:
        """Bring the arm to rest, and end."""
        self.stop(EndReason.SHUTDOWN, "the controller is switched off")
        until = time.monotonic() + 10.0
        while self.moving and time.monotonic() < until and self._thread.is_alive():
            self._wake.wait(0.01)
        self._closing.set()
        self._wake.set()
        self._thread.join(5.0)

    # Its life, in its own thread

    def _live(self) -> None:
        while not self._closing.is_set():
            self._wake.clear()
            try:
                with self._lock:
                    self._look_at_watchdogs()
                    self._run_program()
                    cycles = self._do_cycles()
                self._publish(cycles)
            except Exception:  # who listens must hear that the program is over, whatever went wrong in here
                traceback.print_exc()
                with self._lock:
                    self._moving = None
                    self._end_program(EndReason.PROGRAM_ERROR)

    def _publish(self, cycles: Cycles) -> None:
        self.clock.wait_until(self._origin + round(self.cycle * self.period * 1e9))
        idle = self._program is None or self._paused or len(cycles) == 1  # for a program, or in one for an input
        if isinstance(self.clock, FastClock) and not self._moving and idle:
            self._wake.wait(len(cycles) * self.period)  # nobody has to be hurried
        if self._slowness > 1.0:
            self._closing.wait((self._slowness - 1.0) * self.period * len(cycles))
        for listener in list(self.listeners):
            listener.on_cycles(cycles)
        if self._moving is not None:
            self._moved += len(cycles) * self.period
            self.reach("streaming", self._moved)

    def _tell(self, message: bytes) -> None:
        for listener in list(self.listeners):
            listener.on_message(message)

    def _look_at_watchdogs(self) -> None:
        """A stall of this process is not the client's silence: no look counts for more than a tenth of a second."""
        now = time.monotonic()
        passed, self._looked = min(now - self._looked, 0.1), now
        for watched in [] if self._program is None or self._paused else self._program.watched:
            count = self.updates.get(watched.name, 0)
            watched.silence = watched.silence + passed if count == watched.updates else 0.0
            watched.updates = count
            if watched.silence < watched.patience or watched.action == "ignore":
                continue
            if watched.action == "pause":
                self._paused = True
                continue
            self.protective_stop(f"nothing was heard of {watched.name}")
            self._end_program(EndReason.WATCHDOG)
            return

    def _do_cycles(self) -> Cycles:
        count = self.clock.slice_samples
        if not isinstance(self.clock, FastClock):  # one cycle at a time, and more where it is behind
            behind = (self.clock.now() - self._origin) * 1e-9 / self.period - self.cycle
            count = min(max(int(behind), 1), count)
        elif self._moving is None:
            count = 10
        if self._program is not None and not self._paused:
            due = [thread.wake - self.cycle for thread in self._program.threads if not thread.waits_for]
            count = max(1, min([count, *due]))
        q, qd = self._set_points(count)
        before = np.vstack([self.reference_velocity, qd])
        qdd = np.diff(before, axis=0) / self.period
        samples = follow(self._plant, self._astray, q, qd, self.reference)
        times = SWITCHED_ON + (self.cycle + 1 + np.arange(len(q))) * self.period - self._clock_back
        self.cycle += len(q)
        position, velocity, torque, q, qd = samples.columns
        self.reference, self.reference_velocity = q[-1], qd[-1]
        self.position, self.velocity = position[-1], velocity[-1]
        position, velocity, torque, q, qd = self._reported(samples).columns
        return Cycles(self, times, q, qd, qdd, position, velocity, torque)

    def _set_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        moving = self._moving
        if moving is None:
            self._rate = 1.0 if not self._paused else 0.0
            return np.repeat(self.reference[None], count, axis=0), np.zeros((count, 6))
        halted = self._paused or self._stopping or self.protected or not self.state.drives_on
        wanted = 0.0 if halted else max(self.state.override, _LOWEST_SLIDER) * self._hidden_rate
        step = self.period / self._slew * np.arange(1, count + 1)
        rates = self._rate + np.clip(wanted - self._rate, -step, step)
        at = moving.at + np.cumsum(rates)
        event = min(moving.blend, len(moving.position) - 1)
        if at[-1] >= event - 1e-9:
            count = int(np.argmax(at >= event - 1e-9)) + 1
        at, rates = np.minimum(at[:count], len(moving.position) - 1.0), rates[:count]
        q, qd = between(moving.position, moving.velocity, at, self.period)
        moving.at, self._rate = float(at[-1]), float(rates[-1])
        if self._rate == 0.0 and self._stopping:
            self._come_to_rest()
        return q, qd * rates[:, None]

    def _come_to_rest(self) -> None:
        """Nothing is left of a motion that was stopped."""
        self._moving, self.control_line = None, 0
        self._stopping, self._slew = False, _SLIDER_SLEW
        for thread in self._threads:
            thread.waits_for = ""

    # Programs

    def _run_program(self) -> None:
        if self._next_script is not None and self._moving is None:
            script, self._next_script = self._next_script, None
            self._interpolator.rest(self.reference)
            self._stopping, self._paused, self._slew, self._moved = False, False, _SLIDER_SLEW, 0.0
            self.motions_started += 1
            self._program = _Program(script, [_Thread(script.run(), 0)])
            self._tell(key_message(self.time, "PROGRAM_XXX_STARTED", script.name))
        program = self._program
        if program is None or self._paused or self.protected:
            return
        try:
            moving = self._moving
            if moving is not None and moving.at >= min(moving.blend, len(moving.position) - 1) - 1e-9:
                self._go_on(moving)
            for thread in list(program.threads):
                self._run_thread(program, thread)
        except ScriptError as error:
            self._tell(exception_message(self.time, error.line, error.column, str(error)))
            self._end_program(EndReason.PROGRAM_ERROR)
        if self._program is program and (program.threads[0].over or not program.threads):
            self._end_program(EndReason.DONE)

    def _run_thread(self, program: _Program, thread: _Thread) -> None:
        turns = 0
        while not thread.over and not thread.waits_for and thread.wake <= self.cycle and self._program is program:
            turns += 1
            request = self._next(thread)
            if request is not None:
                self._carry_out(thread, request)
            if turns > _TURNS:
                raise ScriptError("runtime_error: a loop that does not move needs sync() or sleep()", 1)

    def _next(self, thread: _Thread) -> Request | Go | None:
        """The next request; None for a turn of a loop, and where the thread is over."""
        if thread.held is not None:
            request, thread.held = thread.held, None
            return request
        answer, thread.answer = thread.answer, None
        try:
            return thread.run.send(answer)
        except StopIteration:
            thread.over = True
            return None

    def _carry_out(self, thread: _Thread, request: Request | Go) -> None:
        if isinstance(request, Go):
            self._begin(thread, request)
            return
        try:
            thread.answer = request.act(self, thread)
        except (LookupError, Unreachable) as error:
            raise ScriptError(f"runtime_error: {error}", request.line) from None

    def _begin(self, thread: _Thread, request: Go) -> None:
        """Begin a move from rest."""
        if self._moving is not None:
            raise ScriptError("runtime_error: another thread is controlling the robot", request.line)
        self._interpolator.rest(self.reference)
        move = self._in_joints(request, self.reference)
        start = (self.kinematics.forward(self.reference[None]) @ move.tcp)[0]
        if self._overlaps(start, 0.0, move):
            return
        self._go_on(_Moving(thread, move, [], self.reference[None], np.zeros((1, 6)), 0))
        self._rate = min(1.0, max(self.state.override, _LOWEST_SLIDER)) * self._hidden_rate
        thread.waits_for = "motion"

    def _go_on(self, moving: _Moving) -> None:
        """The next move takes over, or the arm has come to its goal."""
        for action in moving.deferred:
            action.act(self, moving.thread)
        if moving.after is None:
            self._moving, moving.thread.waits_for, self.control_line = None, "", 0
            return
        after, deferred = self._read_ahead(moving.thread, moving.after)
        planned = self._plan(moving.after, after)
        self.control_line = moving.after.line
        passed = min(int(moving.at), len(moving.position) - 1)
        position = np.vstack([moving.position[passed:], planned.position])
        velocity = np.vstack([moving.velocity[passed:], planned.velocity])
        blend = len(moving.position) - 1 - passed + planned.blend
        at = moving.at - passed
        self._moving = _Moving(moving.thread, after, deferred, position, velocity, blend, at)

    def _read_ahead(self, thread: _Thread, move: UrMove) -> tuple[UrMove | None, list[Request]]:
        """The move that this one blends into, if any, and the actions between them."""
        deferred: list[Request] = []
        while move.radius > 0 and not thread.over:
            request = self._next(thread)
            match request:
                case None:
                    continue
                case Request(early=True):
                    deferred.append(request)
                case Go():
                    reference = move.joints if move.joints is not None else self._interpolator.q
                    after = self._in_joints(request, reference)
                    if not self._overlaps(move.goal, move.radius, after):
                        return after, deferred
                case _:
                    thread.held = request
                    break
        return None, deferred

    def _in_joints(self, request: Go, reference: np.ndarray) -> UrMove:
        move = replace(request.move, line=request.line)
        if move.kind != "joint" or move.joints is not None:
            return move
        try:
            return replace(move, joints=self.kinematics.nearest(move.goal @ np.linalg.inv(move.tcp), reference))
        except Unreachable as error:
            raise ScriptError(f"runtime_error: {error}", request.line) from None

    def _overlaps(self, start: np.ndarray, radius: float, move: UrMove) -> bool:
        """Whether a move is left out, as its blend meets the one before."""
        apart = float(np.linalg.norm(move.goal[:3, 3] - start[:3, 3]))
        if move.radius + radius < apart or move.radius + radius == 0.0:
            return False
        self._tell(error_message(self.time, 258, 0, _WARNING, f"Overlapping Blends in line {move.line}: move skipped"))
        return True

    def _plan(self, move: UrMove, after: UrMove | None) -> PlannedSetpoints:
        """Raises:
        ScriptError: a move out of reach, or one that is too fast; the arm comes to a protective stop then.
        """
        why = ""
        try:
            planned = self._interpolator.plan(move, after)
        except Unreachable as error:
            why = str(error)
        else:
            places = (self.kinematics.forward(planned.position[::8]) @ move.tcp)[:, :3, 3]
            tool = np.linalg.norm(np.diff(places, axis=0), axis=1).max(initial=0.0) / (8 * self.period)
            fastest = np.abs(planned.velocity).max(axis=0, initial=0.0) / self.robot.max_velocity
            if fastest.max() > _TOLERATED:
                why = f"{self.robot.joint_names[int(np.argmax(fastest))]} would be faster than its limit"
            elif tool > _TOLERATED * _TOOL_SPEED:
                why = f"the tool would be faster than {_TOOL_SPEED} m/s"
        if why:
            self.protective_stop(why)
            raise ScriptError(f"runtime_error: {why}", move.line)
        return planned

    def _end_program(self, reason: EndReason) -> None:
        self._next_script = None
        if self._program is None:
            return
        name, self._program = self._program.script.name, None
        self._paused = False
        self.ends.append(reason)
        if self._moving is not None:
            self._stopping, self._slew = True, _STOP_SLEW
        self._tell(key_message(self.time, "PROGRAM_XXX_STOPPED", name))

    # Faults

    def _apply_fault(self, fault: Fault) -> None:  # noqa: C901
        self._astray.apply_fault(fault)
        match fault.name:
            case "protective_stop":
                self.protective_stop("a collision was detected")
            case "alarm":
                self._tell(error_message(self.time, 50, 3, _VIOLATION, "Motor 3 is too hot"))
                self.protective_stop("motor 3 is too hot")
            case "emergency_stop" | "drive_fault" | "teach_mode":
                stop = self.state.apply_fault(fault.name)
                if stop is not None:
                    self._tell(error_message(self.time, 50, 0, _FAULT, stop[1]))
                    self.stop(*stop)
                if fault.name == "teach_mode":
                    for close in list(self.when_local):
                        close()
            case "override":
                self.state.override = fault.amount
            case "off_speed":
                self._hidden_rate = fault.amount
            case "clock_back" | "reset_counters":
                self._clock_back = fault.amount or self.time
            case "wrong_robot":
                self.model = f"{self.model}0"
            case "untranslatable":
                self._refused_line = round(fault.amount)
            case "restart":
                self._restart()

    def _restart(self) -> None:
        """Power off and on: connections and programs are gone, and the arm is off."""
        for cut in list(self.when_cut):
            cut()
        self.stop(EndReason.SHUTDOWN, "the controller restarts")
        with self._lock:
            self.clear_registers()
            self.state = State(drives_on=False)
