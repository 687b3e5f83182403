"""Reads a simulator's file: format, joints, and the model made from it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from agent.core import LARGEST_ROBOT_FILE, InputError, counted, read_bytes
from agent.model import IdentifiedModel
from agent.recording import joint_pairs, named_joints, prefixed
from agent.robot import RobotDescription, is_gripper, parse_robot_file
from agent.simulators.arm import SimulatedArm, described, model_of
from agent.simulators.joints import Branches, Match, matched
from agent.simulators.mjcf import read_mjcf
from agent.simulators.urdf import read_urdf

_GRAVITY = (0.0, 0.0, -9.80665)
_MOST_JOINTS = 7
_ONE_ARM = "write a robot.yaml with tip_frame and joints of one arm (docs/how-to-robot.md), and name it with --robot"


@dataclass(frozen=True, eq=False)
class Simulator:
    """A simulator's file, its model, the description that gave the drives, and notes on what was held or left out."""

    arm: SimulatedArm
    model: IdentifiedModel
    robot: RobotDescription | None
    notes: tuple[str, ...]


def is_simulator(path: Path) -> bool:
    """Whether a file name is that of an MJCF, a URDF or their sources, not of a model of this program."""
    return path.suffix.lower() in (".xml", ".urdf", ".mjcf", ".xacro", ".sdf")


def load_simulator(
    path: Path,
    robot: RobotDescription | None,
    log_joints: Sequence[str],
    names: Mapping[str, str | None] | None = None,
) -> Simulator:
    """Read an MJCF or URDF. Its joints are matched to those of `robot`, or of the logs where there is none.

    `names` maps joints of the file to them where they are called otherwise.

    Args:
        path: MJCF or URDF.
        robot: description of the arm; None: the file's own.
        log_joints: names of joints in the logs.
        names: joint of the file → joint of the arm, None for one that is left out.

    Raises:
        InputError: a file that cannot be read or used, of another arm, or whose joints don't match.
    """
    text, root = _content(path)
    wanted = tuple(log_joints) if robot is None else robot.joint_names
    owner, gravity = ("the logs", _GRAVITY) if robot is None else (f"robot {robot.name}", robot.gravity)

    def match(in_file: Sequence[str], branches: Branches) -> dict[str, str]:
        matches = matched(path, in_file, wanted, owner, names, lambda: _arms(branches, lambda name: True))
        chosen = {name for name, called in (names or {}).items() if called is not None}
        arms = [arm for arm in _arms(branches, lambda name: name in matches) if chosen <= {*arm}] if chosen else []
        return {name: matches[name] for name in in_file if name in arms[0]} if arms else matches

    arm = _arm(path, root, match, gravity)
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
    description, remarks = described(arm, robot)
    provenance: dict[str, object] = {"simulator": path.name, "sha256": hashlib.sha256(text).hexdigest()}
    model = model_of(arm, description, provenance)
    uncompared = [name for name in wanted if name not in arm.joint_names]
    why = "the file has no such joint" if names is None else "the map leaves it out"
    ignored = (f"not compared of the logs: {', '.join(uncompared)} ({why})",) if uncompared else ()
    return Simulator(arm, model, robot, (*arm.notes, *remarks, *ignored))


def load_arm_of(path: Path, columns: Sequence[str]) -> RobotDescription:
    """The arm in a URDF or MJCF whose joints columns name, or the only one with as many joints, grippers not counted.

    Raises:
        InputError: a file that cannot be read or used, several arms that may be meant, or another number of joints.
    """
    root = _content(path)[1]

    def match(in_file: Sequence[str], branches: Branches) -> dict[str, str]:
        named = named_joints(columns, in_file)
        if named is not None:
            return {name: name for name in in_file if name in named}
        arms = _arms(branches, lambda name: not is_gripper(name))
        fitting = [arm for arm in arms if len(arm) == len(columns)]
        if len(fitting) == 1:
            return {name: name for name in fitting[0]}
        listed = "; ".join(", ".join(arm) for arm in fitting or arms) or "none"
        raise InputError(
            f"{path}: the joints are {listed}. The names of the {counted(len(columns), 'column')} "
            f"({', '.join(columns)}) do not say which they are of: name columns after their joints, or {_ONE_ARM}"
        )

    return described(_arm(path, root, match, _GRAVITY), None)[0]


def load_arm(path: Path, log_joints: Sequence[str] = (), most: int = _MOST_JOINTS) -> RobotDescription:
    """The description of the arm in a URDF or MJCF: gear ratios of 1 and no nominal torques.

    Its joints are those of the logs; where there are none, the longest chain of joints that all move on their own, of
    which the first `most` are taken.

    Args:
        path: MJCF or URDF.
        log_joints: names of the joints in the logs.
        most: joints that are taken of a chain without logs.

    Raises:
        InputError: a file that cannot be read or used, or none of its joints is in the logs.
    """
    root = _content(path)[1]

    def match(in_file: Sequence[str], branches: Branches) -> dict[str, str]:
        if log_joints:
            pairs = joint_pairs(in_file, log_joints) or prefixed(in_file, log_joints)
            chain = {name: pairs[name] for name in in_file if name in pairs}
            if len(arms := _arms(branches, lambda name: name in chain)) > 1:
                listed = "; ".join(", ".join(arm) for arm in arms)
                raise InputError(f"{path}: the log has joints of several of its arms ({listed}): {_ONE_ARM}")
        else:
            chain = {name: name for name in max(branches(), key=len, default=[])}
        if not chain:
            listed = f"; those of the log are {', '.join(log_joints)}" if log_joints else ""
            raise InputError(
                f"{path}: none of its joints moves the arm ({', '.join(in_file) or 'it has none'}){listed}"
            )
        return dict(list(chain.items())[:most])

    return described(_arm(path, root, match, _GRAVITY), None)[0]


def _arms(branches: Branches, takes: Callable[[str], bool]) -> list[tuple[str, ...]]:
    """Joints of the branches that it takes, base to tip, without branches that are part of another."""
    arms = {tuple(name for name in branch if takes(name)): None for branch in branches()}
    return [arm for arm in arms if arm and not any(set(arm) < set(other) for other in arms)]


def _content(path: Path) -> tuple[bytes, Element]:
    text = read_bytes(path, LARGEST_ROBOT_FILE)
    return text, parse_robot_file(path, text)


def _arm(
    path: Path,
    root: Element,
    match: Match,
    gravity: tuple[float, float, float],
) -> SimulatedArm:
    return read_urdf(path, root, match, gravity) if root.tag == "robot" else read_mjcf(path, root, match)
