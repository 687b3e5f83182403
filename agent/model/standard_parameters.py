"""From base parameters to bodies: inertial parameters of every link that could exist and that give the same torques.

Base parameters fix b combinations of the 11 n standard parameters (ten a link, one rotor inertia a joint); the others
are free. Where the fit itself found bodies (`consistent`), those are the answer. Else the set π is taken that minimises

    μ/2 |A π - t|² + Σ_links tr(S₀⁻¹ S(π)) - log det S(π) + Σ_joints J / J₀ - log J,

with S the 4 × 4 pseudo-inertia of a link and S₀ that of the URDF: relative entropy, which does not depend on units or
frames, and whose logarithms keep bodies physical (Lee, Wensing and Park, IEEE T-RO 36, 2020). As μ grows, A π = t is
met as well as bodies can: a barrier method (Boyd and Vandenberghe, Convex Optimization, 11.3).

Parameters of one body (10,) are mass, first moments and inertia about the origin of a frame, as in `LINK_PARAMETERS`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from agent.core import RejectedError
from agent.model.rigid_friction import RigidFrictionModel
from agent.robot import ParameterLayout, RobotDescription

_EXACT = 10.0 ** np.arange(0, 13, 2)  # μ towards P π = β, in units of the curvature at the start
_NEAREST = 10.0 ** np.arange(-10, 4)  # μ where no bodies have P π = β, in units of its uncertainty
_STEPS, _SETTLED, _SHORTEST = 60, 1e-10, 1e-10
_STATES = 400
_THINNEST = 1e-9  # smallest eigenvalue of a pseudo-inertia that counts as positive, in units of the link's own size
_WEIGHTLESS = 0.02  # of the arm's mass, for a link that the URDF gives no mass
_WEIGHTLESS_RADIUS = 0.03  # of the reach: its size
_LEAST_RADIUS = 0.001  # of the reach: the size of any other link, along its thinnest direction
_USUAL_ROTOR = 0.5  # of the mean inertia about the joint, where the description has none
_INERTIA_ORDER = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))

Model = TypeVar("Model", bound=RigidFrictionModel)


def full_parameters(model: RigidFrictionModel) -> np.ndarray:
    """(11 n,) physical standard parameters, links base to tip, then rotor inertias [motor side], with P π = β.

    Raises:
        RejectedError: no physical bodies have these base parameters, or the fit's own are not physical.
    """
    if model.standard is not None:
        check_physical(model.robot, model.standard)
        return model.standard
    layout, start = ParameterLayout.of(model.robot), reference_parameters(model)
    scale = 1 / np.sqrt(np.diag(log_det_hessian(start, layout)))
    length = np.linalg.norm(model.projection * scale, axis=1)
    rows, target = model.projection / length[:, None], model.base_values / length
    standard = nearest_bodies(rows, target, start, layout, _EXACT)
    # the last digits: the shortest correction onto P π = β
    standard = standard + scale * (np.linalg.pinv(rows * scale) @ (target - rows @ standard))
    if not is_inside(standard, layout):
        raise RejectedError(
            f"no links that could exist have the base parameters of this {model.method!r} fit (a negative mass, "
            "inertia or rotor would be needed), so there is nothing to export; estimate with --method consistent"
        )
    return standard


def possible_model(model: Model) -> tuple[Model, str]:
    """The model itself where bodies have its base parameters, else that of the nearest ones; and how far that is."""
    try:
        full_parameters(model)
    except RejectedError:
        layout, b = ParameterLayout.of(model.robot), len(model.base_values)
        deviation = np.sqrt(np.maximum(np.diag(model.covariance)[:b], 1e-300))
        values, vectors = np.linalg.eigh(model.covariance[:b, :b] / np.outer(deviation, deviation))
        root = (vectors / np.sqrt(np.maximum(values, 1e-9))).T / deviation  # Σ⁻¹ = rootᵀ root
        start = reference_parameters(model)
        standard = nearest_bodies(root @ model.projection, root @ model.base_values, start, layout, _NEAREST)
        base = model.projection @ standard
        possible = replace(model, values=np.concatenate([base, model.values[b:]]), standard=standard)
        return possible, _how_far(model, base)
    return model, ""


def nearest_bodies(
    columns: np.ndarray, target: np.ndarray, start: np.ndarray, layout: ParameterLayout, weights: Iterable[float]
) -> np.ndarray:
    """(p,) bodies that could exist, with columns (b, p) times them near target (b,) and near `start` (p,) otherwise.

    `weights` are the ascending μ of the module's formula; each minimum is where Newton's method starts for the next.

    Args:
        columns: (b, p) base parameters per standard parameter.
        target: (b,) base parameters.
        start: (p,) bodies to begin with.
        layout: of the standard parameters.
        weights: ascending μ of the formula.
    """
    slope, bodies = log_det_gradient(start, layout), start

    def value(standard: np.ndarray, weight: float) -> float:
        missed = columns @ standard - target
        return float(0.5 * weight * missed @ missed + slope @ standard - _logs(standard, layout))

    for weight in weights:
        square = weight * columns.T @ columns
        for _ in range(_STEPS):
            gradient = weight * columns.T @ (columns @ bodies - target) + slope - log_det_gradient(bodies, layout)
            hessian = square + log_det_hessian(bodies, layout)
            scale = 1 / np.sqrt(np.diag(hessian))
            step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
            share, now, falls = 1.0, value(bodies, weight), float(gradient @ step)
            while share > _SHORTEST and not (
                is_inside(bodies + share * step, layout)
                and value(bodies + share * step, weight) <= now + 0.1 * share * falls + 1e-12 * abs(now)
            ):
                share /= 2
            if share <= _SHORTEST:
                break
            bodies = bodies + share * step
            if np.linalg.norm(step / scale) < _SETTLED * np.linalg.norm(bodies / scale):
                break
    return bodies


def check_physical(robot: RobotDescription, standard: np.ndarray) -> None:
    """Raise RejectedError unless every link (11 n,) has a mass distribution and no rotor inertia is negative."""
    layout, standard = ParameterLayout.of(robot), np.asarray(standard, dtype=float)
    for block, rotor, name in zip(layout.blocks(standard), standard[layout.rotors], robot.joint_names, strict=True):
        if not is_body(block):
            raise RejectedError(
                f"the link that {name} moves is not a body that could exist (mass {block[0]:.4g} kg): its mass and "
                "inertia need a density below zero somewhere; estimate with --method consistent"
            )
        if rotor < 0:
            raise RejectedError(f"the rotor inertia of {name} is {rotor:.3g} kg·m²; estimate with --method consistent")


def is_body(block: np.ndarray) -> bool:
    """Whether some mass distribution has these parameters (10,)."""
    matrix = pseudo_inertia(block)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return bool(np.all(np.diag(matrix) > 0) and np.linalg.eigvalsh(matrix / np.outer(size, size))[0] > _THINNEST)


def is_inside(standard: np.ndarray, layout: ParameterLayout) -> bool:
    """Whether (p,) are bodies that could exist, and rotors above zero."""
    return bool(np.all(standard[layout.rotors] > 0)) and all(map(is_body, layout.blocks(standard)))


def body_parameters(mass: float, centre: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """(10,) of a body, from mass [kg], centre (3,) [m] and inertia (3, 3) [kg·m²] about the centre, in one frame.

    Args:
        mass: [kg].
        centre: (3,) of mass [m].
        inertia: (3, 3) about the centre [kg·m²].
    """
    about_origin = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.array([mass, *(mass * centre), *(about_origin[i, j] for i, j in _INERTIA_ORDER)])


def seen_from(block: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(10,) in the frame that lies at `pose` (4, 4): the 4 × 4 pseudo-inertia turns as T⁻¹ S T⁻ᵀ."""
    back = np.linalg.inv(pose)
    return from_pseudo_inertia(back @ pseudo_inertia(block) @ back.T)


