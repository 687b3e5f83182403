"""Connections of the published ports: bytes out without waiting for who does not read, lines and packages in."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable

from fake_controller.clock import FastClock
from fake_controller.servers.base import SEND_LIMIT, received
from fake_controller.ur.cell import UrCell
from fake_controller.ur.fields import Cycles
from fake_controller.ur.messages import error_message, state_message, version_message

_NEAR = 8 * 1024  # bytes on their way that a cell in no hurry is ahead of a client
_STATE_PERIOD = 0.1  # s
_LONGEST_SCRIPT = 4 * 1024 * 1024

_FORBIDDEN = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and reconnect to "
    "port 29999"
)
_TOO_EARLY = "Cannot unlock protective stop until 5s after occurrence"
_ACTING = ("load ", "play", "stop", "pause", "power o", "brake release", "unlock protective stop", "restart safety")
_ROBOT_MODES = {3: "POWER_OFF", 5: "IDLE", 7: "RUNNING"}
_SAFETY = {1: "NORMAL", 3: "PROTECTIVE_STOP", 5: "SAFEGUARD_STOP", 7: "ROBOT_EMERGENCY_STOP", 9: "FAULT"}


class UrConnection:
    """One client of one port. `serve` reads in a thread of its own; anybody may send."""

    def __init__(self, cell: UrCell, connection: socket.socket) -> None:
        self.cell = cell
        self._socket = connection
        if not self.hurried:  # whoever stops the arm must not be far behind it
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _NEAR)
        self._lock = threading.RLock()
        self._unsent, self._stuck_since = b"", 0.0
        self.closed = threading.Event()

    def serve(self) -> None:
        """Take in what comes until the client leaves."""
        with contextlib.suppress(OSError):
            self.greet()
            for data in received(self._socket, self.cell.faults):
                self.hear(data)
        self.close()
        self.leave()

    def greet(self) -> None:
        """What is said before the client says anything."""

    def hear(self, data: bytes) -> None:
        """What the client said."""

    def leave(self) -> None:
        """The client is gone."""

    def say(self, data: bytes, waits: bool = False) -> None:
        """Send, or close where that fails. `waits`: the cell waits for the client, as only a simulated one can."""
        try:
            self.cell.faults.send(data, self._send_all if waits else self._send, self.close, spare=False)
        except OSError:
            self.close()

    def stream(self, data: bytes, drops: bool = False) -> None:
        """Send samples, but none while older ones are on their way. `drops`: who reads none at all is dropped."""
        try:
            self._send(b"")
        except OSError:
            self.close()
        if not self._unsent:
            self.say(data)
        elif drops and time.monotonic() - self._stuck_since > SEND_LIMIT:
            self.close()

    def close(self) -> None:
        """End the connection."""
        self.closed.set()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    @property
    def hurried(self) -> bool:
        """Whether time passes for the cell while a client does not read."""
        return not isinstance(self.cell.clock, FastClock)

    def _send_all(self, data: bytes) -> None:
        with self._lock:
            data, self._unsent = self._unsent + data, b""
            self._socket.sendall(data)

    def _send(self, data: bytes) -> None:
        with self._lock:
            if not self._unsent:
                self._stuck_since = time.monotonic()
            self._unsent += data
            with contextlib.suppress(BlockingIOError):
                while self._unsent:  # a socket with a timeout does not block at this level
                    self._unsent = self._unsent[os.write(self._socket.fileno(), self._unsent) :]


class ScriptConnection(UrConnection):
    """Ports 30001, 30002 and 30003: scripts in, and state out but for the last, whose record is not simulated.

    After a turn to local mode nothing is taken any more.
    """

    def __init__(self, cell: UrCell, connection: socket.socket, realtime: bool) -> None:
        super().__init__(cell, connection)
        self._realtime = realtime
        self._writable = cell.remote
        self._next = 0.0
        self._text = ""

    def greet(self) -> None:
        version = version_message(self.cell)
        with self._lock:  # who has read the version misses nothing, and nothing comes before it
            self.cell.listeners.append(self)
            if not self._realtime:
                self.say(version)
        self.cell.when_local.append(self.close)

    def leave(self) -> None:
        with contextlib.suppress(ValueError):
            self.cell.listeners.remove(self)
            self.cell.when_local.remove(self.close)

    def on_cycles(self, cycles: Cycles) -> None:
        if self._realtime or self.cell.mute:
            return
        if cycles.time[-1] >= self._next or cycles.time[-1] < self._next - 1.0:
            self._next = cycles.time[-1] + _STATE_PERIOD
            self.stream(state_message(cycles))

    def on_message(self, message: bytes) -> None:
        if not self._realtime:
            self.say(message)

    def hear(self, data: bytes) -> None:
        self._text += data.decode("latin-1").replace("\r\n", "\n")
        if len(self._text) > _LONGEST_SCRIPT:
            self.close()
        while (script := self._next_script()) is not None:
            if not self._writable:
                self.say(
                    error_message(self.cell.time, 210, 0, 2, "Socket is read-only when the robot is in local mode")
                )
            elif script.strip() and not self._command(script.strip()):
                self.cell.take_script(script)

    def _next_script(self) -> str | None:
        """The next whole script or line, if there is one."""
        if not self._text.startswith(("def ", "sec ")):
            line, newline, remainder = self._text.partition("\n")
            if newline:
                self._text = remainder
            return line if newline else None
        lines = self._text.split("\n")
        for k, line in enumerate(lines[:-1]):
            if line.rstrip() == "end":
                self._text = "\n".join(lines[k + 1 :])
                return "\n".join(lines[: k + 1])
        return None

    def _command(self, line: str) -> bool:
        """Whether it is one of the lines that are no script, which are carried out at once."""
        commands: dict[str, Callable[[], object]] = {
            "stop program": self.cell.stop_program,
            "power on": lambda: self.cell.power(drives_on=False, idle=True),
            "power off": lambda: self.cell.power(drives_on=False, idle=False),
            "set robotmode run": lambda: self.cell.power(drives_on=True, idle=False),
            "set unlock protective stop": self.cell.unlock,
        }
        if line in commands:
            commands[line]()
        return line in commands


class DashboardConnection(UrConnection):
    """Port 29999: a line asked, a line answered. What acts needs remote mode since the client has connected."""

    def __init__(self, cell: UrCell, connection: socket.socket) -> None:
        super().__init__(cell, connection)
        self._trusted = cell.remote
        self._line = b""

    def greet(self) -> None:
        self.say(b"Connected: Universal Robots Dashboard Server\n")

    def hear(self, data: bytes) -> None:
        self._line += data
        while b"\n" in self._line:
            line, _, self._line = self._line.partition(b"\n")
            command = line.decode("latin-1").strip()
            if command:
                self.cell.hurry()
                self.say((self._answer(command) + "\n").encode("latin-1", "replace"))
            if command == "quit":
                self.close()

    def _answer(self, command: str) -> str:
        cell = self.cell
        if command.startswith(_ACTING) and not (cell.remote and self._trusted):
            return _FORBIDDEN
        word = next((word for word in _WITH_TEXT if command.startswith(word)), command)
        since, answer = _ANSWERS.get(word, ((99,), None))
        if answer is None or cell.version < since:
            return f"Could not understand: '{command}'"
        reply = answer(cell) if callable(answer) else answer
        return reply.format(command.removeprefix(word))


def _power(cell: UrCell, on: bool) -> str:
    cell.power(drives_on=cell.state.drives_on and on, idle=on)
    return f"Powering {'on' if on else 'off'}"


def _release(cell: UrCell) -> str:
    cell.power(drives_on=cell.idle or cell.state.drives_on, idle=False)
    return "Brake releasing"


def _stop(cell: UrCell) -> str:
    if not cell.running:
        return "Failed to execute: stop"
    cell.stop_program()
    return "Stopped"


_ALWAYS, _CB3, _E_SERIES, _REMOTE = (0,), (3, 12), (5,), (5, 6)
#: Commands of the dashboard: the first version that has one, and its answer.
_ANSWERS: dict[str, tuple[tuple[int, ...], str | Callable[[UrCell], str]]] = {
    "PolyscopeVersion": (_ALWAYS, lambda cell: "URSoftware {}.{}.{}.{} (Nov 18 2021)".format(*cell.version)),
    "get serial number": (_CB3, lambda cell: cell.serial),
    "get robot model": (_CB3, lambda cell: cell.model),
    "robotmode": (_ALWAYS, lambda cell: f"Robotmode: {_ROBOT_MODES[cell.robot_mode]}"),
    "safetymode": (_ALWAYS, lambda cell: f"Safetymode: {_SAFETY[cell.safety_mode]}"),
    "safetystatus": (_E_SERIES, lambda cell: f"Safetystatus: {_SAFETY[cell.safety_mode]}"),
    "is in remote control": (_REMOTE, lambda cell: str(cell.remote).lower()),
    "get operational mode": (_E_SERIES, lambda cell: "AUTOMATIC" if cell.remote else "MANUAL"),
    "running": (_ALWAYS, "Program running: false"),  # of .urp programs, which this controller has none of
    "programState": (_ALWAYS, "STOPPED"),
    "get loaded program": (_ALWAYS, "No program loaded"),
    "isProgramSaved": (_ALWAYS, "False"),
    "close popup": (_ALWAYS, "closing popup"),
    "close safety popup": (_ALWAYS, "closing safety popup"),
    "popup ": (_ALWAYS, "showing popup"),
    "addToLog ": (_ALWAYS, "Added log message"),
    "quit": (_ALWAYS, "Disconnected"),
    "load ": (_ALWAYS, "File not found: {}"),
    "play": (_ALWAYS, lambda cell: "Starting program" if cell.pause(False) else "Failed to execute: play"),
    "pause": (_ALWAYS, lambda cell: "Pausing program" if cell.pause(True) else "Failed to execute: pause"),
    "stop": (_ALWAYS, _stop),
    "power on": (_ALWAYS, lambda cell: _power(cell, on=True)),
    "power off": (_ALWAYS, lambda cell: _power(cell, on=False)),
    "brake release": (_ALWAYS, _release),
    "unlock protective stop": (_ALWAYS, lambda cell: "Protective stop releasing" if cell.unlock() else _TOO_EARLY),
    "restart safety": (_ALWAYS, "Restarting safety"),
}
#: Commands with a text behind them.
_WITH_TEXT = tuple(command for command in _ANSWERS if command.endswith(" "))
