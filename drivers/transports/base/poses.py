"""Rotations and frames of controllers as matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def poses_of_frames(base: Sequence[float], tool: Sequence[float], user: Sequence[float]) -> dict[str, np.ndarray]:
    """`ReportsFrames` of frames as six fields of a POS each."""
    frames = {"$BASE": base, "$TOOL": tool, "$UFRAME": user}
    return {name: _pose_of_frame(fields) for name, fields in frames.items()}


def _pose_of_frame(fields: Sequence[float]) -> np.ndarray:
    """Convert the six fields of a POS to a pose (4, 4) [m].

    The fields are x, y, z [mm] and the Euler angles a, e, r [deg] about the moving axes z, y, z.
    """
    z, y = np.eye(3)[[2, 1]]
    a, e, r = np.radians(fields[3:6])
    pose = np.eye(4)
    pose[:3, :3] = rotation(a * z) @ rotation(e * y) @ rotation(r * z)
    pose[:3, 3] = np.asarray(fields[:3]) / 1000.0
    return pose


def rotation(vector: np.ndarray) -> np.ndarray:
    """(3, 3) of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
