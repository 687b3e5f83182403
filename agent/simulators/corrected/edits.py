"""Edits numbers of an MJCF or URDF; everything else stays as written.

Joints count from 0 in the order of the arm, all numbers are SI, and inertias (10,) of bodies are in their own frames.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from agent.core import LARGEST_ROBOT_FILE, InputError, read_bytes
from agent.simulators.arm import SimulatedArm
from agent.simulators.corrected.xml_document import XmlDocument
from agent.simulators.servos import PositionServos
from agent.simulators.urdf import child_of, digits, let_pass, mjcf_inertial, move_zero, rpy_of, set_inertial

_NO_BODY = ("equality", "fixed", "default", "sensor", "actuator", "custom", "tendon")
_ORIENTATION = ("quat", "euler", "axisangle", "xyaxes", "zaxis", "diaginertia")
_SAVE_COMPILED = "save the compiled model (mj_saveLastXML), and give that"


def opened(path: Path) -> XmlDocument:
    """Read a file that is to be changed.

    Raises:
        InputError: it cannot be read or edited.
    """
    try:
        return XmlDocument(read_bytes(path, LARGEST_ROBOT_FILE))
    except ValueError as error:
        raise InputError(f"{path}: cannot be changed in place: {error}") from None


class UrdfEdits:
    """Edits of a URDF, to be written to `out`.

    `numbers`: the numbers of a joint that the format has; `zero`: the element or attribute that holds its zero.
    """

    numbers: tuple[str, ...] = ("frictionloss", "damping")
    zero = "origin"

    def __init__(self, arm: SimulatedArm, out: Path):
        self._out, self._document = out, opened(arm.path)
        joints = {joint.get("name"): joint for joint in self._document.root.findall("joint")}
        self._joints = [joints[name] for name in arm.file_joints]
        self._links = {link.get("name"): link for link in self._document.root.findall("link")}
        back = os.path.relpath(arm.path.absolute().parent, out.absolute().parent)
        for element in self._document.root.iter():
            name = element.get("filename")
            if back != "." and name and "://" not in name and (arm.path.parent / name).exists():
                element.set("filename", os.path.join(back, name))

    def files(self) -> dict[Path, bytes]:
        """Paths and contents to write."""
        return {self._out: self._document.changed()}

    def set_number(self, k: int, key: str, value: float) -> None:
        """Set a number of a joint."""
        dynamics = self._joints[k].find("dynamics")
        if dynamics is None:
            dynamics = SubElement(self._joints[k], "dynamics", damping="0", friction="0")
        dynamics.set({"frictionloss": "friction"}.get(key, key), digits(value))

    def set_inertial(self, k: int, body: str, block: np.ndarray) -> None:
        """Set the inertia of a link."""
        set_inertial(self._links[body], block)

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Set gravity in MuJoCo's extension: URDF itself has no element for it."""
        child_of(child_of(self._document.root, "mujoco"), "option").set("gravity", digits(*gravity))

    def move_zero(self, k: int, offset: float) -> tuple[list[float], list[float]]:
        """Move a joint's zero by `offset` [rad or m]; returns xyz and rpy of its origin, old and new."""
        old, new = ([*pose[:3, 3].tolist(), *rpy_of(pose).tolist()] for pose in move_zero(self._joints[k], offset))
        return old, new


