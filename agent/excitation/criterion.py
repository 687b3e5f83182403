"""The fitness of a motion: f = log10 det(HᵀH / M) (AIM 2013, eq. 5).

H stacks the rows of the regressor at M points of the motion. Its columns are the base parameters, rotor inertias
included, and the paper's three friction terms of every joint: 58 for the COMAU NS16. The row of joint i is scaled by
τ_nom,i / max τ_nom with the nominal torques on the joint side; an arm without them gets unit weights.

With the columns scaled to unit length, H = Q R D, so that

    f = 2 Σ log10 |R_ii| + 2 Σ log10 D_ii - p log10 M

for p columns, which neither overflows nor squares the condition number. A motion that does not excite a column, or
not independently, has f = -inf.
"""

from __future__ import annotations

import numpy as np

from agent.core import one_blas_thread
from agent.robot import (
    PAPER_TERMS,
    Dynamics,
    ParameterLayout,
    RobotDescription,
    Tool,
    axle_motion,
    base_parameters,
    friction_regressor,
    rotor_regressor,
)

#: Columns of unit length with a reciprocal condition number below this are not excited independently of each other.
DEPENDENT = 1e-10
#: Columns that LAPACK works on at once, which its work space has to allow.
_LAPACK_BLOCK = 32


class Criterion:
    """The criterion for one arm, with the tool it carries.

    `columns` names the p columns: base parameters as combinations of standard ones, then friction.
    """

    def __init__(self, robot: RobotDescription, tool: Tool | None = None):
        self._robot = robot
        self._dynamics = Dynamics(robot, tool)
        base = base_parameters(robot, rotors=True)
        names = dict(zip((int(k) for k in base.independent), base.names, strict=True))
        inertial = ParameterLayout.of(robot).rotors.start
        self._inertial = [k for k in names if k < inertial]
        self._rotors = [k - inertial for k in names if k >= inertial]
        self.weights = torque_weights(robot)
        self._used = self._may_be_used()
        self._sources = [self._source(joint) for joint in range(robot.dof)]
        self._upper = [
            weight * np.triu(np.ones((len(used), len(used))))
            for weight, used in zip(self.weights, self._used, strict=True)
        ]
        self.columns = (
            *(names[k] for k in self._inertial),
            *(names[k + inertial] for k in self._rotors),
            *(f"{term} {joint}" for term in PAPER_TERMS for joint in robot.joint_names),
        )

    def _may_be_used(self) -> list[np.ndarray]:
        """For each joint, the columns of H that are not zero for every motion."""
        q, qd, qdd = np.random.default_rng(0).uniform(0.5, 1.5, (3, 4, self._robot.dof))
        blocks = (
            self._dynamics.regressor(q, qd, qdd)[:, :, self._inertial],
            rotor_regressor(self._robot, qdd)[:, :, self._rotors],
            friction_regressor(self._robot, qd),
        )
        return [np.flatnonzero(of_joint) for of_joint in np.any(np.concatenate(blocks, axis=2) != 0.0, axis=0)]

    def observation_matrix(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(M n, p) H of M points, positions, velocities and accelerations each (M, n)."""
        matrix = np.zeros((len(q), self._robot.dof, len(self.columns)))
        blocks = self._blocks(qd, qdd, self._dynamics.regressor_by_joint(q, qd, qdd))
        for joint, (weight, used, block) in enumerate(zip(self.weights, self._used, blocks, strict=True)):
            matrix[:, joint, used] = weight * block.T
        return matrix.reshape(-1, len(self.columns))

    def __call__(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, regressor: np.ndarray | None = None) -> float:
        """f of M points, each argument (M, n); -inf where they do not excite every column.

        `regressor` (n, 10 n, M) is that of the rigid bodies, where it is known already.
        """
        rigid = self._dynamics.regressor_by_joint(q, qd, qdd) if regressor is None else regressor
        with one_blas_thread():
            return log_determinant(self._triangles(self._blocks(qd, qdd, rigid)), len(q))

    def _blocks(self, qd: np.ndarray, qdd: np.ndarray, rigid: np.ndarray) -> list[np.ndarray]:
        """Of each joint its used columns of H (used, M), without weights."""
        speed = axle_motion(self._robot, qd)
        sign = np.sign(speed)
        rotors = (self._robot.gear_ratios**2 * axle_motion(self._robot, qdd))[:, self._rotors]
        axles = np.concatenate((rotors, sign, speed, sign * speed**2), axis=1).T
        return [
            np.concatenate((of_joint[inertial], share[:, None] * axles[others]))
            for of_joint, (inertial, others, share) in zip(rigid, self._sources, strict=True)
        ]

    def _source(self, joint: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a joint's used columns the inertial ones, those of axles (rotors, friction), and the share of these."""
        inertial = len(self._inertial)
        used, axles = self._used[joint], np.array([*self._rotors, *(list(range(self._robot.dof)) * len(PAPER_TERMS))])
        others = used[used >= inertial] - inertial
        return np.array(self._inertial)[used[used < inertial]], others, self._robot.coupling[axles[others], joint]

    def _triangles(self, blocks: list[np.ndarray]) -> np.ndarray:
        """(rows, p) of the same HᵀH: the rows of each joint turned into a triangle (QR), without its zero columns.

        What lies nearer to the base than a joint does not load it, and its friction is its own: most columns are zero.
        """
        from scipy.linalg.lapack import dgeqrf

        rows = []
        for upper, used, block in zip(self._upper, self._used, blocks, strict=True):
            factored, _, _, _ = dgeqrf(block.T, lwork=_LAPACK_BLOCK * len(block), overwrite_a=True)
            triangle = np.zeros((min(block.shape), len(self.columns)))
            triangle[:, used] = upper[: len(triangle)] * factored[: len(triangle)]
            rows.append(triangle)
        return np.concatenate(rows)


def log_determinant(matrix: np.ndarray, points: int) -> float:
    """log10 det(HᵀH / M) for H = `matrix` (rows, p) and M = `points`; -inf where H has not full column rank."""
    from scipy.linalg.lapack import dgeqrf, dtrcon

    rows, columns = matrix.shape
    lengths = np.linalg.norm(matrix, axis=0)
    if rows < columns or not np.all(lengths > 0):
        return -np.inf
    factored, _, _, _ = dgeqrf(np.asfortranarray(matrix / lengths), lwork=_LAPACK_BLOCK * columns, overwrite_a=True)
    inverse_condition, _ = dtrcon(factored[:columns])
    if not inverse_condition > DEPENDENT:
        return -np.inf
    diagonal = np.abs(np.diag(factored))
    return float(2.0 * np.sum(np.log10(diagonal)) + 2.0 * np.sum(np.log10(lengths)) - columns * np.log10(points))


def torque_weights(robot: RobotDescription) -> np.ndarray:
    """(n,) τ_nom / max τ_nom on the joint side; ones where a joint has no nominal torque."""
    nominal = robot.nominal_torque
    return np.ones(robot.dof) if np.isnan(nominal).any() else nominal / nominal.max()
