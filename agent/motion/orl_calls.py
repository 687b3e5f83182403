"""What the orl interpolator needs of a library, whichever calls it exports: the vendor's own or those of our shim.

Millimetres, degrees and percent throughout.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from agent.motion.program import CartesianTarget, Move

#: Environment variables: the library, and for the vendor's own the controller's file (*.c5g) and the arm in it (1..4).
LIBRARY = "CALIBRATION_ORL_LIBRARY"
CONTROLLER = "CALIBRATION_ORL_CONTROLLER"
ARM = "CALIBRATION_ORL_ARM"

OK = 0
#: What a step answers; anything else below zero is an error. NEED_DATA: on the way, and the next move may be announced.
MOVING, NEED_DATA, FINAL, IDLE = 0, 1, 2, -42
#: One move is active and one more is scheduled; a third has to wait for NEED_DATA.
MOST_ANNOUNCED = 2
MOST_JOINTS = 10


class MoveCall(NamedTuple):
    """A move as the controller writes it: joints in degrees (mm where they slide), poses x y z a e r in mm, degrees."""

    move: Move
    start: tuple[float, ...]
    target: tuple[float, ...]
    via: tuple[float, ...]
    base: tuple[float, ...]
    tool: tuple[float, ...]
    uframe: tuple[float, ...]


class CallRefused(Exception):
    """A call with an error status; its text names the call."""


class Calls(Protocol):
    """What the interpolator needs of a library. All but `step` raise `CallRefused` where the library does."""

    def set_period(self, milliseconds: float) -> None: ...
    def announce(self, call: MoveCall, first: bool) -> None: ...
    def step(self, count: int) -> tuple[int, list[float]]: ...
    def cancel(self) -> None: ...


def check_status(call: str, status: int) -> None:
    """Raises CallRefused where a call answers anything but OK."""
    if status != OK:
        raise CallRefused(f"{call}: status {status}")


def configuration_flags(target: CartesianTarget) -> bytes:
    """The target's configuration string, which has 79 characters at most in either library."""
    flags = target.configuration.encode()
    if len(flags) > 79:
        raise CallRefused(f"a configuration of {len(flags)} characters: the library takes 79")
    return flags