def pseudo_inertia(block: np.ndarray) -> np.ndarray:
    """(4, 4) [[½ tr(I) 1 - I, m c], [m cᵀ, m]] of ten standard parameters (10,)."""
    return np.tensordot(block, PSEUDO_INERTIA, axes=1)


def _basis() -> np.ndarray:
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


#: (10, 4, 4) pseudo-inertia per unit of m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
PSEUDO_INERTIA = _basis()


def from_pseudo_inertia(matrix: np.ndarray) -> np.ndarray:
    """(10,) the inverse of `pseudo_inertia`."""
    return np.linalg.lstsq(PSEUDO_INERTIA.reshape(10, 16).T, matrix.ravel(), rcond=None)[0]


def _logs(standard: np.ndarray, layout: ParameterLayout) -> float:
    """Σ log det S + Σ log J."""
    logs = [np.linalg.slogdet(pseudo_inertia(block))[1] for block in layout.blocks(standard)]
    return float(sum(logs) + np.log(standard[layout.rotors]).sum())


def log_det_gradient(standard: np.ndarray, layout: ParameterLayout) -> np.ndarray:
    """(11 n,) gradient of Σ log det S + Σ log J."""
    inverse = [np.linalg.inv(pseudo_inertia(block)) for block in layout.blocks(standard)]
    return np.concatenate([*(np.einsum("kij,ji->k", PSEUDO_INERTIA, s) for s in inverse), 1 / standard[layout.rotors]])


