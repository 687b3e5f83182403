"""A URDF as a simulator: links and axes are Pinocchio's to read, `dynamics` of a joint is its damping and friction."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from agent.core import InputError
from agent.robot import check_urdf
from agent.simulators.arm import SimulatedArm
from agent.simulators.bodies import CarryingBody, parameters, seen_from
from agent.simulators.joints import leaving_out, listed
from agent.simulators.urdf_elements import end_of, pose_of

_TURN = 6.3  # rad
_MOVABLE = ("revolute", "continuous", "prismatic")


def read_urdf(
    path: Path, root: Element, match: Callable[[Sequence[str]], Mapping[str, str]], gravity: tuple[float, float, float]
) -> SimulatedArm:
    """The arm of a URDF; joints that `match` leaves out are held at zero.

    Raises:
        InputError: numbers that are none, mimic joints in the arm, or joints that are not one chain.
    """
    by_child = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    elements = {str(joint.get("name")): joint for joint in root.findall("joint")}
    movable = [name for name, joint in elements.items() if joint.get("type") in _MOVABLE]
    used = match(movable)
    _refuse_followers(path, elements, used)
    check_urdf(path, root, list(used))
    _check_radians(path, root)
    floating = [name for name, joint in elements.items() if joint.get("type") in ("floating", "planar")]
    if floating:
        raise InputError(
            f"{path}: joint {floating[0]!r} is {elements[floating[0]].get('type')}: a fixed base is needed"
        )
    chain = _chain(path, elements, by_child, used)
    held = [name for name in movable if name not in used]
    notes = (f"{listed(held)} held at zero: not among the joints compared",) if held else ()
    for element in root.iter("joint"):
        element.set("name", used.get(str(element.get("name")), str(element.get("name"))))
    joints = [elements[name] for name in chain]
    damping, friction = (
        np.array([_number(j, "dynamics", key, 0.0) for j in joints]) for key in ("damping", "friction")
    )
    lower, upper, speed = (
        np.array([_number(j, "limit", key, other) for j in joints])
        for key, other in (("lower", -np.inf), ("upper", np.inf), ("velocity", np.nan))
    )
    turning = np.array([joint.get("type") == "continuous" for joint in joints]) | ~(lower < upper)
    zero = np.zeros(len(chain))
    option = root.find("mujoco/option")
    if option is not None and option.get("gravity"):
        x, y, z = (float(word) for word in str(option.get("gravity")).split())
        gravity = (x, y, z)
    return SimulatedArm(
        path=path,
        name=str(root.get("name") or path.stem),
        urdf=ElementTree.tostring(root, encoding="unicode"),
        tip_frame=end_of(joints[-1], "child"),
        gravity=gravity,
        joint_names=tuple(used[name] for name in chain),
        file_joints=tuple(chain),
        prismatic=tuple(joint.get("type") == "prismatic" for joint in joints),
        lower=np.where(turning, -np.inf, lower),
        upper=np.where(turning, np.inf, upper),
        max_velocity=np.where(speed > 0, speed, np.nan),
        armature=zero,
        damping=damping,
        frictionloss=friction,
        stiffness=zero,
        rest=zero,
        carrying=tuple(_carrying(root, joint, set(used.values())) for joint in joints),
        notes=notes,
    )


def longest_chain(root: Element) -> list[str]:
    """Joints from base to tip on the way that has most of them, without those that follow or lead others (mimic)."""
    joints = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    pairs = {
        name for j in joints.values() if (m := j.find("mimic")) is not None for name in (j.get("name"), m.get("joint"))
    }
    longest: list[str] = []
    for link in joints:
        chain: list[str] = []
        while link in joints and len(chain) < len(joints):
            joint = joints[link]
            if joint.get("type") in _MOVABLE and joint.get("name") not in pairs:
                chain.insert(0, str(joint.get("name")))
            link = end_of(joint, "parent")
        longest = max(longest, chain, key=len)
    return longest


def _check_radians(path: Path, root: Element) -> None:
    """Raise InputError where angles are larger than any in radians would be written."""
    for owner in (*root.findall("link"), *root.findall("joint")):
        for origin in owner.iter("origin"):
            largest = max((abs(float(word)) for word in (origin.get("rpy") or "0").split()), default=0.0)
            if largest > _TURN:
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
    """Raise InputError for joints to be compared that another one moves, as the fingers of grippers are."""
    for name in used:
        mimic = elements[name].find("mimic")
        if mimic is not None:
            leader = mimic.get("joint", "")
            raise InputError(
                f"{path}: joint {name!r} follows {leader!r} (mimic), and joints that all move on their own are "
                f"compared: {leaving_out(used, [one for one in used if one in (name, leader)])}"
            )


def _chain(
    path: Path, elements: Mapping[str, Element], by_child: Mapping[str, Element], used: Mapping[str, str]
) -> list[str]:
    """The used joints from base to tip."""

    def above(name: str) -> list[str]:
        found, link = [name], end_of(elements[name], "parent")
        while link in by_child:
            name = str(by_child[link].get("name"))
            found.append(name)
            link = end_of(by_child[link], "parent")
        return found

    longest = max((above(name) for name in used), key=lambda names: len(set(names) & set(used)))
    aside = [name for name in used if name not in longest]
    if aside:
        raise InputError(
            f"{path}: not on the way to {longest[0]}: {listed(aside)}. One serial arm is compared at a time, without "
            f"other branches: {leaving_out(used, aside)}"
        )
    return [name for name in reversed(longest) if name in used]


def _carrying(root: Element, joint: Element, used: set[str]) -> CarryingBody:
    """The heaviest of the links that a joint carries; joints that are not used are at zero."""
    children: dict[str, list[Element]] = {}
    for other in root.findall("joint"):
        if other.get("name") not in used:
            children.setdefault(end_of(other, "parent"), []).append(other)
    inertials = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    first = end_of(joint, "child")
    poses, open_ends = {first: np.eye(4)}, [first]
    while open_ends:
        link = open_ends.pop()
        for other in children.get(link, []):
            poses[end_of(other, "child")] = poses[link] @ pose_of(other.find("origin"))
            open_ends.append(end_of(other, "child"))
    mass = {link: _value(inertials.get(link), "mass", "value") for link in poses}
    heaviest = max(poses, key=lambda link: (mass[link], link == first))
    own = seen_from(_own(inertials.get(heaviest)), np.linalg.inv(poses[heaviest]))
    return CarryingBody(heaviest, poses[heaviest], own, heaviest, poses[heaviest])


def _own(inertial: Element | None) -> np.ndarray:
    """(10,) of an inertial in its link's frame."""
    mass = _value(inertial, "mass", "value")
    if inertial is None or mass <= 0:
        return np.zeros(10)
    pose = pose_of(inertial.find("origin"))
    inertia = np.array([[_value(inertial, "inertia", f"i{min(a, b)}{max(a, b)}") for b in "xyz"] for a in "xyz"])
    turn = pose[:3, :3]
    return parameters(mass, pose[:3, 3], turn @ inertia @ turn.T)


def _value(inertial: Element | None, tag: str, key: str) -> float:
    element = None if inertial is None else inertial.find(tag)
    return 0.0 if element is None else float(element.get(key, "0"))


def _number(joint: Element, tag: str, key: str, otherwise: float) -> float:
    element = joint.find(tag)
    text = None if element is None else element.get(key)
    try:
        return otherwise if text is None else float(text)
    except ValueError:
        raise InputError(f"joint {joint.get('name')!r}: {tag} {key}: a number is expected, not {text!r}") from None
