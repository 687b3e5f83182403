"""From TCP to joints along a path, on one branch; what cannot be solved is refused with its move."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from agent.motion import path_rotation as rotation
from agent.motion.interpolator import MotionError
from agent.motion.path_segments import Segment, WristSegment
from agent.robot.kinematics import Kinematics, KinematicsError

_LIMITS = {"unreachable": "reach", "singular": "singularity", "branch": "branch"}


def motion_error(error: KinematicsError, move: int, label: str) -> MotionError:
    """What the kinematics refuses, as the fault of one move."""
    # The kinematics counts the samples of the path; who reads the message has never seen them.
    place = re.sub(r"between poses \d+ and \d+, at|pose \d+ at", "at", str(error))
    return MotionError(f"{label}: {place}", move, _LIMITS.get(error.reason, error.reason), error.excess)


def matrices(position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """(S, 4, 4) poses from positions (S, 3) and unit quaternions (S, 4)."""
    poses = np.zeros((len(position), 4, 4))
    poses[:, :3, :3] = rotation.to_matrix(orientation)
    poses[:, :3, 3] = position
    poses[:, 3, 3] = 1.0
    return poses


def solve_cartesian(
    segments: Sequence[Segment], move: np.ndarray, position: np.ndarray, orientation: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """(S, n) joints along TCP positions (S, 3) and orientations (S, 4) from `start` (n,) on.

    `move` (S,) says whose statement a sample is.

    Raises:
        MotionError: out of reach, singular, or leaving the branch of `start`.
    """
    kinematics: Kinematics = segments[0].kinematics
    try:
        return kinematics.follow(matrices(position, orientation), start)
    except KinematicsError as error:
        culprit = int(move[min(error.index, len(move) - 1)])
        label = next((segment.label for segment in segments if segment.move == culprit), segments[0].label)
        raise motion_error(error, culprit, label) from None


def solve_wrist(segment: WristSegment, sigma: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(S, 6) joints of a WRIST_JNT move: the wrist is given by σ (S,), the first three joints put the TCP on its path.

    Newton's method on all samples at once, from the straight line between both ends in joint space.

    Raises:
        MotionError: the arm cannot put the TCP there with the wrist turned so.
    """
    q = segment.start + sigma[:, None] * (segment.end - segment.start)
    kinematics: Kinematics = segment.kinematics
    if len(sigma) == 0:
        return q
    for _ in range(20):
        missing = position - kinematics.forward(q)[:, :3, 3]
        if np.max(np.abs(missing)) < 1e-11:
            break
        jacobian = kinematics.jacobian(q)[:, :3, :3]
        # Damping keeps a step finite where the arm is stretched; it vanishes with the error.
        damping = 1e-3 * np.einsum("si,si->s", missing, missing)
        normal = jacobian @ jacobian.transpose(0, 2, 1) + damping[:, None, None] * np.eye(3) + 1e-15 * np.eye(3)
        step = np.einsum("sij,si->sj", jacobian, np.linalg.solve(normal, missing[:, :, None])[:, :, 0])
        q[:, :3] += np.clip(step, -0.3, 0.3)
    error = np.linalg.norm(position - kinematics.forward(q)[:, :3, 3], axis=1)
    if np.max(error) > 1e-9:
        raise MotionError(
            f"{segment.label}: with the wrist turned as WRIST_JNT asks the TCP stays {1e3 * np.max(error):.3g} mm away "
            "from its path; choose another $ORNT_TYPE or nearer points",
            segment.move,
            "reach",
            float(np.max(error)) / max(segment.length, 0.1),
        )
    jump = float(np.max(np.abs(np.diff(q, axis=0)), initial=0.0))
    if jump > 0.5:
        raise MotionError(
            f"{segment.label}: a joint would jump by {np.degrees(jump):.0f} degrees at one point of its path",
            segment.move,
            "branch",
            jump,
        )
    return q
