"""Reason codes that a controller gives, the same on every wire."""

from __future__ import annotations

from enum import IntEnum

from drivers.errors import RefusedError, SafetyRefused


class Refusal(IntEnum):
    """Why a request was refused. Nothing has moved and nothing was stored because of it."""

    BAD_REQUEST = 1  # the request itself makes no sense: a field out of its range, a message out of order
    UNKNOWN_MESSAGE = 2
    UNSUPPORTED_VERSION = 3
    BUSY = 4  # another client holds the controller
    MOVING = 5  # not while the arm moves
    SYNTAX = 6  # the program text is not a program; line and column say where
    CHECKSUM = 7  # the stored text is not the text that the checksum belongs to
    UNKNOWN_PROGRAM = 8
    REPEATED_MOTION = 9  # this motion id was used before: the command is not carried out twice
    MEMORY_FULL = 10
    TOO_LARGE = 11
    NOT_AVAILABLE = 12  # the samples asked for are not in the ring any more
    MOTION = 13  # the program cannot be run: out of reach, beyond a limit
    EMERGENCY_STOP = 14
    DRIVES_OFF = 15
    TEACH_MODE = 16
    ALARM = 17
    CELL_OPEN = 18
    INTERNAL = 19


class EndReason(IntEnum):
    """Why a motion ended. The arm is stationary in every case."""

    DONE = 0
    STOPPED = 1  # by a stop command
    WATCHDOG = 2  # the controller heard nothing from the client for the agreed time
    EMERGENCY_STOP = 3
    DRIVE_FAULT = 4
    PROTECTIVE_STOP = 5
    OVERRIDE_CHANGED = 6
    ALARM = 7
    PROGRAM_ERROR = 8  # a later statement could not be carried out; the message says which
    SHUTDOWN = 9  # the controller goes down
    MODE_CHANGED = 10  # the selector was turned away from auto


SAFETY_ENDS = frozenset(
    {
        EndReason.EMERGENCY_STOP,
        EndReason.DRIVE_FAULT,
        EndReason.PROTECTIVE_STOP,
        EndReason.OVERRIDE_CHANGED,
        EndReason.ALARM,
        EndReason.MODE_CHANGED,
    }
)


def refusal_error(peer: str, what: str, code: int, line: int, column: int, message: str) -> RefusedError:
    """A refusal for people: its reason, the position in the program (0: none), the controller's own words."""
    try:
        reason = Refusal(code).name.lower().replace("_", " ")
    except ValueError:
        reason = f"reason {code}"
    position = f", line {line} column {column}" if line else ""
    kind = SafetyRefused if code == Refusal.EMERGENCY_STOP else RefusedError
    return kind(f"the controller at {peer} refused {what}: {reason}{position}: {message}")
