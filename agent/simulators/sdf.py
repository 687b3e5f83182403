"""A calibrated robot as SDF (sdformat.org, version 1.9), for Gazebo and whatever reads its files.

The links are those that move, at q = 0, with the bodies fixed to them being part of them; the first hangs on `world`.
Friction of an axle that several joints turn is that of its own joint, as in the URDF.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from agent.model.identified import IdentifiedModel
from agent.robot import ParameterLayout, about_centre, joint_axes
from agent.simulators.urdf_elements import rpy_of

_AXES = "xyz"


def sdf_text(model: IdentifiedModel, standard: np.ndarray, lines: np.ndarray) -> str:
    """The robot with inertials (11 n,) and friction `lines` (n, 2): damping and friction of every axle."""
    robot, dynamics = model.robot, model.rigid.dynamics
    layout = ParameterLayout.of(robot)
    root = Element("sdf", version="1.9")
    body = SubElement(root, "model", name=robot.name)
    urdf = ElementTree.fromstring(robot.urdf)
    children = {
        joint.get("name"): end.get("link", "") for joint in urdf.iter("joint") for end in joint.findall("child")
    }
    own = np.abs(np.diag(robot.coupling))
    parent = "world"
    for k, (joint, axis) in enumerate(zip(robot.joints, joint_axes(robot), strict=True)):
        name = children[joint.name]
        link = SubElement(body, "link", name=name)
        _value(link, "pose", *_pose(dynamics.link_poses(np.zeros((1, robot.dof)), name)[0]))
        _inertial(link, standard[layout.link(k)])
        element = SubElement(body, "joint", name=joint.name, type="prismatic" if joint.prismatic else "revolute")
        _value(element, "parent", parent)
        _value(element, "child", name)
        turning = SubElement(element, "axis")
        _value(turning, "xyz", *axis)
        limit = SubElement(turning, "limit")
        for end, bound in (("lower", joint.lower), ("upper", joint.upper)):
            if np.isfinite(bound):
                _value(limit, end, bound)
        _value(limit, "velocity", joint.max_velocity)
        dynamic = SubElement(turning, "dynamics")
        _value(dynamic, "damping", lines[k, 0] * own[k] ** 2)
        _value(dynamic, "friction", lines[k, 1] * own[k])
        parent = name
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _inertial(link: Element, block: np.ndarray) -> None:
    element = SubElement(link, "inertial")
    _value(element, "pose", *(block[1:4] / block[0]), 0.0, 0.0, 0.0)
    _value(element, "mass", block[0])
    inertia, tensor = about_centre(block), SubElement(element, "inertia")
    for i in range(3):
        for j in range(i, 3):
            _value(tensor, f"i{_AXES[i]}{_AXES[j]}", inertia[i, j])


def _pose(frame: np.ndarray) -> tuple[float, ...]:
    """x, y, z, roll, pitch, yaw of a frame (4, 4)."""
    return (*map(float, frame[:3, 3]), *map(float, rpy_of(frame[:3, :3])))


def _value(parent: Element, tag: str, *values: float | str) -> None:
    SubElement(parent, tag).text = " ".join(v if isinstance(v, str) else repr(float(v)) for v in values)
