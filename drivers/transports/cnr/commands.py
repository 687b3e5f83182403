"""Starts and stops on CNR's link: by the socket, or by a person at the teach pendant."""

from __future__ import annotations

import time
from collections.abc import Callable

from drivers.errors import DriverError, RefusedError, SafetyRefused
from drivers.transports.cnr.motion import HAND_REST, CnrMotion, stop_reason
from drivers.transports.cnr.sockets import CommandReply, Sockets
from drivers.wire import cnr as wire
from drivers.wire.cnr import MessageType, Point
from drivers.wire.reasons import EndReason

_STOP_AGAIN = 0.05  # s between two stop commands of which the first was not taken
_HAND_TIMEOUT = 600.0  # s for somebody to press START


def command_start(
    sockets: Sockets, host: str, what: str, point: Point, timeout: float, motion: CnrMotion | None
) -> CommandReply | None:
    """The answer to a start that was carried out; None where the arm moves and no answer came.

    Raises:
        RefusedError: it was not; nothing has moved.
        DriverError: no answer.
    """
    rested = motion is not None and not motion.begun  # later on, that it moves says nothing of this start

    def acts() -> bool:
        return rested and motion is not None and motion.begun

    answer = sockets.command(MessageType.START, point, timeout, acts)
    if answer is None and acts():
        return None  # it is time to watch it, whatever became of the answer
    if answer is None:
        raise DriverError(
            f"the controller at {host} did not answer {what} within {timeout:g} s; the "
            "link was closed, which stops the arm. Go and look at it"
        )
    if not answer.success:
        state = sockets.fresh_status()
        if sockets.feedback().is_moving:
            raise DriverError(
                f"the controller refused {what}, because the arm moves already; it was told to stop. Do its "
                "programs take back the permission to move at the end of a trajectory, as docs/real-robot.md asks?"
            )
        raise _refused_start(what, state, point.sequence_number != 0)
    return answer


def wait_for_a_person(sockets: Sockets, motion: CnrMotion, name: str, tell: Callable[[str], None]) -> None:
    """Ask for START at the pendant, and wait until the arm moves.

    Raises:
        DriverError: nobody came.
    """
    tell(
        f"at the controller: select program {name}, drives on, selector at auto, and press START within "
        f"{_HAND_TIMEOUT / 60:.0f} minutes. The recording begins with the first motion and ends when the arm has "
        f"rested for {HAND_REST:g} s"
    )
    if not sockets.wait_feedback(lambda: motion.begun, _HAND_TIMEOUT):
        raise DriverError(f"nobody started {name} within {_HAND_TIMEOUT / 60:.0f} minutes; nothing was recorded")


def _refused_start(what: str, state: wire.StatusMessage, stored: bool) -> RefusedError:
    reason = stop_reason(state)
    if reason is None:
        advice = (
            "is the program translated and free of errors, does the trajectory program know how to start a stored one? "
            "(start=hand in the address does without)"
            if stored
            else "was another trajectory left in its queue?"
        )
        return RefusedError(f"the controller refused {what} and does not say why; {advice}")
    kind = SafetyRefused if reason[0] is EndReason.EMERGENCY_STOP else RefusedError
    return kind(f"the controller refused {what}: {reason[1]}")


def insist_on_stop(
    sockets: Sockets,
    motion: CnrMotion,
    stop: MessageType,
    answer: CommandReply | None,
    timeout: float,
    tell: Callable[[str], None] | None,
) -> CommandReply | None:
    """Say it again where the controller did not take it: it does not before its flag says that the arm moves.

    `tell`: says to a person what to do, where one has started the motion.
    """
    until, said = time.monotonic() + timeout, False
    while answer is not None and not answer.success and not motion.wait(_STOP_AGAIN):
        if time.monotonic() > until:
            return answer
        if tell is not None and not said:
            said = True
            tell("the controller does not take the stop command: press HOLD at the teach pendant, now")
        answer = sockets.command(stop)
    return answer
