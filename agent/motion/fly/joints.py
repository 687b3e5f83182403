"""From TCP to joints along a path, on one branch; what cannot be solved is refused with its move."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from agent.motion import rotation
from agent.motion.fly.move_geometry import Arc, Line, Segment, WristSegment, label_of
from agent.motion.interpolator import MotionError
from agent.motion.pdl2.settings import Pdl2Settings
from agent.robot import Kinematics, KinematicsError

#: WRIST_JNT: steps in which the arm is followed [m], and how near the TCP has to come to its path [m].
_WRIST_STEP, _PLACED = 0.03, 1e-9
_LIMITS = {"unreachable": "reach", "singular": "singularity", "branch": "branch"}


def motion_error(error: KinematicsError, move: int, label: str) -> MotionError:
    """What the kinematics refuses, as the fault of one move."""
    # The kinematics counts the samples of the path; who reads the message has never seen them.
    place = re.sub(r"between poses \d+ and \d+, | \(pose \d+\)", "", str(error))
    place = re.sub(r"\bpose \d+ at", "the point at", place)
    return MotionError(f"{label}: {place}", move, _LIMITS.get(error.reason, error.reason), error.excess)


def solve_cartesian(
    segments: Sequence[Segment],
    move: np.ndarray,
    position: np.ndarray,
    orientation: np.ndarray,
    start: np.ndarray,
    near: np.ndarray | None = None,
) -> np.ndarray:
    """(S, n) joints along TCP positions (S, 3) and orientations (S, 4) from `start` (n,) on.

    `move` (S,) says whose statement a sample is; `near` (S, n): of an arm with joints to spare the nearest to these.

    Raises:
        MotionError: out of reach, singular, or leaving the branch of `start`.
    """
    kinematics: Kinematics = segments[0].kinematics
    try:
        return kinematics.follow(rotation.to_pose(position, orientation), start, near)
    except KinematicsError as error:
        culprit = int(move[min(error.index, len(move) - 1)])
        raise motion_error(error, culprit, label_of(segments, culprit)) from None


def wrist_segment(
    move: int, label: str, settings: Pdl2Settings, kinematics: Kinematics, curve: Line | Arc, ends: np.ndarray
) -> WristSegment:
    """A WRIST_JNT move between joints `ends` (2, 6): the arm is followed along the curve in small steps from its start.

    Raises:
        MotionError: the arm cannot put the TCP on the curve with the wrist turned so, or arrives on another branch.
    """
    turned = float(np.max(np.abs(ends[1] - ends[0])))
    count = int(np.clip(np.ceil(max(curve.length / _WRIST_STEP, turned / (2.0 * _WRIST_STEP))), 4, 400)) + 1
    sigma = np.linspace(0.0, 1.0, count)
    position = curve.position(sigma)
    q = ends[0] + sigma[:, None] * (ends[1] - ends[0])
    for k in range(1, count):
        q[k, :3] = q[k - 1, :3] if k == 1 else 2.0 * q[k - 1, :3] - q[k - 2, :3]
        q[k], error = _placed(kinematics, q[k : k + 1], position[k : k + 1])
        if error > _PLACED:
            _refuse_wrist(move, label, error, max(curve.length, 0.1), "reach")
    away = float(np.max(np.abs(q[-1] - ends[1])))
    if away > 1e-6:
        _refuse_wrist(move, label, away, 1.0, "branch")
    return WristSegment(move, label, settings, kinematics, curve, ends[0], ends[1], q[:, :3])


def solve_wrist(segment: WristSegment, sigma: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(S, 6) joints of a WRIST_JNT move: the wrist is given by σ (S,), the first three joints put the TCP at (S, 3).

    Raises:
        MotionError: the arm cannot put the TCP there with the wrist turned so.
    """
    q = segment.start + sigma[:, None] * (segment.end - segment.start)
    if len(sigma) == 0:
        return q
    places = np.linspace(0.0, 1.0, len(segment.arm))
    for joint in range(3):
        q[:, joint] = np.interp(sigma, places, segment.arm[:, joint])
    q, error = _placed(segment.kinematics, q, position)
    if error > _PLACED:
        _refuse_wrist(segment.move, segment.label, error, max(segment.length, 0.1), "reach")
    return q


def _placed(kinematics: Kinematics, q: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
    """q (S, 6) with the first three joints changed so that the TCP is at position (S, 3), and the largest error [m].

    Newton's method on all samples at once.
    """
    q = q.copy()
    for _ in range(20):
        missing = position - kinematics.forward(q)[:, :3, 3]
        error = float(np.max(np.abs(missing)))
        if error < 1e-12:
            break
        jacobian = kinematics.jacobian(q)[:, :3, :3]
        # Damping keeps a step finite where the arm is stretched; it vanishes with the error.
        damping = 1e-3 * np.einsum("si,si->s", missing, missing) + 1e-15
        normal = jacobian @ jacobian.transpose(0, 2, 1) + damping[:, None, None] * np.eye(3)
        step = np.einsum("sji,sj->si", jacobian, np.linalg.solve(normal, missing[:, :, None])[:, :, 0])
        q[:, :3] += np.clip(step, -0.3, 0.3)
    return q, error


def _refuse_wrist(move: int, label: str, amount: float, scale: float, limit: str) -> None:
    what = (
        f"the TCP stays {1e3 * amount:.3g} mm away from its path"
        if limit == "reach"
        else f"the arm arrives {np.degrees(amount):.0f} degrees away from where it should, on another branch"
    )
    raise MotionError(
        f"{label}: with the wrist turned as WRIST_JNT asks, {what}; choose another $ORNT_TYPE or nearer points",
        move,
        limit,
        amount / scale,
    )
