"""A serial arm's geometry, read from its URDF, with forward kinematics and Jacobian over many samples at once.

Every joint is given a frame whose z axis is the axis it moves along or about; between two such frames, from the base
to the first and from the last to the tool centre point, there is a constant transform. So

    T(q) = A₀ M(q₁) A₁ M(q₂) … M(qₙ) Aₙ,    M(q) = rotation about z by q, or translation along z by q.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np

from agent.core import InputError
from agent.robot.description import RobotDescription


@dataclass(frozen=True, eq=False)
class KinematicChain:
    """`transforms` (n + 1, 4, 4) are the constants A, `prismatic` (n,) says which joints slide."""

    transforms: np.ndarray
    prismatic: np.ndarray

    @property
    def dof(self) -> int:
        """Number of joints n."""
        return len(self.prismatic)

    def origins(self, q: np.ndarray) -> np.ndarray:
        """(S, n + 1, 3) where the joints' frames and the TCP are in the base frame, from joint positions (S, n)."""
        frames = [np.broadcast_to(self.transforms[0], (len(q), 4, 4))]
        for k, transform in enumerate(self.transforms[1:]):
            moved = np.tile(np.eye(4), (len(q), 1, 1))
            if self.prismatic[k]:
                moved[:, 2, 3] = q[:, k]
            else:
                moved[:, 0, 0] = moved[:, 1, 1] = np.cos(q[:, k])
                moved[:, 1, 0] = np.sin(q[:, k])
                moved[:, 0, 1] = -moved[:, 1, 0]
            frames.append(frames[-1] @ moved @ transform)
        return np.stack([frame[:, :3, 3] for frame in frames], axis=1)

    def forward_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, 4, 4) pose of the TCP at joint positions (S, n), and (S, 6, n) its Jacobian, by one compiled loop.

        Both in the base frame; rows of the Jacobian are linear, then angular, velocity per joint rate.
        """
        from agent.compiled import forward_and_jacobian

        q = np.ascontiguousarray(q, dtype=float)
        return forward_and_jacobian(self.transforms, self.prismatic, q, np.cos(q), np.sin(q))

    def axes_at_zero(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions (n, 3) and points (n, 3) of the joint axes, and the TCP's pose (4, 4), at q = 0, base frame."""
        frames = [self.transforms[0]]
        for transform in self.transforms[1:]:
            frames.append(frames[-1] @ transform)
        stack = np.array(frames)
        return stack[:-1, :3, 2], stack[:-1, :3, 3], stack[-1]


def chain_of(robot: RobotDescription, tool_frame: np.ndarray | None = None) -> KinematicChain:
    """The chain from the URDF's root to the tip frame, and on to the TCP by `tool_frame` (4, 4).

    Movable joints that the description does not list are held at zero.

    Raises:
        InputError: the described joints are not, in that order, the ones between root and tip frame.
    """
    tree = ElementTree.fromstring(robot.urdf)
    by_child = {_link(joint, "child"): joint for joint in tree.findall("joint")}
    names = {joint.get("name"): _link(joint, "child") for joint in by_child.values()}
    links = {element.get("name") for element in tree.findall("link")}
    link = robot.tip_frame if robot.tip_frame in links else names.get(robot.tip_frame, robot.tip_frame)
    path: list[ElementTree.Element] = []
    while link in by_child:
        if by_child[link] in path:
            raise InputError(f"robot {robot.name}: urdf: link {link} is its own ancestor")
        path.insert(0, by_child[link])
        link = _link(by_child[link], "parent")
    movable = tuple(str(joint.get("name")) for joint in path if joint.get("name") in robot.joint_names)
    if movable != robot.joint_names:
        raise InputError(
            f"robot {robot.name}: between the URDF's root and tip_frame {robot.tip_frame} are the joints "
            f"{', '.join(movable) or 'none'}; the description lists {', '.join(robot.joint_names)}"
        )
    transforms = [np.eye(4)]
    for joint in path:
        transforms[-1] = transforms[-1] @ _origin(joint)
        if joint.get("name") in robot.joint_names:
            aligned = np.eye(4)
            aligned[:3, :3] = _rotation_to(_axis(robot, joint))
            transforms[-1] = transforms[-1] @ aligned
            transforms.append(aligned.T)
    if tool_frame is not None:
        transforms[-1] = transforms[-1] @ tool_frame
    return KinematicChain(np.array(transforms), np.array([joint.prismatic for joint in robot.joints]))


def joint_axes(robot: RobotDescription) -> np.ndarray:
    """(n, 3) unit vectors of the joint axes, each in the frame of the link that the joint moves."""
    joints = {joint.get("name"): joint for joint in ElementTree.fromstring(robot.urdf).findall("joint")}
    return np.array([_axis(robot, joints[name]) for name in robot.joint_names])


def _link(joint: ElementTree.Element, role: str) -> str:
    element = joint.find(role)
    return "" if element is None else str(element.get("link"))


def _origin(joint: ElementTree.Element) -> np.ndarray:
    pose = np.eye(4)
    element = joint.find("origin")
    if element is None:
        return pose
    pose[:3, 3] = [float(value) for value in element.get("xyz", "0 0 0").split()]
    roll, pitch, yaw = (float(value) for value in element.get("rpy", "0 0 0").split())
    cr, cp, cy = np.cos([roll, pitch, yaw])
    sr, sp, sy = np.sin([roll, pitch, yaw])
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return pose


def _axis(robot: RobotDescription, joint: ElementTree.Element) -> np.ndarray:
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0] if element is None else [float(v) for v in element.get("xyz", "1 0 0").split()])
    length = np.linalg.norm(axis)
    if length == 0:
        raise InputError(f"robot {robot.name}: urdf: joint {joint.get('name')} has an axis of length zero")
    return axis / length


def _rotation_to(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is `axis`; of signed unit vectors where the axis is one."""
    first = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    first = first - axis * (first @ axis)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])
