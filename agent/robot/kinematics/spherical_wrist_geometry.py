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

#: Axes are taken as parallel, perpendicular or meeting within this [rad, or as part of the arm's length]: URDFs write
#: pi with four digits. What is left of such an error after the closed form is removed by Newton steps.
TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class SphericalWristGeometry:
    """The constants of the module's formulas.

    shoulder_offset a₁, lateral_offset b, upper_arm l₂, forearm l₃ [m]; upper_arm_angle and forearm_angle: of L₂ and L₃
    at zero; senses (3,): +1 or -1, how joints 1 to 3 count against B's axes; wrist_angle: β at q₅ = 0;
    forearm_rotation (3, 3): from B to the wrist's axes (z axis 4, y axis 5); selection (12, 16): takes a flattened pose
    to the wrist's rotation in B (9, row by row) and the wrist centre in B (3).
    """

    shoulder_offset: float
    lateral_offset: float
    upper_arm: float
    forearm: float
    upper_arm_angle: float
    forearm_angle: float
    senses: tuple[float, float, float]
    wrist_angle: float
    forearm_rotation: np.ndarray
    selection: np.ndarray

    @property
    def reach(self) -> float:
        """Length of the stretched arm from axis 2 to the wrist centre [m]."""
        return self.upper_arm + self.forearm


def recognise(chain: KinematicChain) -> SphericalWristGeometry | None:
    """The constants of an arm of this kind, or None for any other arm."""
    if chain.dof != 6 or chain.prismatic.any():
        return None
    axes, points, tcp = chain.axes_at_zero()
    size = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    crossing = [axes[0] @ axes[1], axes[3] @ axes[4], axes[4] @ axes[5]]
    centre = points[3] + axes[3] * ((points[4] - points[3]) @ axes[3])
    missing = [np.linalg.norm(np.cross(axes[k], centre - points[k])) / size for k in (4, 5)]
    parallel = np.linalg.norm(np.cross(axes[1], axes[2]))
    if max(*np.abs(crossing), *missing, parallel) > TOLERANCE:
        return None
    base = _base_frame(axes, points, size)
    origin = points[0] + axes[0] * ((points[1] - points[0]) @ axes[0])
    shoulder = base.T @ (points[1] - origin)
    upper_arm = base.T @ (points[2] - points[1])
    forearm = base.T @ (centre - points[2])
    lengths = np.hypot(upper_arm[0], upper_arm[2]), np.hypot(forearm[0], forearm[2])
    if min(lengths) < TOLERANCE * size:
        return None
    wrist = _frame(axes[3], axes[4])
    last = wrist.T @ axes[5]
    wrist_angle = float(np.arctan2(last[0], last[2]))
    turned = tcp[:3, :3].T @ wrist @ _about_y(wrist_angle)

    def sense(axis: int, across: int) -> float:
        return float(np.sign(axes[axis] @ base[:, across]))

    selection = np.zeros((12, 16))
    entries = [0, 1, 2, 4, 5, 6, 8, 9, 10]  # of the rotation in a flattened pose
    selection[:9, entries] = np.kron(base.T, turned.T)
    selection[9:, entries] = -np.kron(base.T, tcp[:3, :3].T @ (tcp[:3, 3] - centre))
    selection[9:, [3, 7, 11]] = base.T
    selection[9:, 15] = -base.T @ origin
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
        selection=selection,
    )


def _base_frame(axes: np.ndarray, points: np.ndarray, size: float) -> np.ndarray:
    """(3, 3) axes of frame B in the base frame: z upwards where axis 1 is not horizontal, x forward, y across."""
    up = axes[0] if axes[0, 2] > -TOLERANCE else -axes[0]
    frame = _frame(up, axes[1])
    backwards = frame[:, 0] @ (points[1] - points[0]) < -TOLERANCE * size
    return frame @ np.diag([-1.0, -1.0, 1.0]) if backwards else frame


def _frame(z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3, 3) rotation with third column z and second column y, made exactly perpendicular."""
    y = y - z * (z @ y)
    y = y / np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


def _about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
