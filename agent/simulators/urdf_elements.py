"""Elements of a URDF, read and written: poses, inertials, ends of joints; numbers keep every digit."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np


def digits(*numbers: float) -> str:
    """With every digit: rounding costs torque."""
    return " ".join(repr(float(number)) for number in numbers)


def end_of(joint: Element, which: str) -> str:
    """The link at a joint's `parent` or `child`; empty where it has none."""
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def inertial_element(mass: float, centre: np.ndarray, tensor: np.ndarray) -> Element:
    """Of mass [kg], centre (3,) [m] and inertia (3, 3) [kg·m²] about it, in the axes of the link."""
    element = Element("inertial")
    SubElement(element, "origin", xyz=digits(*centre), rpy="0 0 0")
    SubElement(element, "mass", value=digits(mass))
    SubElement(element, "inertia", inertia_attributes(tensor))
    return element


def inertia_attributes(tensor: np.ndarray) -> dict[str, str]:
    """Attributes of an inertia element, from a tensor (3, 3)."""
    axes = "xyz"
    return {f"i{axes[i]}{axes[j]}": digits(tensor[i, j]) for i in range(3) for j in range(i, 3)}


def pose_of(origin: Element | None) -> np.ndarray:
    """(4, 4) of an origin element; identity where there is none."""
    pose = np.eye(4)
    if origin is None:
        return pose
    angles = (origin.get("rpy") or "0 0 0").split()
    turns = [rotation(axis, float(angle)) for axis, angle in zip(np.eye(3), angles, strict=True)]
    pose[:3, :3] = turns[2] @ turns[1] @ turns[0]
    pose[:3, 3] = [float(word) for word in (origin.get("xyz") or "0 0 0").split()]
    return pose


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """(3, 3) about a unit axis (3,), by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rpy_of(turn: np.ndarray) -> np.ndarray:
    """(3,) roll, pitch, yaw of a rotation matrix (3, 3): R = Rz(yaw) Ry(pitch) Rx(roll). Upright, roll is 0."""
    flat = np.hypot(turn[0, 0], turn[1, 0])
    pitch = np.arctan2(-turn[2, 0], flat)
    if flat < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-turn[0, 1], turn[1, 1])])
    return np.array([np.arctan2(turn[2, 1], turn[2, 2]), pitch, np.arctan2(turn[1, 0], turn[0, 0])])
