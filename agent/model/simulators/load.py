"""From a file to a simulator: which format, which joints, and the model of it."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from agent.core import InputError
from agent.model.identified import IdentifiedModel
from agent.model.simulators.arm import SimulatedArm, described, model_of
from agent.model.simulators.joints import matched
from agent.model.simulators.servos import PositionServos
from agent.model.simulators.urdf import read_urdf
from agent.robot import RobotDescription

_GRAVITY = (0.0, 0.0, -9.80665)
_MOST_JOINTS = 7


@dataclass(frozen=True, eq=False)
class Simulator:
    """A simulator's file, the model that it is, the description whose drives it has, and what was taken, held or left
    out of the file. `servos`: those of the file whose torque stands for that of logs that have none."""

    arm: SimulatedArm
    model: IdentifiedModel
    robot: RobotDescription | None
    notes: tuple[str, ...]
    servos: PositionServos | None = None


def is_simulator(path: Path) -> bool:
    """Whether a file is, by its name, an MJCF or a URDF and not a model of this program."""
    return path.suffix.lower() in (".xml", ".urdf", ".mjcf")


def load_simulator(
    path: Path,
    robot: RobotDescription | None,
    log_joints: Sequence[str],
    names: Mapping[str, str] | None = None,
) -> Simulator:
    """Read an MJCF or URDF. Its joints are matched to those of `robot`, or of the logs where there is none.

    `names` maps joints of the file to them where they are called otherwise.

    Raises:
        InputError: a file that cannot be read or used, of another arm, or whose joints don't match.
    """
    try:
        text = path.read_bytes()
        root = ElementTree.fromstring(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: not valid XML: {error}") from None
    wanted = tuple(log_joints) if robot is None else robot.joint_names
    match = partial(
        matched,
        path,
        wanted=wanted,
        owner="the logs" if robot is None else f"robot {robot.name}",
        names=names,
    )
    if root.tag == "robot":
        if any("xacro" in element.tag for element in root.iter()):
            raise InputError(f"{path}: a xacro file: turn it into a URDF first (xacro {path.name} > arm.urdf)")
        arm = read_urdf(path, root, match, _GRAVITY if robot is None else robot.gravity)
    elif root.tag == "mujoco":
        from agent.model.simulators.mjcf import read_mjcf

        arm = read_mjcf(path, match)
    else:
        raise InputError(f"{path}: neither an MJCF (<mujoco>) nor a URDF (<robot>): it starts with <{root.tag}>")
    if len(arm.joint_names) > _MOST_JOINTS:
        raise InputError(
            f"{path}: {len(arm.joint_names)} joints are to be compared, and a serial arm has at most "
            f"{_MOST_JOINTS}: name those of the arm with --map"
        )
    if robot is not None and arm.joint_names != robot.joint_names:
        missing = [name for name in robot.joint_names if name not in arm.joint_names]
        how = f"{', '.join(missing)} missing" if missing else f"the file's chain is {', '.join(arm.joint_names)}"
        raise InputError(
            f"{path}: robot {robot.name} has joints {', '.join(robot.joint_names)}; {how}. Leave --robot out to "
            "compare those that there are, or match them with --map"
        )
    description, said = described(arm, robot)
    provenance: dict[str, object] = {"simulator": path.name, "sha256": hashlib.sha256(text).hexdigest()}
    model = model_of(arm, description, provenance)
    left = [name for name in wanted if name not in arm.joint_names]
    ignored = (f"{', '.join(left)} of the logs is not compared: the map leaves it out",) if left else ()
    return Simulator(arm, model, robot, (*arm.notes, *said, *ignored))
