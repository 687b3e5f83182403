"""Forward and inverse kinematics of a serial arm, over many samples at once.

`kinematics_for` gives an arm with a spherical wrist its closed form (`spherical_wrist`), any other a numerical inverse
(`numerical`). Both are pure numpy. Poses are those of the tool centre point (TCP) in the base frame.
"""

from agent.robot.kinematics.base import (
    LARGEST_STEP,
    SINGULAR_DISTANCE,
    InverseSolutions,
    Kinematics,
    KinematicsError,
    pose_error,
)
from agent.robot.kinematics.factory import kinematics_for

__all__ = [
    "LARGEST_STEP",
    "SINGULAR_DISTANCE",
    "InverseSolutions",
    "Kinematics",
    "KinematicsError",
    "kinematics_for",
    "pose_error",
]
