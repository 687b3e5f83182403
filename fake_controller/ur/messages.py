"""What the primary interface sends: big-endian, each message with its length before it."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from fake_controller.ur.fields import Cycles
from fake_controller.ur.state import UrState

_STATE, _MESSAGE = 16, 20
_ROBOT_SOURCE = -2


def state_message(cycles: Cycles) -> bytes:
    """Robot mode, joints, kinematics and configuration, of the last cycle."""
    cell, last = cycles.cell, cycles.part(slice(-1, None))
    return _framed(_STATE, _mode(cell, last) + _joints(last) + _kinematics(cell) + _configuration(cell))


def version_message(cell: UrState) -> bytes:
    """Who speaks."""
    major, minor, bugfix, build = cell.version
    name = b"URControl"
    date = b"18-11-2021, 00:00:00"
    return _message(
        cell.time, 3, struct.pack(">b", len(name)) + name + struct.pack(">BBii", major, minor, bugfix, build) + date
    )


def text_message(time: float, text: str) -> bytes:
    """What textmsg says."""
    return _message(time, 0, text.encode("latin-1", "replace"))


def error_message(time: float, code: int, argument: int, level: int, text: str) -> bytes:
    """CcodeAargument: a warning, a violation, a fault."""
    return _message(time, 6, struct.pack(">iiiII", code, argument, level, 0, 0) + text.encode("latin-1", "replace"))


def key_message(time: float, title: str, text: str) -> bytes:
    """That a program was started or has stopped."""
    return _message(time, 7, struct.pack(">iiB", 0, 0, len(title)) + title.encode() + text.encode("latin-1", "replace"))


def exception_message(time: float, line: int, column: int, text: str) -> bytes:
    """An error of a script, found as it is compiled or while it runs."""
    return _message(time, 10, struct.pack(">II", line, column) + text.encode("latin-1", "replace"))


def _message(time: float, kind: int, data: bytes) -> bytes:
    return _framed(_MESSAGE, struct.pack(">QbB", round(time * 1e6), _ROBOT_SOURCE, kind) + data)


def _framed(kind: int, data: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(data), kind) + data


def _mode(cell: UrState, last: Cycles) -> bytes:
    state = cell.state
    flags = (
        not state.emulator,
        state.drives_on,
        cell.robot_mode >= 5,
        state.emergency_stop,
        cell.protected,
        cell.running,
        cell.runtime_state in (3, 4),
    )
    numbers = struct.pack(">bBddd", cell.robot_mode, 0, state.override, 1.0, 1.0)
    return _framed(0, struct.pack(">Q7?", max(round(float(last.time[0]) * 1e6), 0), *flags) + numbers + b"\0")


def _joints(last: Cycles) -> bytes:
    current = last.field("actual_current")[0]
    temperature = np.broadcast_to(last.field("joint_temperatures"), 6)
    modes = last.field("joint_mode")
    rows = zip(last.actual_q[0], last.target_q[0], last.actual_qd[0], current, temperature, modes, strict=True)
    return _framed(
        1, b"".join(struct.pack(">dddffffB", q, t, qd, i, 48.0, c, c, mode) for q, t, qd, i, c, mode in rows)
    )


def _kinematics(cell: UrState) -> bytes:
    table = cell.kinematics
    numbers = np.concatenate([table.theta, table.a, table.d, table.alpha])
    return _framed(5, struct.pack(">6I", *[0xFFFFFFFF] * 6) + struct.pack(">24d", *numbers) + struct.pack(">I", 1))


def _configuration(cell: UrState) -> bytes:
    robot, table = cell.robot, cell.nominal
    lower, upper = (np.clip(limit, -2 * np.pi, 2 * np.pi) for limit in robot.position_limits)
    limits = [
        *np.transpose([lower, upper]).ravel(),
        *np.transpose([robot.max_velocity, robot.max_acceleration]).ravel(),
    ]
    defaults = [1.05, 1.4, 0.25, 1.2, 0.1]  # joint speed and acceleration, tool speed and acceleration, radius
    nominal: list[Any] = [*table.a, *table.d, *table.alpha, *table.theta]
    return _framed(6, struct.pack(">53d4i", *limits, *defaults, *nominal, 1, 0, cell.robot_type, 0))
