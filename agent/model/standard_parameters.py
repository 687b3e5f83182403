"""From base parameters to bodies: inertial parameters of every link that could exist and that give the same torques.

Base parameters fix b combinations of the 11 n standard parameters (ten a link, one rotor inertia a joint); the others
are free. Where the fit itself found bodies (`consistent`), those are the answer. Else, of all sets with P π = β the one
is taken that is nearest to the URDF in the sense of relative entropy,

    Σ_links tr(S_k⁻¹ S(π)) - log det S(π) + Σ_joints J / J₀ - log J,

with S the 4 × 4 pseudo-inertia of a link and S_k that of the URDF (Lee, Wensing and Park, IEEE T-RO 36, 2020). It does
not depend on units or frames, and its logarithms keep bodies physical: S positive definite, J positive. Newton's method
from the URDF, which need not have these base parameters (Boyd and Vandenberghe, Convex Optimization, 10.3), ends on
P π = β to round-off.
"""

from __future__ import annotations

import numpy as np

from agent.core import RejectedError
from agent.model.rigid_friction import RigidFrictionModel
from agent.robot import ParameterLayout, RobotDescription

_ROUNDS = 200
_DECREMENT = 1e-9
_SHORTEST_STEP = 1e-8
_THINNEST = 1e-9  # smallest eigenvalue of a pseudo-inertia that counts as positive, in units of the link's own size
_WEIGHTLESS = 0.02  # of the arm's mass, for a link that the URDF gives no mass
_WEIGHTLESS_RADIUS = 0.03  # of the reach: its size
_LEAST_RADIUS = 0.001  # of the reach: the size of any other link, along its thinnest direction
_USUAL_ROTOR = 0.5  # of the mean inertia about the joint, where the description has none


def full_parameters(model: RigidFrictionModel) -> np.ndarray:
    """(11 n,) physical standard parameters, links base to tip, then rotor inertias [motor side], with P π = β.

    Raises:
        RejectedError: no physical bodies have these base parameters, or the fit's own are not physical.
    """
    if model.standard is not None:
        check_physical(model.robot, model.standard)
        return model.standard
    standard = _nearest(model)
    if standard is None:
        raise RejectedError(
            f"no links that could exist have the base parameters of this {model.method!r} fit (a negative mass, "
            "inertia or rotor would be needed), so there is nothing to export; estimate with --method consistent"
        )
    return standard


def check_physical(robot: RobotDescription, standard: np.ndarray) -> None:
    """Raise RejectedError unless every link (11 n,) has a mass distribution and no rotor inertia is negative."""
    layout, standard = ParameterLayout.of(robot), np.asarray(standard, dtype=float)
    for block, rotor, name in zip(layout.blocks(standard), standard[layout.rotors], robot.joint_names, strict=True):
        matrix = pseudo_inertia(block)
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        if np.any(np.diag(matrix) <= 0) or np.linalg.eigvalsh(matrix / np.outer(size, size))[0] <= _THINNEST:
            raise RejectedError(
                f"the link that {name} moves is not a body that could exist (mass {block[0]:.4g} kg): its mass and "
                "inertia need a density below zero somewhere; estimate with --method consistent"
            )
        if rotor < 0:
            raise RejectedError(f"the rotor inertia of {name} is {rotor:.3g} kg·m²; estimate with --method consistent")


def pseudo_inertia(block: np.ndarray) -> np.ndarray:
    """(4, 4) [[½ tr(I) 1 - I, m c], [m cᵀ, m]] of ten standard parameters (10,)."""
    return np.tensordot(block, LOG_DET_BASIS, axes=1)


def _basis() -> np.ndarray:
    """(10, 4, 4): pseudo-inertia per unit of m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz."""
    basis = np.zeros((10, 4, 4))
    basis[0, 3, 3] = 1.0
    for axis in range(3):
        basis[1 + axis, axis, 3] = basis[1 + axis, 3, axis] = 1.0
    for k, (i, j) in {4: (0, 0), 5: (0, 1), 6: (1, 1), 7: (0, 2), 8: (1, 2), 9: (2, 2)}.items():
        if i == j:
            basis[k, [0, 1, 2], [0, 1, 2]] = 0.5
            basis[k, i, i] = -0.5
        else:
            basis[k, i, j] = basis[k, j, i] = -1.0
    return basis


LOG_DET_BASIS = _basis()


def from_pseudo_inertia(matrix: np.ndarray) -> np.ndarray:
    """(10,) the inverse of `pseudo_inertia`."""
    return np.linalg.lstsq(LOG_DET_BASIS.reshape(10, 16).T, matrix.ravel(), rcond=None)[0]


