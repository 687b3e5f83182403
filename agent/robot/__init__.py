"""Robot description, kinematics, dynamics, base parameters and friction.

`agent.robot.dynamics` is imported where it is used: it loads Pinocchio.
"""

from agent.robot.description import (
    Capsule,
    CartesianLimits,
    Joint,
    RobotDescription,
    builtin_robots,
    load_robot,
)

__all__ = ["Capsule", "CartesianLimits", "Joint", "RobotDescription", "builtin_robots", "load_robot"]
