"""Masses and lengths of a description that are in another unit than kg and m, as mass and reach of an arm show.

What undoing the unit makes of the description has to be an arm, and its gravity has to be in the torques.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from agent.core import and_list
from agent.data_quality.description_fit import HEAVIEST, LIGHTEST, compared_weight
from agent.data_quality.faults import QualityFinding, Recordings
from agent.robot import Dynamics, RobotDescription

_MASSES = {"": 1.0, "g": 1e-3, "t": 1e3}  # kg
_LENGTHS = {"": 1.0, "mm": 1e-3}  # m
_TOO_INERT = 3.0  # times the measured torque, which moves the arm against its friction too


@dataclass(frozen=True)
class _Build:
    """Mass [kg] and reach [m] of an arm, and how far [m] a link's centre of mass is from its joint at most."""

    mass: float
    reach: float
    centre: float

    @classmethod
    def of(cls, robot: RobotDescription) -> _Build:
        dynamics = Dynamics(robot)
        links = dynamics.standard_parameters().reshape(-1, 10)
        centres = np.linalg.norm(links[:, 1:4], axis=1) / np.maximum(links[:, 0], 1e-300)
        return cls(float(links[:, 0].sum()), dynamics.reach, float(centres.max()))

    @property
    def possible(self) -> bool:
        """Whether there are such arms."""
        return LIGHTEST <= self.mass / self.reach**2 <= HEAVIEST and self.centre <= self.reach


def description_units(of: Recordings) -> Iterator[QualityFinding]:
    """Units of masses, lengths and centres of mass with which an impossible description becomes one of this arm."""
    build = _Build.of(of.robot)
    if build.mass <= 0 or build.reach <= 0 or build.possible:
        return
    for units in sorted(product(_MASSES, _LENGTHS, _LENGTHS), key=lambda combination: sum(map(bool, combination))):
        robot = _with_units(of.robot, *units)
        if not any(units) or not _Build.of(robot).possible:
            continue
        weight = compared_weight(Recordings(robot, of.logs, of.others))
        if weight is not None and weight.alike.any():
            evidence = "" if weight.off().any() else "its gravity is that of the torques"
        else:  # axes along gravity
            inert = _inertia(of.robot, of) > _TOO_INERT >= _inertia(robot, of)
            evidence = "its inertia is that of the torques" if inert else ""
        if not evidence:
            continue
        which = dict(zip(("masses", "joint origins", "centres of mass"), units, strict=True))
        looks = and_list([f"{what} in {unit}" for what, unit in which.items() if unit])
        yield QualityFinding(
            f"the description looks like one with {looks}: as it stands, the arm weighs {build.mass:.3g} kg, reaches "
            f"{build.reach:.3g} m, and has centres of mass up to {build.centre:.3g} m from joints; converted, "
            f"{evidence}",
            of.robot.joint_names,
            advice="a URDF is in kg and m: convert it (inertias too, kg·m²)",
        )
        return


def _inertia(robot: RobotDescription, of: Recordings) -> float:
    """Torque that its inertia needs for these motions, over the measured one, root mean square of all joints."""
    if of.samples is None:
        return 0.0
    s = of.samples
    needed = Dynamics(replace(robot, gravity=(0.0, 0.0, 0.0))).inverse_dynamics(s.q, s.qd, s.qdd)
    return float(np.sqrt(np.sum(needed**2) / max(float(np.sum(s.torque**2)), 1e-300)))


def _with_units(robot: RobotDescription, mass: str, length: str, centre: str) -> RobotDescription:
    """The robot if its masses, the origins of its joints and its centres of mass are in these units."""
    root = ElementTree.fromstring(robot.urdf)
    masses, lengths, centres = _MASSES[mass], _LENGTHS[length], _LENGTHS[centre]
    for inertial in root.findall("link/inertial"):
        for tag, factor in (("mass", masses), ("inertia", masses * centres**2)):
            if (element := inertial.find(tag)) is not None:
                element.attrib.update({key: repr(float(value) * factor) for key, value in element.attrib.items()})
    for origins, factor in ((root.findall("link/inertial/origin"), centres), (root.findall("joint/origin"), lengths)):
        for origin in origins:
            place = [float(x) * factor for x in origin.get("xyz", "0 0 0").split()]
            origin.set("xyz", " ".join(map(repr, place)))
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))
