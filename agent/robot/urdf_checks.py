"""What is wrong with a URDF, said before the URDF library stumbles over it or passes over it in silence."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from agent.core import InputError

#: Attributes that are read as numbers, by element.
_NUMBERS = {
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "limit": ("lower", "upper"),
    "mass": ("value",),
    "inertia": ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
}
#: Of these, what is three numbers; all others are one.
_THREE = ("xyz", "rpy")
#: Of these, what no body has below zero.
_NOT_NEGATIVE = {"mass": ("value",), "inertia": ("ixx", "iyy", "izz")}


def parse_robot_file(path: Path, text: bytes) -> Element:
    """The root of a URDF or an MJCF.

    Raises:
        InputError: not XML, or a format that has to be converted first; says with which command.
    """
    expand = f"{path}: a xacro file, not a URDF yet: expand it first: xacro {path.name} > arm.urdf"
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        if b"<xacro:" in text:
            raise InputError(expand) from None
        raise InputError(f"{path}: not valid XML: {error}") from None
    if root.tag == "robot" and any("/xacro" in e.tag or e.tag.startswith("xacro") for e in root.iter()):
        raise InputError(expand)
    if root.tag == "robot" and any("${" in value or "$(" in value for e in root.iter() for value in e.attrib.values()):
        raise InputError(expand)
    if root.tag == "sdf":
        raise InputError(
            f"{path}: an SDF (Gazebo), neither a URDF nor an MJCF: convert it with sdf2mjcf {path.name} arm.xml (pip "
            "install sdformat-mjcf) and name arm.xml with --robot, or take the URDF or xacro that it was made from"
        )
    if root.tag not in ("robot", "mujoco"):
        raise InputError(f"{path}: neither an MJCF (<mujoco>) nor a URDF (<robot>): it starts with <{root.tag}>")
    return root


def check_urdf(path: Path | str, root: Element, joints: Sequence[str]) -> None:
    """Check a URDF, from `path` or of that name, of which the description lists these joints.

    Args:
        path: named in messages.
        root: of the parsed file.
        joints: names that the description lists.

    Raises:
        InputError: numbers that are none, too many or too few, inertials that lack some, masses below zero, names that
            stand twice, several roots, joints that follow one another (mimic).
    """
    _check_numbers(path, root)
    _check_inertials(path, root)
    for kind in ("link", "joint"):
        duplicates = [name for name, count in Counter(e.get("name") for e in root.findall(kind)).items() if count > 1]
        if duplicates:
            raise InputError(f"{path}: {kind} {duplicates[0]!r} stands twice; every {kind} has a name of its own")
    _check_tree(path, root)
    for joint in root.findall("joint"):
        mimic, name = joint.find("mimic"), joint.get("name")
        if mimic is not None and (name in joints or mimic.get("joint") in joints):
            raise InputError(
                f"{path}: joint {name!r} follows {mimic.get('joint')!r} (mimic): a serial arm whose joints all move on "
                "their own is expected; couplings of motors go into motor_coupling of robot.yaml"
            )


def _check_numbers(path: Path | str, root: Element) -> None:
    for owner in (*root.findall("link"), *root.findall("joint")):
        for element in owner.iter():
            for key in _NUMBERS.get(element.tag, ()):
                text = element.get(key)
                if text is None:
                    continue
                try:
                    values = [float(word) for word in text.split()]
                except ValueError:
                    values = [np.nan]
                attribute = f"{owner.tag} {owner.get('name')!r}: {element.tag} {key}"
                if not np.isfinite(values).all():
                    raise InputError(f"{path}: {attribute}: finite numbers are expected, not {text!r}")
                if len(values) != (3 if key in _THREE else 1):
                    wanted = "three numbers" if key in _THREE else "one number"
                    raise InputError(f"{path}: {attribute} is {wanted}, not {text!r}")
                if key in _NOT_NEGATIVE.get(element.tag, ()) and min(values) < 0:
                    raise InputError(f"{path}: {attribute}: {text} is below zero; no body is like that")


def _check_inertials(path: Path | str, root: Element) -> None:
    # The URDF library only prints what it misses, and goes on without mass and inertia of that link.
    inertials = [(link.get("name"), inertial) for link in root.findall("link") for inertial in link.findall("inertial")]
    for link, inertial in inertials:
        for tag in ("mass", "inertia"):
            element = inertial.find(tag)
            missing = [key for key in _NUMBERS[tag] if element is None or element.get(key) is None]
            if missing:
                raise InputError(
                    f"{path}: link {link!r}: {tag} {', '.join(missing)} is missing; an inertial has a mass "
                    "and all six numbers of its inertia, zeros too"
                )


def _check_tree(path: Path | str, root: Element) -> None:
    links = [link.get("name") for link in root.findall("link")]
    parent: dict[str | None, str | None] = {}
    for joint in root.findall("joint"):
        ends = [None if (end := joint.find(tag)) is None else end.get("link") for tag in ("parent", "child")]
        for tag, link in zip(("parent", "child"), ends, strict=True):
            if link not in links:
                raise InputError(f"{path}: joint {joint.get('name')!r}: {tag} {link!r} is no link of this URDF")
        if ends[1] in parent:
            raise InputError(f"{path}: link {ends[1]!r} is the child of two joints; a serial arm has no loops")
        parent[ends[1]] = ends[0]
    roots = [link for link in links if link not in parent]
    if len(roots) != 1:
        faults = (
            f"{len(roots)} links have no parent ({', '.join(map(str, roots))})" if roots else "its joints are a loop"
        )
        raise InputError(f"{path}: {faults}; one link is the base, and joints connect all others to it")
    for link in links:
        above, steps = link, 0
        while above in parent and steps <= len(links):
            above, steps = parent[above], steps + 1
        if steps > len(links):
            raise InputError(f"{path}: link {link!r} is part of a loop; a serial arm has none")
