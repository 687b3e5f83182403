"""Closed-form kinematics of a six-axis arm with a spherical wrist.

The arm: axis 2 across axis 1, axis 3 parallel to axis 2, and axes 4, 5, 6 meeting in one point, the wrist centre, with
5 across 4 and 6 across 5. Any offsets between axes 1 and 2 (along and across axis 2) and between 3 and 4.

In frame B (see `ArmGeometry`) the wrist centre is

    w = Rz(±q₁) [ (a₁, b, 0) + Ry(±q₂) (L₂ + Ry(±q₃) L₃) ],    L₂ and L₃ in the xz plane,

so that its distance from axis 1 gives r = ±√(x² + y² − b²), with r the reach in the plane of the arm (sign: shoulder),
and the triangle of l₂, l₃ and the way from axis 2 to the wrist centre gives the angle γ from upper arm to forearm
(sign: elbow). What rotation is left is the wrist's, Rz(q₄) Ry(β) Rz(q₆) with β = q₅ + constant (sign: wrist). See
Siciliano et al., Robotics (2009), 2.12.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.robot.kinematics.base import SINGULAR_DISTANCE
from agent.robot.kinematics.chain import KinematicChain
from agent.robot.kinematics.closed_form import ArmGeometry, AtZero, ClosedFormKinematics, frame_of
from agent.robot.kinematics.configuration import Configuration, parse_configuration

#: Axes are taken as parallel, perpendicular or meeting within this [rad, or as part of the arm's length]: URDFs write
#: pi with four digits. What is left of such an error after the closed form is removed by Newton steps.
TOLERANCE = 1e-4


class SphericalWristKinematics(ClosedFormKinematics):
    """Eight branches of an arm with a spherical wrist; they have flags in configuration strings."""

    @staticmethod
    def recognise(chain: KinematicChain) -> ArmGeometry | None:
        """The constants of an arm of this kind, or None for any other arm."""
        arm = AtZero(chain, TOLERANCE)
        centre = arm.nearest(3)
        if not arm.fits(centre, crossing=(0, 3, 4), parallel=(1,), meeting=((4, centre), (5, centre))):
            return None
        wrist = frame_of(arm.axes[3], arm.axes[4])
        last = wrist.T @ arm.axes[5]
        angle = float(np.arctan2(last[0], last[2]))
        c, s = np.cos(angle), np.sin(angle)
        turned = wrist @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return ArmGeometry.of(arm, centre, centre, turned, angle, forearm_rotation=wrist.T @ arm.base)

    def solve_configuration(self, pose: np.ndarray, configuration: str) -> np.ndarray:
        wanted = parse_configuration(configuration)
        poses = np.asarray(pose, dtype=float)[None]
        angles, margins = self._branch(self._wrist(poses), wanted.signs)
        if not margins.min() >= SINGULAR_DISTANCE**2:
            self._raise_margin(poses, margins, wanted.signs)
        q, _ = self._polish(poses, self.nearest_turn(angles.T, self.middle))
        return wanted.turned(q[0])

    def configuration(self, q: np.ndarray) -> Configuration:
        """Flags and turns at one configuration (n,)."""
        return Configuration.of(self.branch(q), np.asarray(q, dtype=float))

    def configuration_text(self, q: np.ndarray) -> str:
        return str(self.configuration(q))

    def _branch(self, wrist: np.ndarray, signs: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As in `ClosedFormKinematics`; sines and cosines of the first three joints come from the triangle itself."""
        g = self._arm
        r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = wrist
        margins = np.empty((3, wrist.shape[1]))
        margins[0], radial, cos1, sin1 = self._shoulder(x, y, signs[0])
        margins[1], sin2, cos2, sin_elbow, cos_elbow = self._elbow(radial - g.shoulder_offset, z, signs[1])
        cos0, sin0 = np.cos(g.forearm_angle), np.sin(g.forearm_angle)
        sin3, cos3 = sin2 * cos_elbow + cos2 * sin_elbow, cos2 * cos_elbow - sin2 * sin_elbow  # and of the forearm
        sin, cos = sin3 * cos0 - cos3 * sin0, cos3 * cos0 + sin3 * sin0  # of the rotation of link 3 about y

        # Third column of what rotation is left, in the wrist's axes: (cos q4 sin β, sin q4 sin β, cos β).
        forward = cos1 * r02 + sin1 * r12
        last = np.stack([cos * forward - sin * r22, cos1 * r12 - sin1 * r02, sin * forward + cos * r22])
        c4, s4, cos5 = g.forearm_rotation @ last
        margins[2] = c4 * c4 + s4 * s4
        # Third row: axis 4 in B against the first two columns of the wrist's rotation: (-sin β cos q6, sin β sin q6).
        kx, ky, kz = g.forearm_rotation[2]
        ahead4, up4 = cos * kx + sin * kz, cos * kz - sin * kx
        ax, ay = cos1 * ahead4 - sin1 * ky, sin1 * ahead4 + cos1 * ky
        c6 = -(ax * r00 + ay * r10 + up4 * r20)
        s6 = ax * r01 + ay * r11 + up4 * r21

        q = np.empty((6, wrist.shape[1]))
        np.arctan2(sin1, cos1, out=q[0])
        q[0] *= g.senses[0]
        np.arctan2(sin2, cos2, out=q[1])
        q[1] -= g.upper_arm_angle
        q[1] *= g.senses[1]
        np.arctan2(sin_elbow, cos_elbow, out=q[2])
        q[2] -= g.forearm_angle - g.upper_arm_angle
        q[2] *= g.senses[2]
        np.arctan2(signs[2] * s4, signs[2] * c4, out=q[3])
        np.arctan2(signs[2] * np.sqrt(margins[2]), cos5, out=q[4])
        q[4] -= g.wrist_angle
        np.arctan2(signs[2] * s6, signs[2] * c6, out=q[5])
        return q, margins
