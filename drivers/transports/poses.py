"""Frames of a controller as every wire has them: the fields of a POS."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def pose_of_frame(fields: Sequence[float]) -> np.ndarray:
    """(4, 4) [m] of x, y, z [mm] and the Euler angles a, e, r [deg]: turned about z by a, then y by e, then z by r."""
    a, e, r = np.radians(fields[3:6])
    pose = np.eye(4)
    pose[:3, :3] = _about_z(a) @ _about_y(e) @ _about_z(r)
    pose[:3, 3] = np.asarray(fields[:3]) / 1000.0
    return pose


def _about_z(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _about_y(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
