"""Robot description, kinematics, dynamics, base parameters and friction.

`agent.robot.dynamics` is imported where it is used: it loads Pinocchio. So is
`agent.robot.base_reduction`, whose function has its name.
"""

from agent.robot.description import (
    Box,
    Capsule,
    CartesianLimits,
    Joint,
    RobotDescription,
    builtin_robots,
    load_robot,
)
from agent.robot.kinematics import InverseSolutions, Kinematics, KinematicsError, kinematics_for

__all__ = [
    "Box",
    "Capsule",
    "CartesianLimits",
    "InverseSolutions",
    "Joint",
    "Kinematics",
    "KinematicsError",
    "RobotDescription",
    "builtin_robots",
    "kinematics_for",
    "load_robot",
]
