"""A URDF as a simulator. Pinocchio reads links and axes; `dynamics` of a joint gives damping and friction.

Elements of a URDF are read and written here too: poses, inertials, ends of joints; numbers keep every digit.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from scipy.spatial.transform import Rotation

from agent.core import InputError
from agent.model import body_parameters, seen_from
from agent.robot import RobotDescription, about_centre, check_urdf
from agent.simulators.arm import CarryingBody, SimulatedArm, plain_joint, plain_robot
from agent.simulators.joints import Match, leaving_out, listed

_TURN = 6.3  # rad
_MOVABLE = ("revolute", "continuous", "prismatic")


def read_urdf(path: Path, root: Element, match: Match, gravity: tuple[float, float, float]) -> SimulatedArm:
    """The arm of a URDF; joints that `match` leaves out are held at zero.

    Raises:
        InputError: numbers that are none, mimic joints in the arm, or joints that are not one chain.
    """
    elements = {str(joint.get("name")): joint for joint in root.findall("joint")}
    movable = [name for name, joint in elements.items() if joint.get("type") in _MOVABLE]
    used = match(movable, partial(chains_of, root))
    _refuse_followers(path, elements, used)
    check_urdf(path, root, list(used))
    _check_radians(path, root)
    floating = [name for name, joint in elements.items() if joint.get("type") in ("floating", "planar")]
    if floating:
        raise InputError(
            f"{path}: joint {floating[0]!r} is {elements[floating[0]].get('type')}: a fixed base is needed"
        )
    chain = _chain(path, root, used)
    locked = [name for name in movable if name not in used]
    joints = [elements[name] for name in chain]
    for name, element in elements.items():
        element.set("name", used.get(name, name))
    damping, friction, lower, upper, speed = (
        np.array([_number(joint, tag, key, otherwise) for joint in joints])
        for tag, key, otherwise in (
            ("dynamics", "damping", 0.0),
            ("dynamics", "friction", 0.0),
            ("limit", "lower", -np.inf),
            ("limit", "upper", np.inf),
            ("limit", "velocity", 0.0),
        )
    )
    turning = np.array([joint.get("type") == "continuous" for joint in joints]) | ~(lower < upper)
    slides = [joint.get("type") == "prismatic" for joint in joints]
    ends = np.where(turning, -np.inf, lower), np.where(turning, np.inf, upper)
    option = root.find("mujoco/option")
    robot = plain_robot(
        str(root.get("name") or path.stem),
        root,
        end_of(joints[-1], "child"),
        gravity if option is None or not option.get("gravity") else _numbers(option, "gravity").tolist(),
        map(plain_joint, (used[name] for name in chain), slides, *ends, speed),
    )
    return SimulatedArm(
        path=path,
        robot=robot,
        file_joints=tuple(chain),
        armature=np.zeros(len(chain)),
        damping=damping,
        frictionloss=friction,
        impedance=np.ones(len(chain)),
        stiffness=np.zeros(len(chain)),
        rest=np.zeros(len(chain)),
        carrying=tuple(_carrying(root, joint, set(used.values())) for joint in joints),
        notes=(f"{listed(locked)} held at zero: not among the joints compared",) if locked else (),
    )


def chains_of(root: Element) -> list[list[str]]:
    """Joints of every branch, base to tip, without those paired by `mimic`."""
    joints = root.findall("joint")
    paired = {name for j in joints for mimic in j.iter("mimic") for name in (j.get("name"), mimic.get("joint"))}
    return [
        [str(j.get("name")) for j in path if j.get("type") in _MOVABLE and j.get("name") not in paired]
        for path in _paths(root)
    ]


def _paths(root: Element) -> list[list[Element]]:
    """For every joint, the joints from the base to it."""
    by_child = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    paths = []
    for joint in by_child.values():
        path = [joint]
        while (parent := by_child.get(end_of(path[0], "parent"))) is not None and parent not in path:
            path.insert(0, parent)
        paths.append(path)
    return paths


def _check_radians(path: Path, root: Element) -> None:
    """Raise InputError where angles are too large to be radians."""
    for owner in (*root.findall("link"), *root.findall("joint")):
        for origin in owner.iter("origin"):
            if np.abs(_numbers(origin, "rpy", "0")).max() > _TURN:
                raise InputError(
                    f"{path}: {owner.tag} {owner.get('name')!r}: rpy {origin.get('rpy')!r} looks like degrees; a URDF "
                    "has radians"
                )
    limits = {
        str(joint.get("name")): max(abs(_number(joint, "limit", key, 0.0)) for key in ("lower", "upper"))
        for joint in root.findall("joint")
        if joint.get("type") == "revolute"
    }
    degrees = [name for name, limit in limits.items() if 4 * _TURN < limit <= 60 * _TURN]
    if degrees and len(degrees) == len(limits):
        raise InputError(
            f"{path}: limits look like degrees ({degrees[0]!r}: {limits[degrees[0]]:g}); a URDF has radians"
        )


def _refuse_followers(path: Path, elements: Mapping[str, Element], used: Mapping[str, str]) -> None:
    """Raise InputError for used joints that mimic another one, such as fingers of grippers."""
    for name in used:
        mimic = elements[name].find("mimic")
        if mimic is not None:
            leader = mimic.get("joint", "")
            raise InputError(
                f"{path}: joint {name!r} follows {leader!r} (mimic), and joints that all move on their own are "
                f"compared: {leaving_out(used, [joint for joint in used if joint in (name, leader)])}"
            )


def _chain(path: Path, root: Element, used: Mapping[str, str]) -> list[str]:
    """The used joints from base to tip."""
    ways = [[str(joint.get("name")) for joint in joints] for joints in _paths(root)]
    longest = max(ways, key=lambda names: len(set(names) & set(used)))
    chain = [name for name in longest if name in used]
    aside = [name for name in used if name not in longest]
    if aside:
        raise InputError(
            f"{path}: not on the way to {chain[-1]}: {listed(aside)}. One serial arm is compared at a time, without "
            f"other branches: {leaving_out(used, aside)}"
        )
    return chain


def _carrying(root: Element, joint: Element, used: set[str]) -> CarryingBody:
    """The heaviest of the links that a joint carries; joints that are not used are at zero."""
    inertials = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    poses = {end_of(joint, "child"): np.eye(4)}
    for link in (open_ends := list(poses)):
        for other in root.findall("joint"):
            if other.get("name") not in used and end_of(other, "parent") == link:
                poses[end_of(other, "child")] = poses[link] @ pose_of(other.find("origin"))
                open_ends.append(end_of(other, "child"))
    own = {link: _own(inertials.get(link)) for link in poses}
    heaviest = max(poses, key=lambda link: own[link][0])
    pose = poses[heaviest]
    return CarryingBody(heaviest, pose, seen_from(own[heaviest], np.linalg.inv(pose)), heaviest, pose)


def _own(inertial: Element | None) -> np.ndarray:
    """(10,) inertial parameters of an `inertial` element in its link's frame."""
    mass = 0.0 if inertial is None else _number(inertial, "mass", "value", 0.0)
    if inertial is None or mass <= 0:
        return np.zeros(10)
    pose = pose_of(inertial.find("origin"))
    keys = [[f"i{min(a, b)}{max(a, b)}" for b in "xyz"] for a in "xyz"]
    inertia = np.array([[_number(inertial, "inertia", key, 0.0) for key in row] for row in keys])
    return body_parameters(mass, pose[:3, 3], pose[:3, :3] @ inertia @ pose[:3, :3].T)


