"""POS coordinates and poses: millimetres and degrees on one side, homogeneous matrices in metres on the other."""

from __future__ import annotations

import numpy as np


def pos_to_pose(pos: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) [m] of coordinates (..., 6): x, y, z [mm] and the Euler angles a, e, r [deg].

    Euler ZYZ: R = Rz(a) · Ry(e) · Rz(r).
    """
    pos = np.asarray(pos, dtype=float)
    sine, cosine = np.sin(np.radians(pos[..., 3:])), np.cos(np.radians(pos[..., 3:]))
    sa, se, sr = sine[..., 0], sine[..., 1], sine[..., 2]
    ca, ce, cr = cosine[..., 0], cosine[..., 1], cosine[..., 2]
    pose = np.zeros((*pos.shape[:-1], 4, 4))
    pose[..., 0, 0] = ca * ce * cr - sa * sr
    pose[..., 0, 1] = -ca * ce * sr - sa * cr
    pose[..., 0, 2] = ca * se
    pose[..., 1, 0] = sa * ce * cr + ca * sr
    pose[..., 1, 1] = -sa * ce * sr + ca * cr
    pose[..., 1, 2] = sa * se
    pose[..., 2, 0] = -se * cr
    pose[..., 2, 1] = se * sr
    pose[..., 2, 2] = ce
    pose[..., :3, 3] = pos[..., :3] / 1000.0
    pose[..., 3, 3] = 1.0
    return pose + 0.0  # no negative zeros


def pose_to_pos(pose: np.ndarray) -> np.ndarray:
    """Coordinates (..., 6) of poses (..., 4, 4) [m]: x, y, z [mm], a in (-180, 180], e in [0, 180], r [deg].

    a = atan2(r12, r02); e and r are read after turning back by a, which equals acos(r22) and atan2(r21, -r20) and
    stays exact where those lose their digits. Where e is 0 or 180 the angles a and r are not both determined: a is 0.
    """
    pose = np.asarray(pose, dtype=float)
    along, across = pose[..., 0, 2], pose[..., 1, 2]
    degenerate = np.hypot(along, across) < 1e-12
    a = np.where(degenerate, 0.0, np.arctan2(across, along))
    ca, sa = np.cos(a), np.sin(a)
    e = np.arctan2(np.where(degenerate, 0.0, ca * along + sa * across), pose[..., 2, 2])
    r = np.arctan2(ca * pose[..., 1, 0] - sa * pose[..., 0, 0], ca * pose[..., 1, 1] - sa * pose[..., 0, 1])
    angles = np.degrees(np.stack([a, e, r], axis=-1))
    return np.concatenate([1000.0 * pose[..., :3, 3], angles], axis=-1)
