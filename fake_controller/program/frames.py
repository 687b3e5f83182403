"""Frames as the controller has them: rotations as quaternions and vectors in millimetres, by another library than the
planner's, so that neither repeats the other's mistakes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Transform:
    """First turned by `rotation`, then moved by `offset` (3,) [mm]."""

    rotation: Rotation
    offset: np.ndarray

    @classmethod
    def of_pos(cls, fields: Sequence[float]) -> Transform:
        """Of x, y, z [mm] and the Euler angles a, e, r [deg] about the moving axes z, y, z."""
        return cls(Rotation.from_euler("ZYZ", fields[3:6], degrees=True), np.array(fields[:3], dtype=float))

    @classmethod
    def of_matrix(cls, matrix: np.ndarray) -> Transform:
        """Of a homogeneous matrix (4, 4) [m]."""
        return cls(Rotation.from_matrix(matrix[:3, :3]), 1000.0 * matrix[:3, 3])

    def then(self, inner: Transform) -> Transform:
        """What `inner` says in the frame that this one makes."""
        return Transform(self.rotation * inner.rotation, self.offset + self.rotation.apply(inner.offset))

    def seen_from(self, outer: Transform) -> Transform:
        """This one in the frame that `outer` makes, both being given in the same frame."""
        return Transform(
            outer.rotation.inv() * self.rotation, outer.rotation.apply(self.offset - outer.offset, inverse=True)
        )

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) homogeneous, in metres."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation.as_matrix(), self.offset / 1000.0
        return matrix

    @property
    def pos(self) -> tuple[float, ...]:
        """x, y, z [mm], a, e, r [deg]."""
        w, x, y, z = self.rotation.as_quat(scalar_first=True)
        # Half the sum and half the difference of a and r are the angles of (w, z) and of (x, y).
        total, apart = 2 * np.arctan2(z, w), 2 * np.arctan2(-x, y)
        e = 2 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
        upright = np.hypot(x, y) < 1e-9  # a and r turn about one axis, and so all of it is r
        inverted = np.hypot(w, z) < 1e-9
        a = 0.0 if upright or inverted else (total + apart) / 2
        r = total if upright else -apart if inverted else (total - apart) / 2
        turned = np.degrees([a, e, r])
        turned -= 360 * np.round(turned / 360)
        return (*self.offset.tolist(), *turned.tolist())


def target_in_robot_base(base: Sequence[float], uframe: Sequence[float], pos: Sequence[float]) -> np.ndarray:
    """(4, 4) [m] where a POS is: given in `$UFRAME`, which stands in the world, as the robot does at `$BASE`."""
    in_world = Transform.of_pos(uframe).then(Transform.of_pos(pos))
    return in_world.seen_from(Transform.of_pos(base)).matrix


def tool_point(flange: np.ndarray, base: Sequence[float], tool: Sequence[float], uframe: Sequence[float]) -> Transform:
    """What the controller tells of an arm whose flange is at (4, 4) [m] in its base: the tool point in `$UFRAME`."""
    in_world = Transform.of_pos(base).then(Transform.of_matrix(flange)).then(Transform.of_pos(tool))
    return in_world.seen_from(Transform.of_pos(uframe))