class MjcfEdits:
    """Edits of an MJCF and its includes. `out` is the main file; copies of changed includes go next to it."""

    numbers: tuple[str, ...] = ("frictionloss", "damping", "solimpfriction", "armature", "stiffness", "springref")
    zero = "ref"

    def __init__(self, arm: SimulatedArm, out: Path):
        self._arm, self._out, self._source = arm, out, arm.path.absolute()
        self._back = os.path.relpath(self._source.parent, out.absolute().parent)
        self._documents: dict[Path, XmlDocument] = {}
        self._includes: list[tuple[Path, Element, Path]] = []  # which file includes, by which element, which file
        self._open(self._source)
        self._parents = {id(child): e for d in self._documents.values() for e in d.root.iter() for child in e}
        self._radian = any(compiler.get("angle") == "radian" for compiler in self._all("compiler"))
        if self._back != ".":
            self._point_back()

    def _open(self, path: Path) -> None:
        self._documents[path] = opened(path)
        for element in self._documents[path].root.iter("include"):
            if name := element.get("file"):
                included = next((f / name for f in (self._source.parent, path.parent) if (f / name).exists()), None)
                if included is None:
                    raise InputError(f"{path}: its include {name} is missing")
                self._includes.append((path, element, included))
                if included not in self._documents:
                    self._open(included)

    def _all(self, *names: str) -> Iterator[Element]:
        for document in self._documents.values():
            yield from (element for element in document.root.iter() if element.tag in names)

    def _point_back(self) -> None:
        """Let a file in another folder find meshes and textures in the original folder."""
        compilers = list(self._all("compiler"))
        for key in ("meshdir", "texturedir", "assetdir"):
            for compiler in compilers:
                if (folder := compiler.get(key)) is not None and not os.path.isabs(folder):
                    compiler.set(key, os.path.join(self._back, folder))
        for key in ("meshdir", "texturedir"):
            named = any(compiler.get(name) is not None for compiler in compilers for name in (key, "assetdir"))
            if not named and next(self._all("mesh", "texture", "hfield"), None) is not None:
                child_of(self._documents[self._source].root, "compiler").set(key, self._back)

    def files(self) -> dict[Path, bytes]:
        """Paths and contents to write: the file, and a copy of every include that changes or moves."""
        changed = {path for path, xml in self._documents.items() if xml.is_changed or self._back != "."}
        for _ in self._documents:  # who includes a changed file changes
            changed |= {owner for owner, _, included in self._includes if included in changed}
        places = {path: self._out.with_name(f"{self._out.stem}_{path.name}") for path in changed}
        places[self._source] = self._out
        if len(set(places.values())) < len(places):
            raise InputError(
                f"{self._source}: two of its includes have one file name; rename one, or make one file of them"
            )
        for _, element, included in self._includes:
            if included in places:
                element.set("file", places[included].name)
        return {
            places[path]: self._documents[path].changed() for path in (self._source, *sorted(changed - {self._source}))
        }

    def _joint(self, k: int) -> Element:
        name = self._arm.file_joints[k]
        named = [joint for joint in self._all("joint") if joint.get("name") == name]
        matches = [joint for joint in named if self._parents[id(joint)].tag not in _NO_BODY]
        if len(matches) != 1:
            raise InputError(
                f"{self._source}: joint {name!r} stands in it {len(matches)} times as text (attach or replicate makes "
                f"it), so it cannot be changed in place: {_SAVE_COMPILED}"
            )
        return matches[0]

    def _unit(self, k: int) -> float:
        """Unit of a joint's positions in the file [rad or m]."""
        return 1.0 if self._radian or self._arm.robot.joints[k].prismatic else float(np.pi / 180)

    def set_number(self, k: int, key: str, value: float) -> None:
        """Set a number of a joint; angles are written in the file's unit."""
        self._joint(k).set(key, digits(value / self._unit(k) if key == "springref" else value))
        if key == "solimpfriction" and self._arm.step is not None:
            self._joint(k).set("solreffriction", f"{digits(2 * self._arm.step)} 1")  # it stops within a step

    def set_inertial(self, k: int, body: str, block: np.ndarray) -> None:
        """Set the inertia of a body, or of the body that joint k moves if it has no name."""
        named = [element for element in self._all("body") if body and element.get("name") == body]
        owner = self._parents[id(self._joint(k))]
        if len(named) == 1:
            owner = named[0]
        elif body or owner.tag != "body":
            raise InputError(
                f"{self._source}: the body whose inertia is to be changed, moved by {self._arm.file_joints[k]}, stands "
                f"in it {len(named)} times as text: {_SAVE_COMPILED}"
            )
        inertial = child_of(owner, "inertial")
        for key in _ORIENTATION:
            inertial.attrib.pop(key, None)
        inertial.attrib.update(mjcf_inertial(block))

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Set gravity of the world."""
        options = [option for option in self._all("option") if option.get("gravity") is not None]
        option = options[-1] if options else child_of(self._documents[self._source].root, "option")
        option.set("gravity", digits(*gravity))

    def exclude(self, pair: tuple[str, str]) -> None:
        """Let two bodies pass through each other."""
        let_pass(self._documents[self._source].root, pair)

    def move_zero(self, k: int, offset: float) -> tuple[float, float]:
        """Move a joint's zero by `offset` [rad or m]; returns its `ref`, old and new."""
        joint, unit = self._joint(k), self._unit(k)
        old = float(joint.get("ref") or 0.0) * unit
        joint.set("ref", digits((old + offset) / unit))
        return old, old + offset

    @property
    def damps_by_ratio(self) -> bool:
        """Whether servo damping is given as a ratio, which depends on masses."""
        return any(servo.get("dampratio") is not None for servo in self._all("position"))

    def set_delay(self, k: int, delay: float, step: float) -> None:
        """Set the delay [s] of the actuator of a joint; `step` [s] is that of the simulation."""
        actuator = self._servo(k)
        actuator.set("delay", digits(delay))
        actuator.set("nsample", str(int(np.ceil(delay / step - 1e-9)) + 1))
        actuator.set("interp", "linear")

    def set_servo(self, k: int, gain: float, bias: list[float]) -> None:
        """Set gain and bias (b₀, b₁, b₂) of the position actuator of a joint; with an offset it becomes a general one,
        which has the same defaults and names, but no gains and range of its joint. A velocity actuator gives its kv to
        it, and has none."""
        actuator, name = self._servo(k), self._arm.file_joints[k]
        for brake in self._all("velocity"):
            if name in (brake.get("joint"), brake.get("jointinparent")):
                brake.set("kv", "0")
        if bias[0] and actuator.tag == "position":
            actuator.tag, servos = "general", self._arm.servos
            assert isinstance(servos, PositionServos)
            limits = servos.gear[k] * np.array([servos.least[k], servos.most[k]])
            for key in ("kp", "kv", "dampratio", "inheritrange"):
                actuator.attrib.pop(key, None)
            actuator.attrib.update(biastype="affine")
            if np.isfinite(limits).all():
                actuator.set("ctrlrange", digits(*np.sort(limits)))
        if actuator.tag == "general":
            actuator.attrib.update(gainprm=digits(gain), biasprm=digits(*bias))
            return
        actuator.set("kp", digits(gain))
        if bias[2]:
            actuator.set("kv", digits(-bias[2]))
        actuator.attrib.pop("dampratio", None)

    def _servo(self, k: int) -> Element:
        name, actuators = self._arm.file_joints[k], self._all("position", "general")
        matches = [actuator for actuator in actuators if name in (actuator.get("joint"), actuator.get("jointinparent"))]
        if len(matches) != 1:
            raise InputError(
                f"{self._source}: {name!r} has {len(matches)} position or general actuators as text, so its gain "
                f"cannot be changed in place: {_SAVE_COMPILED}"
            )
        return matches[0]
