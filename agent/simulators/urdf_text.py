"""A URDF changed in place."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from agent.core import InputError
from agent.simulators.arm import SimulatedArm
from agent.simulators.correction import turned_pose
from agent.simulators.urdf_elements import digits, inertia_attributes, pose_of, rpy_of
from agent.simulators.xml_text import Tag, XmlText

_KEYS = {"frictionloss": "friction", "damping": "damping"}


class UrdfText:
    """The text of a URDF, to be written to `out`."""

    zero = "origin"

    def __init__(self, arm: SimulatedArm, out: Path):
        source = arm.path
        self._out = out
        try:
            self._xml = XmlText(source.read_bytes())
        except ValueError as error:
            raise InputError(f"{source}: cannot be changed in place: {error}") from None
        root = self._xml.root.children
        self._joints = {tag.get("name"): tag for tag in root if tag.name == "joint"}
        self._links = {tag.get("name"): tag for tag in root if tag.name == "link"}
        way = os.path.relpath(source.absolute().parent, out.absolute().parent)
        if way != ".":
            for tag in self._xml.root.iter():
                name = tag.get("filename")
                if name and "://" not in name and (source.parent / name).exists():
                    tag.set("filename", os.path.join(way, name))

    def files(self) -> dict[Path, bytes]:
        """What to write."""
        return {self._out: self._xml.changed()}

    def is_supported(self, key: str) -> bool:
        """Whether a joint has such a number."""
        return key in _KEYS

    def set_joint(self, number: int, joint: str, key: str, value: float) -> None:
        """Damping [N·m·s/rad] or friction [N·m] of a joint."""
        tag = self._joints[joint].find("dynamics")
        if tag is None:
            own = self._joints[joint]
            both = {name: "0" for name in _KEYS.values()}
            known = [entry for entry in own.inserted if entry.startswith("<dynamics")]
            if known:
                own.inserted.remove(known[0])
                both = dict(part.split("=") for part in known[0][10:-2].split())
                both = {name: word.strip('"') for name, word in both.items()}
            both[_KEYS[key]] = digits(value)
            own.inserted.append(f'<dynamics damping="{both["damping"]}" friction="{both["friction"]}"/>')
        else:
            tag.set(_KEYS[key], digits(value))

    def set_inertial(self, joint: str, link: str, mass: float, centre: np.ndarray, inertia: np.ndarray) -> None:
        """Of a link, in its own frame."""
        tag = self._links[link].find("inertial")
        attributes = {
            "origin": {"xyz": digits(*centre), "rpy": "0 0 0"},
            "mass": {"value": digits(mass)},
            "inertia": inertia_attributes(inertia),
        }
        if tag is None:
            inner = "".join(_element(name, values) for name, values in attributes.items())
            self._links[link].inserted.append(f"<inertial>{inner}</inertial>")
            return
        for name, values in attributes.items():
            _set(tag, name, values)

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """A URDF has none of its own: MuJoCo's extension says it."""
        extension = self._xml.root.find("mujoco")
        option = f'<option gravity="{digits(*gravity)}"/>'
        if extension is None:
            self._xml.root.inserted.append(f"<mujoco>{option}</mujoco>")
        elif (tag := extension.find("option")) is None:
            extension.inserted.append(option)
        else:
            tag.set("gravity", digits(*gravity))

    def move_zero(self, number: int, joint: str, prismatic: bool, offset: float) -> tuple[list[float], list[float]]:
        """Move a joint's zero by `offset` [rad or m]; returns xyz and rpy of its origin, old and new."""
        from xml.etree.ElementTree import Element

        tag = self._joints[joint]
        place, axis = tag.find("origin"), tag.find("axis")
        written = Element("origin", {} if place is None else place.attributes)
        direction = np.array([float(word) for word in ((axis and axis.get("xyz")) or "1 0 0").split()])
        before = pose_of(written)
        after = turned_pose(before, direction, prismatic, offset)
        _set(tag, "origin", {"xyz": digits(*after[:3, 3]), "rpy": digits(*rpy_of(after[:3, :3]))})
        old, new = ([*pose[:3, 3].tolist(), *rpy_of(pose[:3, :3]).tolist()] for pose in (before, after))
        return old, new


def _set(tag: Tag, child: str, values: dict[str, str]) -> None:
    found = tag.find(child)
    if found is None:
        tag.inserted.append(_element(child, values))
    else:
        for key, value in values.items():
            found.set(key, value)


def _element(name: str, values: dict[str, str]) -> str:
    attributes = " ".join(f'{key}="{value}"' for key, value in values.items())
    return f"<{name} {attributes}/>"
