"""Torque that a motion needs by the description's inertias, compared with the drives' largest torque."""

from __future__ import annotations

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.drivetrain import rotor_regressor
from agent.robot.dynamics import Dynamics, Tool


class TorqueLimits:
    """`max_torque` of a robot's joints, with a tool and in addition a known `load` at the flange."""

    def __init__(self, robot: RobotDescription, tool: Tool | None = None, load: Tool | None = None):
        self._robot = robot
        self._dynamics = Dynamics(robot, tool)
        change = [] if load is None else [Dynamics(robot, carried).standard_parameters() for carried in (load, None)]
        self._load = change[0] - change[1] if change else None
        self._rotors = np.array([joint.rotor_inertia or 0.0 for joint in robot.joints])
        self._largest = np.array([joint.max_torque or np.inf for joint in robot.joints])

    def overload(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, rigid: np.ndarray | None = None
    ) -> tuple[float, str] | None:
        """How far over its limit the joint is that is furthest, as a share of it, and in words; None within all.

        Args:
            q, qd, qdd: (S, n) samples of the motion [rad, rad/s, rad/s²].
            rigid: (S, n) [N·m] torque of bodies and tool there, where it is known already.
        """
        if np.isinf(self._largest).all():
            return None
        torque = self._dynamics.inverse_dynamics(q, qd, qdd) if rigid is None else rigid
        if self._load is not None:
            torque = torque + (self._load @ self._dynamics.regressor_by_joint(q, qd, qdd)).T
        torque = np.abs(torque + rotor_regressor(self._robot, qdd) @ self._rotors)
        excess = (torque / self._largest).max(axis=0) - 1.0
        joint = int(np.argmax(excess))
        if excess[joint] <= 0:
            return None
        return float(excess[joint]), (
            f"{self._robot.joint_names[joint]} needs {torque[:, joint].max():.0f} N·m by the description's "
            f"inertias, its max_torque is {self._largest[joint]:g} N·m"
        )
