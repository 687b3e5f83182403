"""An MJCF changed in place, and with it the files that it includes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from agent.core import InputError
from agent.simulators.arm import SimulatedArm
from agent.simulators.urdf_elements import digits
from agent.simulators.xml_text import Tag, XmlText

_JOINT = ("frictionloss", "damping", "armature", "stiffness", "springref")
_ANGLES = ("springref", "ref")
_NO_BODY = ("equality", "fixed", "default", "sensor", "actuator", "custom", "tendon")
_ORIENTATION = ("quat", "euler", "axisangle", "xyaxes", "zaxis", "diaginertia")


class MjcfText:
    """The texts of an MJCF and of what it includes, to be written to `out`, copies of changed includes beside it."""

    zero = "ref"

    def __init__(self, arm: SimulatedArm, out: Path):
        source = arm.path
        self._source, self._out, self._prismatic = source, out, arm.prismatic
        self._moved = source.absolute().parent != out.absolute().parent
        self._texts: dict[Path, XmlText] = {}
        self._includes: dict[Path, list[tuple[Tag, Path]]] = {}
        self._open(source.absolute())
        self._parent = {id(c): tag for xml in self._texts.values() for tag in xml.root.iter() for c in tag.children}
        self._radian = any(tag.get("angle") == "radian" for tag in self._all("compiler"))
        if self._moved:
            self._point_back()

    def _open(self, path: Path) -> None:
        try:
            xml = self._texts[path] = XmlText(path.read_bytes())
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be changed in place: {error}") from None
        self._includes[path] = []
        for tag in xml.root.iter():
            if tag.name == "include" and tag.get("file"):
                name = str(tag.get("file"))
                beside = [folder / name for folder in (self._source.absolute().parent, path.parent)]
                found = next((place for place in beside if place.exists()), None)
                if found is None:
                    raise InputError(f"{path}: its include {name} is missing")
                self._includes[path].append((tag, found))
                if found not in self._texts:
                    self._open(found)

    def _all(self, name: str) -> Iterator[Tag]:
        for xml in self._texts.values():
            yield from (tag for tag in xml.root.iter() if tag.name == name)

    def _point_back(self) -> None:
        """From another folder: meshes and textures are found where they are."""
        way = os.path.relpath(self._source.absolute().parent, self._out.absolute().parent)
        found: set[str] = set()
        for tag in self._all("compiler"):
            for key in ("meshdir", "texturedir", "assetdir"):
                folder = tag.get(key)
                if folder is not None:
                    found.add(key)
                    tag.set(key, folder if os.path.isabs(folder) else os.path.join(way, folder))
        missing = [key for key in ("meshdir", "texturedir") if key not in found and "assetdir" not in found]
        assets = [tag for kind in ("mesh", "texture", "hfield") for tag in self._all(kind)]
        if missing and assets:
            root = self._texts[self._source.absolute()].root
            compiler = root.find("compiler")
            if compiler is None:
                root.inserted.append("<compiler " + " ".join(f'{key}="{way}"' for key in missing) + "/>")
            else:
                for key in missing:
                    compiler.set(key, way)

    def files(self) -> dict[Path, bytes]:
        """What to write: the file, and a copy of every include that is changed or is found from elsewhere now."""
        main = self._source.absolute()
        changed = {path for path, xml in self._texts.items() if any(tag.is_changed for tag in xml.root.iter())}
        if self._moved:
            changed |= set(self._texts)
        while True:  # who includes a changed file changes
            more = {
                path for path, parts in self._includes.items() if any(part in changed for _, part in parts)
            } - changed
            if not more:
                break
            changed |= more
        places = {path: self._out.with_name(f"{self._out.stem}_{path.name}") for path in changed}
        places[main] = self._out
        if len(set(places.values())) < len(places):
            raise InputError(
                f"{self._source}: two of its includes have one file name; rename one, or make one file of them"
            )
        for path in changed:
            for tag, part in self._includes[path]:
                if part in places:
                    tag.set("file", places[part].name)
        return {places[path]: self._texts[path].changed() for path in (main, *sorted(changed - {main}))}

    def is_supported(self, key: str) -> bool:
        """Whether a joint has such a number."""
        return key in _JOINT

    def set_joint(self, number: int, joint: str, key: str, value: float) -> None:
        """A number of a joint, SI; angles are written in the file's unit."""
        tag = self._joint(joint)
        turns = key in _ANGLES and not self._radian and not self._prismatic[number]
        tag.set(key, digits(np.degrees(value) if turns else value))

    def _joint(self, name: str) -> Tag:
        found = [
            tag for tag in self._all("joint") if tag.get("name") == name and self._parent[id(tag)].name not in _NO_BODY
        ]
        if len(found) != 1:
            raise InputError(
                f"{self._source}: joint {name!r} stands in it {len(found)} times as text (attach or replicate "
                "makes it), so it cannot be changed in place: save the compiled model (mj_saveLastXML), and give that"
            )
        return found[0]

    def set_inertial(self, joint: str, body: str, mass: float, centre: np.ndarray, inertia: np.ndarray) -> None:
        """Of a body, in its own frame."""
        named = [tag for tag in self._all("body") if body and tag.get("name") == body]
        owner = self._parent[id(self._joint(joint))]
        if len(named) == 1:
            owner = named[0]
        elif body or owner.name != "body":
            raise InputError(
                f"{self._source}: the body whose inertia is to be changed, moved by {joint}, stands in it {len(named)} "
                "times as text: save the compiled model (mj_saveLastXML), and give that"
            )
        full = digits(*inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        values = {"pos": digits(*centre), "mass": digits(mass), "fullinertia": full}
        tag = owner.find("inertial")
        if tag is None:
            owner.inserted.append("<inertial " + " ".join(f'{key}="{value}"' for key, value in values.items()) + "/>")
            return
        for key in _ORIENTATION:
            if tag.get(key) is not None:
                tag.set(key, None)
        for key, value in values.items():
            tag.set(key, value)

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Of the world."""
        options = [tag for tag in self._all("option") if tag.get("gravity") is not None]
        option = options[-1] if options else self._texts[self._source.absolute()].root.find("option")
        if option is None:
            self._texts[self._source.absolute()].root.inserted.append(f'<option gravity="{digits(*gravity)}"/>')
        else:
            option.set("gravity", digits(*gravity))

    def set_servo(self, joint: str, gain: float, bias: list[float]) -> None:
        """Gain and bias (b₀, b₁, b₂) of the actuator that holds a joint at set-points."""
        found = [
            tag
            for kind in ("position", "general")
            for tag in self._all(kind)
            if joint in (tag.get("joint"), tag.get("jointinparent"))
        ]
        if len(found) != 1:
            raise InputError(
                f"{self._source}: {joint!r} has {len(found)} position or general actuators as text, so its gain cannot "
                "be changed in place: save the compiled model (mj_saveLastXML), and give that"
            )
        tag = found[0]
        if tag.name == "general":
            tag.set("gainprm", digits(gain))
            tag.set("biasprm", digits(*bias))
            return
        tag.set("kp", digits(gain))
        if bias[2]:
            tag.set("kv", digits(-bias[2]))
        if tag.get("dampratio") is not None:
            tag.set("dampratio", None)

    @property
    def damps_by_ratio(self) -> bool:
        """Whether servos are damped by a ratio, so that other masses would change them."""
        return any(tag.get("dampratio") is not None for tag in self._all("position"))

    def move_zero(self, number: int, joint: str, prismatic: bool, offset: float) -> tuple[float, float]:
        """Move a joint's zero by `offset` [rad or m]; returns its `ref`, old and new."""
        tag = self._joint(joint)
        unit = 1.0 if prismatic or self._radian else float(np.pi / 180)
        old = float(tag.get("ref") or 0.0) * unit
        tag.set("ref", digits((old + offset) / unit))
        return old, old + offset
