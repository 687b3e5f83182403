"""Conditions for motion. Reads the controller, never changes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from ipaddress import ip_address

import numpy as np

from agent.core import ControllerError, InputError, MismatchError, SafetyError, and_list
from agent.robot import RobotDescription
from agent.safety.planned_program import PlannedProgram
from drivers.protocol import Driver, Identity, MeasuresThroughput, ReportsFrames, Status

#: The arm may stand so far from where its plan begins: servo error and sag, not a jog [rad, or m].
START_TOLERANCE = 0.02
#: Frames this near are the same [m, and of the rotation's entries]: what a four-byte number keeps of millimetres.
SAME_FRAME = 1e-5
_MEASURED = 3  # times, at most, before a link is too slow


def check_identity(identity: Identity, robot: RobotDescription, address: str) -> None:
    """The controller at this address drives the robot of the recipe.

    Args:
        identity: what the controller says it is.
        robot: of the recipe.
        address: named in messages.

    Raises:
        MismatchError: another robot, or other joints.
    """
    if identity.robot != robot.name:
        raise MismatchError(
            f"{address}: the controller drives {identity.robot!r} (serial {identity.serial}), the recipe is for "
            f"{robot.name!r}: check controller.address, or the recipe's robot"
        )
    if len(identity.joint_names) != robot.dof:
        raise MismatchError(
            f"{address}: the controller has {len(identity.joint_names)} joints, {robot.name} has {robot.dof}"
        )
    if tuple(identity.joint_names) != tuple(robot.joint_names):
        raise MismatchError(
            f"{address}: the controller calls its joints {', '.join(identity.joint_names)}, {robot.name} has "
            f"{', '.join(robot.joint_names)}, in that order: correct the robot description, or what the link reports"
        )


def check_period(identity: Identity, rate: float, address: str) -> None:
    """The controller samples at the recipe's rate [Hz].

    Args:
        identity: what the controller says of itself.
        rate: of the recipe [Hz].
        address: of the controller, for messages.

    Raises:
        MismatchError: it does not.
    """
    if not abs(identity.period * rate - 1.0) <= 1e-6:
        raise MismatchError(
            f"{address}: the controller samples every {1000 * identity.period:g} ms, the recipe asks for {rate:g} Hz: "
            "change record.rate"
        )


def check_throughput(driver: Driver, identity: Identity, address: str) -> None:
    """The link carries the samples as fast as the controller makes them: what comes late, nobody can watch.

    Args:
        driver: connected.
        identity: what the controller says of itself.
        address: of the controller, for messages.

    Raises:
        ControllerError: it does not.
    """
    if not isinstance(driver, MeasuresThroughput):
        return
    made = 1.0 / identity.period
    for _ in range(_MEASURED):  # a computer with other work holds one up
        carried = driver.throughput()
        if carried >= made:
            return
    raise ControllerError(
        f"{address}: this link carries {carried:.0f} samples/s now, the controller makes {made:.0f}: the arm would "
        "move unwatched. Use a faster link (TCP, fewer hops), then run the command again"
    )


def check_ready(status: Status, address: str, program: str, checksum: str) -> None:
    """Drives, mode, alarms, override, cell and stored program allow motion.

    Raises:
        SafetyError: the emergency stop is pressed.
        ControllerError: anything else that is not as it must be; all of it is listed.
    """
    if status.emergency_stop:
        raise SafetyError(f"{address}: the emergency stop is pressed; release it, reset the drives and start again")
    faults = [before for before, _ in _forbidden_states(status)]
    if status.moving:
        faults.append("the arm is moving already; wait for it, or stop it")
    if (status.program, status.checksum) != (program, checksum):
        faults.append(f"the stored program is {status.program!r}, not the {program!r} that was sent")
    if faults:
        raise ControllerError(f"{address}: not ready to move: {'; '.join(faults)}; then run the command again")


def reported_position(status: Status, robot: RobotDescription, address: str) -> np.ndarray:
    """(n,) where the arm stands.

    Raises:
        ControllerError: the controller tells positions of another number of joints, or none that is a number.
    """
    position = np.asarray(status.position, dtype=float)
    if position.shape != (robot.dof,) or not np.isfinite(position).all():
        raise ControllerError(
            f"{address}: the controller does not say where its {robot.dof} joints stand (it tells "
            f"{np.isfinite(position).sum()} numbers); check the link, then run the command again"
        )
    return position


def check_plan(program: PlannedProgram, robot: RobotDescription, position: np.ndarray, address: str) -> None:
    """What we planned keeps the robot's limits and begins where the arm stands.

    Args:
        position: (n,) of the arm now.

    Raises:
        ControllerError: the arm stands elsewhere.
        InputError: a limit is broken.
    """
    if not program.chains:
        return
    lower, upper = robot.position_limits
    for chain in program.chains:
        if not (np.isfinite(chain.q).all() and np.isfinite(chain.qd).all()):
            raise InputError(f"program {program.name}: its plan has values that are no numbers; nothing was moved")
        outside = ~np.all((chain.q >= lower - 1e-9) & (chain.q <= upper + 1e-9), axis=0)
        fast = ~np.all(np.abs(chain.qd) <= robot.max_velocity * (1 + 1e-6), axis=0)
        for broken, what in ((outside, "position limits"), (fast, "speed limit")):
            if broken.any():
                names = ", ".join(np.array(robot.joint_names)[broken])
                raise InputError(f"program {program.name}: {names} would leave the {what}; plan again, more slowly")
    off = np.abs(program.chains[0].q[0] - position)
    if not np.all(off <= START_TOLERANCE):
        joint = robot.joint_names[int(np.argmax(off))]
        if np.all(np.abs(np.radians(position) - program.chains[0].q[0]) <= START_TOLERANCE):
            raise ControllerError(
                f"{address}: the position of the arm fits its plan in degrees, where radians are expected: check the "
                "unit of the link"
            )
        raise ControllerError(
            f"{address}: the arm does not stand where its plan begins: {joint} is off by {off.max():.3f} rad. It was "
            "moved since; run the command again, it is planned anew from where the arm stands"
        )


def check_frames(program: str, frames: Mapping[str, np.ndarray], driver: Driver, address: str) -> None:
    """The controller has the `frames` (4, 4) [m], by name, that the plan of a program takes for granted.

    Args:
        program: its text.
        frames: by name (4, 4) [m], as the plan takes them.
        driver: link to the controller.
        address: named in messages.

    Raises:
        ControllerError: it has others; the message names both.
        InputError: the program leaves them open, and this link cannot read them.
    """
    if not frames:
        return
    reported = driver.frames() if isinstance(driver, ReportsFrames) else {}
    if not frames.keys() <= reported.keys():
        missing = and_list(list(frames))
        lines = "; ".join(f"{name} := {pos_text(frame)}" for name, frame in frames.items())
        raise InputError(
            f"{address}: program {program} does not set {missing}, so its way depends on what ran before it, "
            f"and this link cannot read that. Set it before the first move; the plan was made for {lines}"
        )
    wrong = [
        f"{name} is {pos_text(reported[name])}, the plan is for {pos_text(frame)}"
        for name, frame in frames.items()
        if not np.abs(reported[name] - frame).max() <= SAME_FRAME
    ]
    if wrong:
        raise ControllerError(
            f"{address}: not ready to move: at the controller {'; '.join(wrong)}. Set it there, or change the recipe's "
            "tool; then run the command again"
        )


def pos_text(frame: np.ndarray) -> str:
    """A frame (4, 4) [m] as PDL2 has it, in mm and degrees."""
    from agent.motion import pose_to_pos

    fields = pose_to_pos(frame).round(3) + 0.0
    return f"POS({', '.join(f'{value:g}' for value in fields)}, '')"


def frames_text(frames: Mapping[str, np.ndarray]) -> str:
    """All of them, for a person."""
    return ", ".join(f"{name} {pos_text(frame)}" for name, frame in frames.items())


def unsafe_in_motion(status: Status) -> str | None:
    """Why an arm that moves has to stop now, and what to do; None if all is as it was at the start."""
    if status.emergency_stop:
        return "the emergency stop was pressed; release it, reset the drives, then run the command again"
    return next((f"{in_motion}, then run the command again" for _, in_motion in _forbidden_states(status)), None)


def _forbidden_states(status: Status) -> Iterator[tuple[str, str]]:
    """What forbids motion but the emergency stop: as it is reported before a start, and of an arm that moves."""
    if not status.drives_on:
        yield "the drives are off; switch them on", "the drives went off; look for the fault at the controller"
    if status.alarms:
        named = ", ".join(status.alarms)
        yield f"alarms are active ({named}); clear them", f"alarms came up ({named}); clear them"
    if not status.cell_closed:
        yield "the cell is open; close the gate", "the cell was opened; close the gate"
    if status.mode != "auto":
        what = f"{status.mode!r}; turn the selector to auto"
        yield f"mode is {what}", f"the mode was changed to {what}"
    if not abs(status.override - 1.0) <= 1e-6:
        what = f"{100 * status.override:.0f} %; set it to 100 %"
        yield f"the override is {what}, the motion is planned for that", f"the override was changed to {what}"


def is_loopback(address: str) -> bool:
    """Whether an address, host:port or a host with options after commas, is on this machine."""
    first = address.split(",", 1)[0]
    host = (first.rpartition(":")[0] or first).strip("[]")
    try:
        return ip_address(host).is_loopback
    except ValueError:  # a name: only the one that is this machine everywhere
        return host == "localhost"


def confirm_clear_cell(identity: Identity, status: Status, address: str, ask: Callable[[str], bool]) -> None:
    """A person confirms that the cell is clear: always asked for, but for the emulator on loopback.

    Raises:
        InputError: nobody said yes.
    """
    if status.emulator and is_loopback(address):
        return
    clear = "This link cannot read the override. Is the cell clear, and the override at 100 %?"
    if status.override_known:
        clear = "Is the cell clear?"
    if not ask(f"{identity.robot} (serial {identity.serial}) at {address} is about to move. {clear}"):
        raise InputError(
            f"{address}: nobody confirmed that the cell is clear, so nothing was moved; answer the question on a "
            "terminal, or give --yes"
        )
