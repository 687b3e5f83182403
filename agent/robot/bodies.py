"""The regressor of a robot's base parameters: which column acts on which joint, and torque from parameters."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from agent.robot.drivetrain import rotor_regressor
from agent.robot.parameter_layout import ParameterLayout

if TYPE_CHECKING:
    from agent.robot.description import RobotDescription
    from agent.robot.dynamics import Dynamics, Tool

#: Standard parameters of a kilogram of some size.
_BODY = (1.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.01, 0.0, 0.0, 0.01)
_CHUNK = 256  # samples of the regressor worked on at a time: it stays in the cache


class RigidBodies:
    """The regressor of base parameters, with which (joint, parameter) pairs can be other than zero.

    `independent` (b,) are the standard parameters kept as base parameters; `projection` (b, p) turns standard ones into
    base ones; `standard_names` (p,), and the `combinations` (b,) of them as text (see `agent.robot.base_reduction`);
    `support[i]` lists what acts on joint i.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        independent: np.ndarray,
        projection: np.ndarray,
        standard_names: tuple[str, ...],
        combinations: tuple[str, ...],
    ):
        self.robot, self.dynamics = dynamics.robot, dynamics
        self.independent, self.projection = independent, projection
        self.standard_names, self.combinations = standard_names, combinations
        rng = np.random.default_rng(0)
        samples = (50, self.robot.dof)
        columns = self.columns(rng.uniform(-3, 3, samples), rng.normal(size=samples), rng.normal(size=samples))
        largest = np.abs(columns).max(axis=(0, 1))
        acts = np.abs(columns).max(axis=0) > 1e-12 * np.where(largest > 0, largest, 1.0)
        self.support = tuple(np.flatnonzero(row) for row in acts)

    @property
    def count(self) -> int:
        """Number of base parameters b."""
        return len(self.independent)

    def columns(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, b)."""
        columns = np.empty((*q.shape, self.count))
        for part in _chunks(len(q)):
            columns[part] = self._regressor(q[part], qd[part], qdd[part])[:, :, self.independent]
        return columns

    def acting(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, Σ b_i) what is other than zero of `columns`: for each joint those that `support` lists."""
        joints = np.repeat(np.arange(self.robot.dof), [len(support) for support in self.support])
        standard = self.independent[np.concatenate(self.support)]
        rows = joints * ParameterLayout.of(self.robot).size + standard
        columns = np.empty((len(rows), len(q)))
        for part in _chunks(len(q)):
            regressor = self._regressor(q[part], qd[part], qdd[part])
            columns[:, part] = regressor.reshape(len(regressor), -1)[:, rows].T
        return columns.T

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """(S, n) [N·m] for base parameters (b,)."""
        # of all links with these base parameters some with mass, which Newton and Euler need: cheaper than the columns
        bodies = np.append(np.tile(_BODY, self.robot.dof), np.zeros(self.robot.dof))
        bodies = bodies + self._inverse @ (parameters - self.projection @ bodies)
        layout = ParameterLayout.of(self.robot)
        torque = self.dynamics.with_parameters(bodies[layout.links]).inverse_dynamics(q, qd, qdd)
        return torque + rotor_regressor(self.robot, qdd) @ bodies[layout.rotors]

    @cached_property
    def _inverse(self) -> np.ndarray:
        """(11 n, b) from base parameters to the shortest standard ones."""
        return np.linalg.pinv(self.projection)

    def _regressor(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, 11 n) of all standard parameters."""
        return np.concatenate([self.dynamics.regressor(q, qd, qdd), rotor_regressor(self.robot, qdd)], axis=2)


def _chunks(size: int) -> Iterator[slice]:
    return (slice(first, first + _CHUNK) for first in range(0, size, _CHUNK))


def rigid_bodies(robot: RobotDescription, tool: Tool | None = None) -> RigidBodies:
    """The regressor of a robot's base parameters, with a tool as part of its last link."""
    from agent.robot.base_reduction import base_parameters
    from agent.robot.dynamics import Dynamics

    base = base_parameters(robot)
    return RigidBodies(Dynamics(robot, tool), base.independent, base.projection, base.standard_names, base.names)
