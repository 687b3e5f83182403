"""Motors, gears and their coupling: what acts between the motor currents and the joint torques.

With the coupling C of the robot description an axle turns at w = C q̇ (motor speed over gear ratio), and a torque
f on the axles is a torque Cᵀ f on the joints (virtual work).
"""

from __future__ import annotations

import numpy as np

from agent.core import InputError
from agent.robot.description import RobotDescription

#: The three friction terms of the paper: f0 sign(q̇) + f1 q̇ + f2 sign(q̇) q̇² (AIM 2013, eq. 2).
PAPER_TERMS = ("f0", "f1", "f2")


def axle_motion(robot: RobotDescription, motion: np.ndarray) -> np.ndarray:
    """(S, n) of the axles, from (S, n) positions, velocities or accelerations of the joints."""
    return motion @ robot.coupling.T


def torque_per_ampere(robot: RobotDescription) -> np.ndarray:
    """(n, n) Cᵀ diag(g k): torque on the joints per motor current [N·m/A], k the motors' torque constants.

    Raises:
        InputError: a joint's torque constant is not in the robot description.
    """
    constants = [joint.torque_constant for joint in robot.joints]
    missing = [joint.name for joint in robot.joints if joint.torque_constant is None]
    if missing:
        raise InputError(
            f"robot {robot.name}: the link delivers motor currents, and the description has no torque_constant for "
            f"{', '.join(missing)}: add it [N·m/A, motor side] from the motors' data sheets"
        )
    return robot.coupling.T @ np.diag(robot.gear_ratios * np.array(constants, dtype=float))


def joint_columns(robot: RobotDescription, axle_columns: np.ndarray) -> np.ndarray:
    """(S, n, n) block whose column k is an axle function (S, n)[:, k] acting on axle k, seen at the joints."""
    return robot.coupling.T[None, :, :] * axle_columns[:, None, :]


def rotor_regressor(robot: RobotDescription, qdd: np.ndarray) -> np.ndarray:
    """(S, n, n) columns of the rotor inertias [kg·m², motor side]: τ = Cᵀ diag(g²) J C q̈."""
    return joint_columns(robot, robot.gear_ratios**2 * axle_motion(robot, qdd))


def rotor_mass_matrix(robot: RobotDescription, rotor_inertias: np.ndarray) -> np.ndarray:
    """(n, n) Cᵀ diag(g² J) C [kg·m²] for rotor inertias (n,) [kg·m², motor side]."""
    return robot.coupling.T @ np.diag(robot.gear_ratios**2 * rotor_inertias) @ robot.coupling


def friction_regressor(robot: RobotDescription, qd: np.ndarray) -> np.ndarray:
    """(S, n, 3 n) columns of `PAPER_TERMS`: f0 of every axle, then f1, then f2."""
    speed = axle_motion(robot, qd)
    sign = np.sign(speed)
    return np.concatenate([joint_columns(robot, term) for term in (sign, speed, sign * speed**2)], axis=2)