def _number(owner: Element, tag: str, key: str, otherwise: float) -> float:
    element = owner.find(tag)
    text = None if element is None else element.get(key)
    try:
        return otherwise if text is None else float(text)
    except ValueError:
        raise InputError(f"joint {owner.get('name')!r}: {tag} {key}: a number is expected, not {text!r}") from None


def _numbers(element: Element | None, key: str, otherwise: str = "0 0 0") -> np.ndarray:
    text = None if element is None else element.get(key)
    return np.array([float(word) for word in (text or otherwise).split()])


def digits(*numbers: float) -> str:
    """Numbers with every digit: rounding costs torque."""
    return " ".join(repr(float(number)) for number in numbers)


def child_of(element: Element, name: str) -> Element:
    """The first child of that name, added if missing."""
    child = element.find(name)
    return SubElement(element, name) if child is None else child


def let_pass(root: Element, pair: tuple[str, str]) -> None:
    """Exclude contacts of two bodies of an MJCF."""
    SubElement(child_of(root, "contact"), "exclude", body1=pair[0], body2=pair[1])


def end_of(joint: Element, which: str) -> str:
    """The link at a joint's `parent` or `child`; empty if missing."""
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def moved_links(robot: RobotDescription) -> list[str]:
    """The link that each joint of a description moves."""
    joints = {joint.get("name"): joint for joint in ElementTree.fromstring(robot.urdf).findall("joint")}
    return [end_of(joints[name], "child") for name in robot.joint_names]