def log_det_hessian(standard: np.ndarray, layout: ParameterLayout) -> np.ndarray:
    """(11 n, 11 n) Hessian of -Σ log det S - Σ log J."""
    hessian = np.zeros((layout.size, layout.size))
    for k, block in enumerate(layout.blocks(standard)):
        turned = np.linalg.inv(pseudo_inertia(block)) @ PSEUDO_INERTIA
        hessian[layout.link(k), layout.link(k)] = np.einsum("aij,bji->ab", turned, turned)
    diagonal = np.arange(layout.rotors.start, layout.rotors.stop)
    hessian[diagonal, diagonal] = standard[layout.rotors] ** -2
    return hessian


def reference_parameters(model: RigidFrictionModel) -> np.ndarray:
    """(11 n,) of the URDF and the description, made physical where they are not."""
    robot, dynamics = model.robot, model.rigid.dynamics
    n = robot.dof
    links = ParameterLayout.of(robot).blocks(dynamics.standard_parameters())
    q, reach = np.random.default_rng(0).uniform(-3, 3, (50, n)), dynamics.reach
    total = max(float(links[:, 0].sum()), float(np.abs(model.base_values).max()), 1e-3)
    bodies = [nearby_body(block, _WEIGHTLESS * total, reach) for block in links]
    inertia = np.mean([np.diag(dynamics.mass_matrix(row)) for row in q], axis=0)
    inertia = np.maximum(inertia, bodies[-1][[4, 6, 9]].max()) / robot.gear_ratios**2
    rotors = [j.rotor_inertia or _USUAL_ROTOR * i for j, i in zip(robot.joints, inertia, strict=True)]
    return np.concatenate([*bodies, rotors])


def nearby_body(block: np.ndarray, mass: float, reach: float) -> np.ndarray:
    """(10,) standard parameters of the URDF where it is a body, else near them; of `mass` [kg] where it has none.

    Args:
        block: (10,) as described.
        mass: of a body that has none [kg].
        reach: of the arm [m].
    """
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


def link_scale(blocks: np.ndarray, least_mass: float, least_radius: float) -> np.ndarray:
    """(n, 10) usual size of the parameters of links (n, 10): mass m, m r and m r² with r the radius of gyration [m].

    Neither m [kg] nor r is taken below the least value given.

    Args:
        blocks: (n, 10) links.
        least_mass: [kg].
        least_radius: of gyration [m].
    """
    mass = np.maximum(blocks[:, 0], least_mass)
    gyration = np.sqrt(np.maximum(blocks[:, [4, 6, 9]].sum(axis=1), 0) / 2 / mass)
    radius = np.maximum(gyration, least_radius)
    return np.asarray(mass[:, None] * np.stack([np.ones_like(mass), *[radius] * 3, *[radius**2] * 6], axis=1))


def _how_far(model: RigidFrictionModel, base: np.ndarray) -> str:
    """In torque, on states drawn over the joints' speeds and accelerations."""
    robot, rng = model.robot, np.random.default_rng(0)
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    q = rng.uniform(lower, upper, (_STATES, robot.dof))
    qd = rng.uniform(-0.5, 0.5, q.shape) * robot.max_velocity
    qdd = rng.uniform(-0.5, 0.5, q.shape) * robot.max_acceleration
    whole, difference = (
        np.sqrt(np.mean(model.rigid.torque(q, qd, qdd, values) ** 2, axis=0))
        for values in (model.base_values, model.base_values - base)
    )
    shares = difference / np.maximum(whole, 1e-9 * whole.max())
    worst = int(np.argmax(shares))
    return (
        f"no bodies that could exist have exactly the parameters of this {model.method!r} fit; the nearest that could "
        f"are written. Their torque differs by {100 * shares[worst]:.2g} % RMS on {robot.joint_names[worst]}, less on "
        "the others. For bodies from the fit itself, estimate with --method consistent"
    )
