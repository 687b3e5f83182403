"""Joint friction as columns of a regressor, acting on the axles (see `drivetrain`)."""

from __future__ import annotations

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.drivetrain import axle_motion, joint_columns

#: The three terms of the seed paper: f0 sign(q̇) + f1 q̇ + f2 sign(q̇) q̇².
PAPER_TERMS = ("f0", "f1", "f2")


def friction_regressor(robot: RobotDescription, qd: np.ndarray) -> np.ndarray:
    """(S, n, 3 n) columns of the paper's friction terms: f0 of every axle, then f1, then f2 (AIM 2013, eq. 2)."""
    speed = axle_motion(robot, qd)
    sign = np.sign(speed)
    blocks = [joint_columns(robot, columns) for columns in (sign, speed, sign * speed**2)]
    return np.concatenate(blocks, axis=2)
