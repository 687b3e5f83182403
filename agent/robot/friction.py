"""Joint friction as columns of a regressor, acting on the axles (see `drivetrain`)."""

from __future__ import annotations

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.drivetrain import axle_motion, joint_columns

#: The three terms of the seed paper: f0 sign(q̇) + f1 q̇ + f2 sign(q̇) q̇².
PAPER_TERMS = ("f0", "f1", "f2")


def smooth_sign(velocity: np.ndarray, transition: np.ndarray | float) -> np.ndarray:
    """tanh(v / transition), or the sign where the transition speed [rad/s] is 0."""
    transition = np.broadcast_to(np.asarray(transition, dtype=float), np.shape(velocity))
    scaled = np.divide(velocity, transition, out=np.copysign(np.inf, velocity), where=transition > 0)
    return np.tanh(np.where(velocity == 0, 0.0, scaled))


def friction_regressor(robot: RobotDescription, qd: np.ndarray, transition: np.ndarray | float = 0.0) -> np.ndarray:
    """(S, n, 3 n) columns of the paper's friction terms: f0 of every axle, then f1, then f2 (AIM 2013, eq. 2).

    `transition` (n,) [rad/s] smooths the sign: 0 gives the paper's own form.
    """
    speed = axle_motion(robot, qd)
    sign = smooth_sign(speed, transition)
    blocks = [joint_columns(robot, columns) for columns in (sign, speed, sign * speed**2)]
    return np.concatenate(blocks, axis=2)
