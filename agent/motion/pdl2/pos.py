"""POS coordinates and poses: millimetres and degrees on one side, homogeneous matrices in metres on the other."""

from __future__ import annotations

import numpy as np

from agent.motion import rotation


def pos_to_pose(pos: np.ndarray) -> np.ndarray:
    """Poses (S, 4, 4) [m] of coordinates (S, 6): x, y, z [mm] and the Euler ZYZ angles a, e, r [deg]; (4, 4) of one."""
    pos = np.asarray(pos, dtype=float)
    si = np.concatenate([pos[..., :3] / 1000.0, np.radians(pos[..., 3:])], axis=-1)
    return rotation.pose_of(si) + 0.0  # no negative zeros


def pose_to_pos(pose: np.ndarray) -> np.ndarray:
    """Coordinates (..., 6) of poses (..., 4, 4) [m]: x, y, z [mm], a, e, r [deg] as `rotation.to_euler` gives them."""
    pose = np.asarray(pose, dtype=float)
    return np.concatenate([1000.0 * pose[..., :3, 3], np.degrees(rotation.to_euler(pose[..., :3, :3]))], axis=-1)
