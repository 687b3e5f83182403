"""The nearest bodies that could exist, of a fit that no bodies have, and how far their torques are from its own.

With β the base parameters of the fit and Σ their covariance, the standard parameters π minimise

    μ/2 (P π - β)ᵀ Σ⁻¹ (P π - β) + tr(S₀⁻¹ S(π)) - log det S(π),

summed over links, rotors alike, with μ growing until the second part hardly counts: a barrier method (Boyd and
Vandenberghe, Convex Optimization, 11.3) that stays inside the bodies that could exist and near the URDF otherwise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.core import RejectedError
from agent.model.identified import IdentifiedModel
from agent.model.standard_parameters import (
    full_parameters,
    is_inside,
    log_det_gradient,
    log_det_hessian,
    reference_parameters,
)
from agent.robot import ParameterLayout

_WEIGHTS = 10.0 ** np.arange(-10, 4)  # μ
_STEPS, _SETTLED, _SHORTEST = 40, 1e-6, 1e-6
_STATES = 400


def possible_model(model: IdentifiedModel) -> tuple[IdentifiedModel, str]:
    """The model itself where bodies have its base parameters, else that of the nearest ones; and how far that is."""
    try:
        full_parameters(model)
    except RejectedError:
        standard = _nearest(model)
        base = model.projection @ standard
        values = np.concatenate([base, model.values[len(base) :]])
        return replace(model, values=values, standard=standard), _how_far(model, base)
    return model, ""


def _nearest(model: IdentifiedModel) -> np.ndarray:
    """(11 n,)."""
    layout, count = ParameterLayout.of(model.robot), len(model.base_values)
    deviation = np.sqrt(np.maximum(np.diag(model.covariance)[:count], 1e-300))
    values, vectors = np.linalg.eigh(model.covariance[:count, :count] / np.outer(deviation, deviation))
    root = (vectors / np.sqrt(np.maximum(values, 1e-9))).T / deviation  # Σ⁻¹ = rootᵀ root
    columns, target = root @ model.projection, root @ model.base_values
    found = reference_parameters(model)
    slope = log_det_gradient(found, layout)
    for weight in _WEIGHTS:
        for _ in range(_STEPS):
            gradient = weight * columns.T @ (columns @ found - target) + slope - log_det_gradient(found, layout)
            hessian = weight * columns.T @ columns + log_det_hessian(found, layout)
            scale = 1 / np.sqrt(np.diag(hessian))
            step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
            decrement = float(np.sqrt(max(-gradient @ step, 0.0)))
            share = 1.0 / (1.0 + decrement) if decrement > 0.25 else 1.0  # damped: the barrier is self-concordant
            while share > _SHORTEST and not is_inside(found + share * step, layout):
                share /= 2
            found = found + (share if share > _SHORTEST else 0.0) * step
            if decrement < _SETTLED or share <= _SHORTEST:
                break
    return found


def _how_far(model: IdentifiedModel, base: np.ndarray) -> str:
    """In torque, on states drawn over the joints' speeds and accelerations."""
    robot, rng = model.robot, np.random.default_rng(0)
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    q = rng.uniform(lower, upper, (_STATES, robot.dof))
    qd = rng.uniform(-0.5, 0.5, q.shape) * robot.max_velocity
    qdd = rng.uniform(-0.5, 0.5, q.shape) * robot.max_acceleration
    whole, left = (
        np.sqrt(np.mean(model.rigid.torque(q, qd, qdd, values) ** 2, axis=0))
        for values in (model.base_values, model.base_values - base)
    )
    shares = left / np.maximum(whole, 1e-9 * whole.max())
    worst = int(np.argmax(shares))
    return (
        f"no bodies that could exist have exactly the parameters of this {model.method!r} fit; the nearest that could "
        f"are written. Their torque differs by {100 * shares[worst]:.2g} % RMS on {robot.joint_names[worst]}, less on "
        "the others. For bodies from the fit itself, estimate with --method consistent"
    )
