"""Closed-form kinematics of a six-axis arm whose axes 2, 3 and 4 are parallel, as those of Universal Robots.

Axis 5 crosses axis 4 and axis 6 crosses axis 5, each at a right angle. The wrist centre w is where axes 5 and 6 meet,
and the forearm ends where axes 4 and 5 meet. Axes 2 to 4 move w in the plane of the arm only, so that in frame B (see
`ArmGeometry`)

    w = Rz(±q₁) [ (a₁, b, 0) + l₂ u(A) + l₃ u(F) + d₅ u(H) ],    u(φ) = (sin φ, 0, cos φ),

with A, F and H the angles of upper arm, forearm and axis 5. As for a spherical wrist, r = ±√(x² + y² - b²) is the reach
of w in that plane (sign: shoulder). In the plane's frame axis 6 is

    z₆ = (-cos H sin β, cos β, sin H sin β),    β = q₅ + constant,

which gives sin β = ±√(z₆ₓ² + z₆z²) (sign: wrist) and H. Without d₅ u(H), what is left is the triangle of l₂ and l₃
(sign: elbow). See K. P. Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms", Georgia
Institute of Technology (2013). An arm whose calibrated axes are parallel only nearly takes Newton steps from there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.robot.kinematics.chain import KinematicChain
from agent.robot.kinematics.closed_form import ArmGeometry, AtZero, ClosedFormKinematics

#: How far [rad, or as part of the arm's length] calibrated axes may be from parallel, perpendicular or meeting.
TOLERANCE = 5e-3


class ParallelAxesKinematics(ClosedFormKinematics):
    """Eight branches of an arm with parallel axes 2, 3 and 4."""

    at_shoulder = ": its wrist is as near to axis 1 as it can be"
    at_wrist = ": it has axes 4 and 6 parallel"

    @staticmethod
    def recognise(chain: KinematicChain) -> ArmGeometry | None:
        """The constants of an arm of this kind, or None for any other arm.

        Its hand d₅ goes from axis 4 to axis 6 along axis 5. The wrist's axes are axis 5, and the third of a
        right-handed frame, and axis 6, all at q₅ = q₆ = 0.
        """
        arm = AtZero(chain, TOLERANCE)
        end, centre = arm.nearest(3), arm.nearest(4)
        if not arm.fits(end, crossing=(0, 3, 4), parallel=(1, 2), meeting=((4, end), (5, centre))):
            return None
        fifth, sixth = arm.axes[4:]
        hand, last = arm.base.T @ fifth, arm.base.T @ sixth
        return ArmGeometry.of(
            arm,
            end,
            centre,
            np.column_stack([fifth, np.cross(sixth, fifth), sixth]),
            float(np.arctan2(last @ np.cross(hand, [0.0, 1.0, 0.0]), last[1])),
            hand=float((centre - end) @ fifth),
            hand_angle=float(np.arctan2(hand[0], hand[2])),
        )

    def _branch(self, wrist: np.ndarray, signs: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        g = self._arm
        r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = wrist
        margins = np.empty((3, wrist.shape[1]))
        margins[0], radial, cos1, sin1 = self._shoulder(x, y, signs[0])

        forward = cos1 * r02 + sin1 * r12
        margins[2] = forward * forward + r22 * r22
        sin5 = signs[2] * np.sqrt(np.maximum(margins[2], np.finfo(float).tiny))
        sin_hand, cos_hand = r22 / sin5, -forward / sin5

        ahead, up = radial - g.shoulder_offset - g.hand * sin_hand, z - g.hand * cos_hand
        margins[1], sin2, cos2, sin_elbow, cos_elbow = self._elbow(ahead, up, signs[1])
        upper, elbow, hand = np.arctan2(sin2, cos2), np.arctan2(sin_elbow, cos_elbow), np.arctan2(sin_hand, cos_hand)

        ax, ay = cos1 * sin_hand, sin1 * sin_hand  # axis 5 in B, against the wrist's axes
        q = np.empty((6, wrist.shape[1]))
        q[0] = g.senses[0] * np.arctan2(sin1, cos1)
        q[1] = g.senses[1] * (upper - g.upper_arm_angle)
        q[2] = g.senses[2] * (elbow - (g.forearm_angle - g.upper_arm_angle))
        q[3] = g.senses[3] * (hand - upper - elbow - (g.hand_angle - g.forearm_angle))
        q[4] = np.arctan2(sin5, cos1 * r12 - sin1 * r02) - g.wrist_angle
        q[5] = np.arctan2(-(ax * r01 + ay * r11 + cos_hand * r21), ax * r00 + ay * r10 + cos_hand * r20)
        return q, margins