def _nearest(model: RigidFrictionModel) -> np.ndarray | None:
    """(11 n,) nearest to the URDF, or None where there is none."""
    layout = ParameterLayout.of(model.robot)
    start = reference_parameters(model)
    slope = log_det_gradient(start, layout)
    # in units of the curvature at the start, and with rows of unit length
    scale = 1 / np.sqrt(np.diag(log_det_hessian(start, layout)))
    rows = model.projection * scale
    length = np.linalg.norm(rows, axis=1)
    rows, target = rows / length[:, None], model.base_values / length
    unknown, dual = start / scale, np.zeros(len(rows))

    def residual(unknown: np.ndarray, dual: np.ndarray) -> np.ndarray:
        gradient = scale * (slope - log_det_gradient(scale * unknown, layout))
        return np.concatenate([gradient + rows.T @ dual, rows @ unknown - target])

    left = residual(unknown, dual)
    size, b = len(unknown), len(rows)
    for _ in range(_ROUNDS):
        kkt = np.zeros((size + b, size + b))
        kkt[:size, :size] = log_det_hessian(scale * unknown, layout) * np.outer(scale, scale)
        kkt[:size, size:], kkt[size:, :size] = rows.T, rows
        step = np.linalg.solve(kkt, -left)
        share = 1.0
        while not is_inside(scale * (unknown + share * step[:size]), layout) or np.linalg.norm(
            new := residual(unknown + share * step[:size], dual + share * step[size:])
        ) > (1 - 0.01 * share) * np.linalg.norm(left):
            share /= 2
            if share < _SHORTEST_STEP:
                break
        if share < _SHORTEST_STEP:
            break
        unknown, dual, left = unknown + share * step[:size], dual + share * step[size:], new
        if np.linalg.norm(step[:size]) < _DECREMENT * np.linalg.norm(unknown):
            break
    found = scale * unknown
    # the last digits: the shortest correction onto P π = β
    found = found + scale * (np.linalg.pinv(rows) @ (target - rows @ (found / scale)))
    fits = np.linalg.norm(rows @ unknown - target) <= 1e-8 * np.linalg.norm(target)
    return found if fits and is_inside(found, layout) else None


def log_det_gradient(standard: np.ndarray, layout: ParameterLayout) -> np.ndarray:
    """(11 n,) gradient of Σ log det S + Σ log J."""
    inverse = [np.linalg.inv(pseudo_inertia(block)) for block in layout.blocks(standard)]
    return np.concatenate([*(np.einsum("kij,ji->k", LOG_DET_BASIS, s) for s in inverse), 1 / standard[layout.rotors]])


def log_det_hessian(standard: np.ndarray, layout: ParameterLayout) -> np.ndarray:
    """(11 n, 11 n) Hessian of -Σ log det S - Σ log J."""
    hessian = np.zeros((layout.size, layout.size))
    for k, block in enumerate(layout.blocks(standard)):
        turned = np.linalg.inv(pseudo_inertia(block)) @ LOG_DET_BASIS
        hessian[layout.link(k), layout.link(k)] = np.einsum("aij,bji->ab", turned, turned)
    place = np.arange(layout.rotors.start, layout.rotors.stop)
    hessian[place, place] = standard[layout.rotors] ** -2
    return hessian


def is_inside(standard: np.ndarray, layout: ParameterLayout) -> bool:
    """Whether (11 n,) are bodies that could exist, and rotors above zero."""
    if np.any(standard[layout.rotors] <= 0) or np.any(layout.blocks(standard)[:, 0] <= 0):
        return False
    try:
        for block in layout.blocks(standard):
            np.linalg.cholesky(pseudo_inertia(block))
    except np.linalg.LinAlgError:
        return False
    return True


def reference_parameters(model: RigidFrictionModel) -> np.ndarray:
    """(11 n,) of the URDF and the description, made physical where they are not."""
    robot, dynamics = model.robot, model.rigid.dynamics
    n = robot.dof
    links = ParameterLayout.of(robot).blocks(dynamics.standard_parameters())
    q = np.random.default_rng(0).uniform(-3, 3, (50, n))
    reach = max(float(np.linalg.norm(dynamics.tip_pose(q)[:, :3, 3], axis=1).max()), 0.1)
    total = max(float(links[:, 0].sum()), float(np.abs(model.base_values).max()), 1e-3)
    bodies = [nearby_body(block, _WEIGHTLESS * total, reach) for block in links]
    inertia = np.mean([np.diag(dynamics.mass_matrix(row)) for row in q], axis=0)
    inertia = np.maximum(inertia, bodies[-1][[4, 6, 9]].max()) / robot.gear_ratios**2
    rotors = [j.rotor_inertia or _USUAL_ROTOR * i for j, i in zip(robot.joints, inertia, strict=True)]
    return np.concatenate([*bodies, rotors])


def nearby_body(block: np.ndarray, mass: float, reach: float) -> np.ndarray:
    """(10,) standard parameters of the URDF where it is a body, else near them; of `mass` [kg] where it has none."""
    weightless = block[0] <= 0
    matrix = pseudo_inertia(np.append(mass, np.zeros(9)) if weightless else block)
    centre = matrix[:3, 3] / matrix[3, 3]
    values, axes = np.linalg.eigh(matrix[:3, :3] - matrix[3, 3] * np.outer(centre, centre))
    thin = matrix[3, 3] * ((_WEIGHTLESS_RADIUS if weightless else _LEAST_RADIUS) * reach) ** 2
    if values[0] >= thin:
        return block
    second = (axes * np.maximum(values, thin)) @ axes.T + matrix[3, 3] * np.outer(centre, centre)
    inertia = np.trace(second) * np.eye(3) - second
    return np.array([matrix[3, 3], *matrix[:3, 3], *(inertia[i, j] for i, j in _INERTIA_ORDER)])


_INERTIA_ORDER = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
