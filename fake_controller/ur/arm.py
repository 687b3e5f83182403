"""Kinematics of a UR arm from its own Denavit-Hartenberg table, and poses as URScript has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

#: a2, a3 and d1, d4, d5, d6 [m], robot type of the configuration message, and model as the dashboard tells it.
#: "DH Parameters for calculations of kinematics and dynamics" of the vendor.
MODELS = {
    "ur3e": ((-0.24355, -0.2132), (0.15185, 0.13105, 0.08535, 0.0921), 3, "UR3"),
    "ur5e": ((-0.425, -0.3922), (0.1625, 0.1333, 0.0997, 0.0996), 1, "UR5"),
    "ur10e": ((-0.6127, -0.57155), (0.1807, 0.17415, 0.11985, 0.11655), 2, "UR10"),
}
_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
_CALIBRATION = 2e-4  # m and rad, standard deviation of an individual arm from the table
_KNOT = 96  # poses of a path between two that are solved one after the other
_LARGEST_STEP = 0.3  # rad
_NEAR, _REACHED, _CONVERGED = 1e-4, 1e-6, 1e-10  # m and rad


class Unreachable(Exception):
    """A pose that the arm cannot take, or not by a continuous motion."""


@dataclass(frozen=True, eq=False)
class DenavitHartenberg:
    """Standard Denavit-Hartenberg parameters (6,) each [m, rad]."""

    a: np.ndarray
    d: np.ndarray
    alpha: np.ndarray
    theta: np.ndarray

    @classmethod
    def nominal(cls, model: str) -> DenavitHartenberg:
        """The published table of a model."""
        (a2, a3), (d1, d4, d5, d6), *_ = MODELS[model]
        a, d = np.array([0, a2, a3, 0, 0, 0.0]), np.array([d1, 0, 0, d4, d5, d6])
        return cls(a, d, np.array(_ALPHA), np.zeros(6))

    def calibrated(self, seed: int) -> DenavitHartenberg:
        """As measured in the factory on the individual of a seed."""
        off = _CALIBRATION * np.random.default_rng([seed, 31]).standard_normal((3, 6))
        return DenavitHartenberg(self.a + off[0], self.d + off[1], self.alpha + off[2], self.theta)

    def forward(self, q: np.ndarray) -> np.ndarray:
        """(K, 4, 4) flange poses at joint positions (K, 6)."""
        return self._frames(q)[-1]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """(K, 6, 6) of the flange in the base frame, linear above angular."""
        return _jacobian(self._frames(q))

    def inverse(self, goals: np.ndarray, start: np.ndarray) -> np.ndarray:
        """(K, 6) joint positions of a path of flange poses (K, 4, 4) that goes on from `start` (6,).

        Raises:
            Unreachable: a pose out of reach, or a singularity on the way.
        """
        knots = np.unique(np.append(np.arange(0, len(goals), _KNOT), len(goals) - 1))
        solved, q = [], start[None]
        for knot in knots:
            q = self._solve(goals[knot : knot + 1], q, 25, _NEAR)
            solved.append(q[0])
        between = CubicSpline(knots, solved)(np.arange(len(goals))) if len(knots) > 1 else np.array(solved)
        return self._solve(goals, between, 8)

    def nearest(self, goal: np.ndarray, near: np.ndarray) -> np.ndarray:
        """(6,) joint positions of a flange pose (4, 4), the nearest to `near` (6,) that were found.

        Raises:
            Unreachable: there is no solution.
        """
        rng, solutions = np.random.default_rng(0), []
        for start in (near, *(near + rng.uniform(-1.5, 1.5, (30, 6)))):
            try:
                q = self._solve(goal[None], start[None], 50)[0]
            except Unreachable:
                continue
            solutions.append(near + (q - near + np.pi) % (2 * np.pi) - np.pi)
            if len(solutions) == 6 or np.abs(solutions[-1] - near).max() < 1.0:
                break
        if not solutions:
            raise Unreachable("no joint positions reach this pose")
        return min(solutions, key=lambda q: float(np.abs(q - near).max()))

    def _frames(self, q: np.ndarray) -> list[np.ndarray]:
        frames = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
        cosines, sines = np.cos(q + self.theta), np.sin(q + self.theta)
        for k in range(6):
            x, y, z, origin = (frames[-1][:, :3, column] for column in range(4))
            c, s, ca, sa = cosines[:, k, None], sines[:, k, None], np.cos(self.alpha[k]), np.sin(self.alpha[k])
            across = c * y - s * x
            pose = np.zeros((len(q), 4, 4))
            pose[:, :3, 0] = c * x + s * y
            pose[:, :3, 1] = ca * across + sa * z
            pose[:, :3, 2] = ca * z - sa * across
            pose[:, :3, 3] = origin + self.d[k] * z + self.a[k] * pose[:, :3, 0]
            pose[:, 3, 3] = 1.0
            frames.append(pose)
        return frames

    def _solve(self, goals: np.ndarray, q: np.ndarray, steps: int, enough: float = _CONVERGED) -> np.ndarray:
        """Newton's method at all poses at once; a step from an error below a root of `enough` leads to less than it."""
        for _ in range(steps):
            frames = self._frames(q)
            error = twist_between(frames[-1], goals)
            residual = np.abs(error).max()
            if residual < enough:
                return q
            try:
                step = np.linalg.solve(_jacobian(frames), error[..., None])[..., 0]
            except np.linalg.LinAlgError:
                break
            largest = np.abs(step).max(axis=1, keepdims=True)
            q = q + step * np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-12))
            if residual < 0.1 * np.sqrt(enough) and largest.max() < np.sqrt(enough):
                return q
        if np.abs(twist_between(self.forward(q), goals)).max() > max(enough, _REACHED):
            raise Unreachable("a pose is out of reach or beyond a singularity")
        return q


def _jacobian(frames: list[np.ndarray]) -> np.ndarray:
    axes = np.stack([frame[:, :3, 2] for frame in frames[:-1]], axis=2)
    arms = np.stack([frames[-1][:, :3, 3] - frame[:, :3, 3] for frame in frames[:-1]], axis=2)
    return np.concatenate([np.cross(axes, arms, axis=1), axes], axis=1)


def twist_between(poses: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """(K, 6) translation and rotation vector, in the base frame, that lead from poses (K, 4, 4) to goals."""
    rotation = Rotation.from_matrix(goals[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.hstack([goals[:, :3, 3] - poses[:, :3, 3], rotation])


def matrix_of(pose: Sequence[float] | np.ndarray) -> np.ndarray:
    """(4, 4) of a URScript pose: x, y, z [m] and a rotation vector [rad]."""
    return matrices_of(np.asarray(pose, float)[None])[0]


def matrices_of(poses: np.ndarray) -> np.ndarray:
    """(K, 4, 4) of URScript poses (K, 6)."""
    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, :3, :3] = Rotation.from_rotvec(poses[:, 3:]).as_matrix()
    matrices[:, :3, 3], matrices[:, 3, 3] = poses[:, :3], 1.0
    return matrices


def poses_of(matrices: np.ndarray) -> np.ndarray:
    """(K, 6) URScript poses of matrices (K, 4, 4)."""
    return np.hstack([matrices[:, :3, 3], Rotation.from_matrix(matrices[:, :3, :3]).as_rotvec()])
