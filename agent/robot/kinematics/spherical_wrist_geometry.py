"""The geometry of a six-axis arm with a spherical wrist.

The arm: axis 2 across axis 1, axis 3 parallel to axis 2, and axes 4, 5, 6 meeting in one point, the wrist centre, with
5 across 4 and 6 across 5. Any offsets between axes 1 and 2 (along and across axis 2) and between 3 and 4.

Frame B stands on axis 1 at the height of axis 2, with y along axis 2 when q₁ = 0, and x forward: where axis 2 lies from
axis 1 or, where they meet, where axis 2 leans an upright arm when it turns positively. There the wrist centre is

    w = Rz(±q₁) [ (a₁, b, 0) + Ry(±q₂) (L₂ + Ry(±q₃) L₃) ],    L₂ and L₃ in the xz plane,

so that its distance from axis 1 gives r = ±√(x² + y² − b²), with r the reach in the plane of the arm (sign: shoulder),
and the triangle of l₂, l₃ and the way from axis 2 to the wrist centre gives the angle γ from upper arm to forearm
(sign: elbow). What rotation is left is the wrist's, Rz(q₄) Ry(β) Rz(q₆) with β = q₅ + constant (sign: wrist). Angles in
the xz plane count from z towards x, as a rotation about y turns. See Siciliano et al., Robotics (2009), 2.12.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.robot.kinematics.chain import KinematicChain
from agent.robot.kinematics.closed_form import ArmGeometry, base_frame, frame_of, nearest_point, selection_of

#: Axes are taken as parallel, perpendicular or meeting within this [rad, or as part of the arm's length]: URDFs write
#: pi with four digits. What is left of such an error after the closed form is removed by Newton steps.
TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class SphericalWristGeometry(ArmGeometry):
    """As `ArmGeometry`; `senses` (3,); forearm_rotation (3, 3): from B to the wrist's axes (z axis 4, y axis 5)."""

    forearm_rotation: np.ndarray


def recognise(chain: KinematicChain) -> SphericalWristGeometry | None:
    """The constants of an arm of this kind, or None for any other arm."""
    if chain.dof != 6 or chain.prismatic.any():
        return None
    axes, points, tcp = chain.axes_at_zero()
    size = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    crossing = [axes[0] @ axes[1], axes[3] @ axes[4], axes[4] @ axes[5]]
    centre = nearest_point(axes, points, 3)
    missing = [np.linalg.norm(np.cross(axes[k], centre - points[k])) / size for k in (4, 5)]
    parallel = np.linalg.norm(np.cross(axes[1], axes[2]))
    if max(*np.abs(crossing), *missing, parallel) > TOLERANCE:
        return None
    base, origin = base_frame(axes, points, TOLERANCE)
    shoulder = base.T @ (points[1] - origin)
    upper_arm = base.T @ (points[2] - points[1])
    forearm = base.T @ (centre - points[2])
    lengths = np.hypot(upper_arm[0], upper_arm[2]), np.hypot(forearm[0], forearm[2])
    if min(lengths) < TOLERANCE * size:
        return None
    wrist = frame_of(axes[3], axes[4])
    last = wrist.T @ axes[5]
    wrist_angle = float(np.arctan2(last[0], last[2]))

    def sense(axis: int, across: int) -> float:
        return float(np.sign(axes[axis] @ base[:, across]))

    return SphericalWristGeometry(
        shoulder_offset=float(shoulder[0]),
        lateral_offset=float((base.T @ (centre - origin))[1]),
        upper_arm=float(lengths[0]),
        forearm=float(lengths[1]),
        upper_arm_angle=float(np.arctan2(upper_arm[0], upper_arm[2])),
        forearm_angle=float(np.arctan2(forearm[0], forearm[2])),
        senses=(sense(0, 2), sense(1, 1), sense(2, 1)),
        wrist_angle=wrist_angle,
        forearm_rotation=wrist.T @ base,
        selection=selection_of(base, origin, tcp, centre, wrist @ _about_y(wrist_angle)),
    )


def _about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
