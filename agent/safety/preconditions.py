"""What must be true before a robot moves. Reads, never sets."""

from __future__ import annotations

from agent.errors import ControllerError, InputError, SafetyError
from agent.robot import RobotDescription
from drivers.protocol import Identity, Status


def check_identity(identity: Identity, robot: RobotDescription, address: str) -> None:
    """The controller at this address drives the robot of the recipe.

    Raises:
        ControllerError: another robot, or other joints.
    """
    if identity.robot != robot.name:
        raise ControllerError(
            f"{address}: the controller drives {identity.robot!r} (serial {identity.serial}), the recipe is for "
            f"{robot.name!r}: check controller.address, or the recipe's robot"
        )
    if len(identity.joint_names) != robot.dof:
        raise ControllerError(
            f"{address}: the controller has {len(identity.joint_names)} joints, {robot.name} has {robot.dof}"
        )


def check_ready(status: Status, address: str, program: str, checksum: str) -> None:
    """Drives, mode, alarms, override, cell and stored program allow motion.

    Raises:
        SafetyError: the emergency stop is pressed.
        ControllerError: anything else that is not as it must be; all of it is listed.
    """
    if status.emergency_stop:
        raise SafetyError(f"{address}: the emergency stop is pressed; release it, reset the drives and start again")
    faults = []
    if status.mode != "auto":
        faults.append(f"mode is {status.mode!r}; turn the selector to auto")
    if status.alarms:
        faults.append(f"alarms are active ({', '.join(status.alarms)}); clear them")
    if not status.drives_on:
        faults.append("the drives are off; switch them on")
    if not status.cell_closed:
        faults.append("the cell is open; close the gate")
    if abs(status.override - 1.0) > 1e-6:
        faults.append(f"the override is {100 * status.override:.0f} %; set it to 100 %, the motion is planned for that")
    if status.moving:
        faults.append("the arm is moving already; wait for it, or stop it")
    if (status.program, status.checksum) != (program, checksum):
        faults.append(f"the stored program is {status.program!r}, not the {program!r} that was sent")
    if faults:
        raise ControllerError(f"{address}: not ready to move: " + "; ".join(faults))


def is_loopback(address: str) -> bool:
    """Whether an address of the form host:port is on this machine."""
    host = address.rsplit(":", 1)[0].strip("[]")
    return host in ("localhost", "::1") or host.startswith("127.")


def needs_person(status: Status, address: str) -> bool:
    """Whether somebody has to say that the cell is clear: always, but for the emulator on loopback."""
    return not (status.emulator and is_loopback(address))


def not_confirmed(address: str) -> InputError:
    """The error when nobody said yes."""
    return InputError(
        f"{address}: nobody confirmed that the cell is clear, so nothing was moved; answer the question on a terminal, "
        "or give --yes"
    )
