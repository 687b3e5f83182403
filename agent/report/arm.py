"""Where the arm is along a motion, for the 3-D view."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.report.scene import ArmPoses

if TYPE_CHECKING:
    from agent.robot import RobotDescription

_MOST_POSTURES = 120
_THIN = 0.012  # of the arm's length: radius of a link whose body the description does not have


def arm_along(robot: RobotDescription, time: np.ndarray, q: np.ndarray, tool: np.ndarray | None = None) -> ArmPoses:
    """The capsules of the description, or lines from joint to joint where it has none.

    time (S,) and q (S, n) of a motion; `tool` (4, 4): the tool's frame at the flange.
    """
    from agent.robot import Dynamics, chain_of

    chosen = np.linspace(0, len(q) - 1, min(len(q), _MOST_POSTURES)).round().astype(int)
    joints = chain_of(robot, tool).origins(q[chosen])
    joints = np.concatenate([np.zeros((len(chosen), 1, 3)), joints], axis=1)
    bones = np.stack([joints[:, :-1], joints[:, 1:]], axis=2)
    length = float(np.linalg.norm(bones[0, :, 1] - bones[0, :, 0], axis=1).sum())
    if not robot.bodies:
        return ArmPoses(time[chosen], bones, np.full(bones.shape[1], _THIN * length))
    dynamics = Dynamics(robot)
    ends, radii = [bones[:, -1]], [_THIN * length]
    for link, capsules in robot.bodies.items():
        poses = dynamics.link_poses(q[chosen], link)
        for capsule in capsules:
            points = np.array([[*capsule.start, 1.0], [*capsule.end, 1.0]])
            ends.append(np.einsum("sij,pj->spi", poses, points)[..., :3])
            radii.append(capsule.radius)
    return ArmPoses(time[chosen], np.stack(ends, axis=1), np.array(radii))
