"""Whether a torque has the sign of its motion: fits in which friction dissipates and inertia is positive.

A fit without limits explains a flipped torque as well as the right one, by negative masses and friction. Within them it
does not. Friction may be any function of speed that never drives, so a Coulomb level that falls with speed is no doubt.
"""

from __future__ import annotations

import numpy as np

from agent.data_quality.rigid_fit import FOLDS, RigidFit

_NODES = 4  # of each axle's friction over its speed; with 3 and 6 the same logs pass
_POSTURES = 10  # in which the inertia about every joint is positive


def passive_errors(fit: RigidFit, torque: np.ndarray) -> np.ndarray:
    """(FOLDS, n) squared error held out of a torque (S, n), by fits in which nothing drives a joint on."""
    s, n = fit.samples, fit.robot.dof
    speed = s.qd @ fit.robot.coupling.T
    size = np.abs(speed) / np.maximum(np.abs(speed).max(axis=0), 1e-12) * (_NODES - 1)
    hats = np.maximum(0.0, 1 - np.abs(size[:, None] - np.arange(_NODES)[None, :, None]))  # (S, nodes, n)
    friction = [(fit.robot.coupling.T[None] * (s.direction * hat)[:, None]) for hat in np.swapaxes(hats, 0, 1)]
    offsets = np.broadcast_to(np.eye(n), (len(s.q), n, n))
    columns = np.concatenate([fit.columns[:, :, : 11 * n], *friction, offsets], axis=2)
    rows = np.concatenate([columns, torque[:, :, None]], axis=2).swapaxes(0, 1)
    parts = [rows[:, s.fold == fold] for fold in range(FOLDS)]
    moments = np.array([part.swapaxes(1, 2) @ part for part in parts])
    whole, levels = moments.sum(axis=0), np.tile(fit.precision[11 * n : 12 * n], _NODES)
    precision = np.concatenate([fit.precision[: 11 * n], levels, fit.precision[13 * n :]])
    unexplained = fit.solution(torque).left
    weights = len(s.q) / np.maximum(unexplained**2 * whole[:, -1, -1], 1e-10 * whole[:, -1, -1] + 1e-300)
    limits = _limits(fit)
    errors = np.empty(moments.shape[:2])
    for fold, part in enumerate(moments):
        total = np.tensordot(weights, whole - part, 1)
        extended = np.append(_within(total[:-1, :-1] + np.diag(precision), total[:-1, -1], limits), -1.0)
        errors[fold] = part @ extended @ extended
    return np.maximum(errors, 1e-10 * whole[:, -1, -1] + 1e-300)


def _limits(fit: RigidFit) -> np.ndarray:
    """(m, p) products with parameters that are not negative: inertia about each joint, and friction at each node."""
    s, n = fit.samples, fit.robot.dof
    postures = s.q[:: max(1, len(s.q) // _POSTURES)]
    zero = 0 * postures
    still = fit.regressor(postures, zero, zero)
    moved = [(fit.regressor(postures, zero, zero + unit) - still)[:, k] for k, unit in enumerate(np.eye(n))]
    inertia = np.concatenate(moved)
    count = _NODES * n
    lines = [np.hstack([inertia, np.zeros((len(inertia), count + n))])]
    lines.append(np.hstack([np.zeros((count, 11 * n)), np.eye(count), np.zeros((count, n))]))
    return np.concatenate(lines)


def _within(matrix: np.ndarray, side: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Minimum (p,) of ½ xᵀ A x − bᵀ x with G x ≥ 0."""
    import clarabel
    from scipy.sparse import csc_matrix

    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    lines = limits * scale
    length = np.linalg.norm(lines, axis=1)
    lines = lines[length > 0] / length[length > 0, None]
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    size = max(float(np.abs(scale * side).max()), 1e-300)
    solved = clarabel.DefaultSolver(
        csc_matrix(np.triu(matrix * np.outer(scale, scale))),
        -scale * side / size,
        csc_matrix(-lines),
        np.zeros(len(lines)),
        [clarabel.NonnegativeConeT(len(lines))],
        settings,
    ).solve()
    return scale * size * np.array(solved.x)