def set_inertial(link: Element, block: np.ndarray) -> None:
    """Give a link the inertia (10,), about its frame."""
    inertial, tensor = child_of(link, "inertial"), about_centre(block)
    _put(child_of(inertial, "origin"), xyz=block[1:4] / block[0], rpy=np.zeros(3))
    child_of(inertial, "mass").set("value", digits(block[0]))
    keys = {f"i{'xyz'[i]}{'xyz'[j]}": digits(tensor[i, j]) for i in range(3) for j in range(i, 3)}
    child_of(inertial, "inertia").attrib.update(keys)


def mjcf_inertial(block: np.ndarray) -> dict[str, str]:
    """Attributes of an MJCF's `inertial` element for an inertia (10,) about its body's frame."""
    inertia = about_centre(block)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return {"pos": digits(*block[1:4] / block[0]), "mass": digits(block[0]), "fullinertia": digits(*inertia)}


def move_zero(joint: Element, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Move a joint's origin so that its zero lies `offset` [rad or m] lower; returns (4, 4) before and after."""
    axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
    axis, step = axis / np.linalg.norm(axis), np.eye(4)
    if joint.get("type") == "prismatic":
        step[:3, 3] = -offset * axis
    else:
        step[:3, :3] = Rotation.from_rotvec(-offset * axis).as_matrix()
    before = pose_of(joint.find("origin"))
    after = before @ step
    _put(child_of(joint, "origin"), xyz=after[:3, 3], rpy=rpy_of(after))
    return before, after


def _put(origin: Element, **places: np.ndarray) -> None:
    """Set positions or angles that differ from the written ones; equal ones keep their text."""
    for key, numbers in places.items():
        if np.abs(_numbers(origin, key) - numbers).max() > 1e-14:
            origin.set(key, digits(*numbers))


def pose_of(origin: Element | None) -> np.ndarray:
    """(4, 4) pose of an origin element; identity if missing."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin, "rpy")).as_matrix()
    pose[:3, 3] = _numbers(origin, "xyz")
    return pose


def rpy_of(pose: np.ndarray) -> np.ndarray:
    """(3,) roll, pitch, yaw of a pose (4, 4): R = Rz(yaw) Ry(pitch) Rx(roll). Upright, roll is 0."""
    flat = np.hypot(pose[0, 0], pose[1, 0])
    pitch = np.arctan2(-pose[2, 0], flat)
    if flat < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-pose[0, 1], pose[1, 1])])
    return np.array([np.arctan2(pose[2, 1], pose[2, 2]), pitch, np.arctan2(pose[1, 0], pose[0, 0])])
