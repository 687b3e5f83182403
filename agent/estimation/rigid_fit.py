"""A rigid arm fitted to samples by plain least squares, as often as mistakes are tried on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.robot import RobotDescription


@dataclass(frozen=True, eq=False)
class FitSamples:
    """S low-passed samples: q, qd, qdd, torque and the direction of motion, all (S, n); so many are independent."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray
    direction: np.ndarray
    independent: float

    def thinned(self, every: int) -> FitSamples:
        """Every k-th."""
        signals = (self.q, self.qd, self.qdd, self.torque, self.direction)
        q, qd, qdd, torque, direction = (values[::every] for values in signals)
        return FitSamples(q, qd, qdd, torque, direction, self.independent)


class Bodies:
    """Rigid links and rotors of a robot, read once for many fits."""

    def __init__(self, robot: RobotDescription):
        from agent.robot import Dynamics

        self.robot = robot
        self._dynamics = Dynamics(robot)
        self._last: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def of(self, samples: FitSamples) -> np.ndarray:
        """(S, n, 11 n) along the samples; many a mistake is one of torque alone, and has the motion of another."""
        key = id(samples.q)
        if key not in self._last:
            self._last = dict([*self._last.items()][:1])  # the motion as it is, and one of a mistake
            self._last[key] = samples.q, self.regressor(samples.q, samples.qd, samples.qdd)
        return self._last[key][1]

    def regressor(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, 11 n)."""
        from agent.robot import rotor_regressor

        return np.concatenate([self._dynamics.regressor(q, qd, qdd), rotor_regressor(self.robot, qdd)], axis=2)


@dataclass(frozen=True, eq=False)
class Solved:
    """columns (S, n, p) and what least squares makes of them: solution (p,), joints (n,) part of each torque left."""

    columns: np.ndarray
    scale: np.ndarray
    length: np.ndarray
    sizes: np.ndarray
    directions: np.ndarray
    known: np.ndarray
    solution: np.ndarray
    error: np.ndarray
    joints: np.ndarray


def solved(bodies: Bodies, s: FitSamples) -> Solved:
    """Rigid links, rotors, Coulomb, viscous and offset, by least squares with every joint weighted alike."""
    count, n = s.q.shape
    own = np.eye(n)[None]
    coupling = bodies.robot.coupling.T[None]
    axle = s.qd @ bodies.robot.coupling.T, s.direction
    friction = [coupling * column[:, None, :] for column in (axle[1], axle[0])]
    rigid = bodies.of(s)
    columns = np.concatenate([rigid, *friction, np.broadcast_to(own, (count, n, n))], axis=2)
    scale = np.sqrt(np.mean(s.torque**2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    a = (columns / scale[None, :, None]).reshape(count * n, -1)
    length = np.linalg.norm(a, axis=0)
    length[length == 0] = 1.0
    u, sizes, directions = np.linalg.svd(a / length, full_matrices=False)
    known = sizes > 1e-7 * sizes[0]
    solution = directions[known].T @ ((u[:, known].T @ (s.torque / scale).ravel()) / sizes[known]) / length
    error = s.torque - columns @ solution
    joints = np.linalg.norm(error, axis=0) / (scale * np.sqrt(count))
    return Solved(columns, scale, length, sizes, directions, known, solution, error, joints)
