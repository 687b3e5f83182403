"""A rigid arm fitted to samples by weighted least squares, and how well it predicts what was held out.

Mistakes are judged by likelihood: with e_j the squared error of joint j on a part of the logs held out, a mistake gains
Σ_j log(e_j as it is / e_j with it undone), twice the log-likelihood ratio for each independent sample when the noise of
every joint is estimated too. No unit and no joint with much torque decides it alone. Its mean over the parts, and its
scatter between them, say whether that is chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.core import InputError
from agent.estimation import FilterSettings, motions, resolve_cutoff
from agent.recording import Log
from agent.robot import Dynamics, RobotDescription, rotor_regressor

_CUTOFF = 10.0  # Hz
_SAMPLES = 600  # of all logs together
FOLDS = 8  #: parts of every log that are held out in turn
_ROUNDS = 3  # of weights from residuals
_PRIOR_WEIGHT = 10.0  # independent samples that the sizes of parameters count for
_DOUBT = 2.5  # standard deviation of a parameter, relative to the largest that the torques could hold
_LINK_RADIUS = 0.5  # of the reach: the size of such a link
_OVERFITTED = 2.5  # times the error of a fit; of two real arms, as they are or mistaken, at most 1.5
_SAMPLES_PER_PARAMETER = 4.0  # independent samples: a shorter log does not distinguish a mistake from chance
_LEAST = 1e-10  # squared error of a joint, relative to its torque, below which round-off begins


@dataclass(frozen=True, eq=False)
class FitSamples:
    """S low-passed samples: q, qd, qdd, torque and the direction of motion, all (S, n), and the `fold` (S,) that each
    is held out with; `independent` is the number of independent samples."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray
    direction: np.ndarray
    fold: np.ndarray
    independent: float


def fit_samples(logs: Sequence[Log]) -> FitSamples | None:
    """Samples of all logs that are long enough to be filtered; None where that leaves too few."""
    parts, folds, independent = [], [], 0.0
    for log in logs:
        cutoff = min(_CUTOFF, resolve_cutoff(log, FilterSettings()))
        try:
            found = list(motions(log, FilterSettings(cutoff)))
        except InputError:
            continue
        for motion in found:
            assert motion.torque is not None
            still = 0.01 * np.maximum(np.abs(motion.qd).max(axis=0), 1e-9)
            signals = (motion.q, motion.qd, motion.qdd, motion.torque, np.tanh(motion.qd / still))
            parts.append(motion.low_pass(np.hstack(signals)))
            folds.append(np.arange(len(parts[-1])) * FOLDS // max(len(parts[-1]), 1))
            independent += 2 * cutoff * float(np.ptp(motion.time[motion.kept]))
    rows = np.concatenate(parts) if parts else np.empty((0, 5))
    every = max(1, -(-len(rows) // _SAMPLES))
    rows, fold = rows[::every], np.concatenate([*folds, np.empty(0, dtype=int)])[::every]
    if len(rows) * rows.shape[1] // 5 < 100:
        return None
    q, qd, qdd, torque, direction = np.split(rows, 5, axis=1)
    return FitSamples(q, qd, qdd, torque, direction, fold, independent)


class Bodies:
    """Rigid links and rotors of a robot, with Coulomb and viscous friction of its axles and offsets of its joints."""

    def __init__(self, robot: RobotDescription):
        self.robot = robot
        self.dynamics = Dynamics(robot)

    def columns(self, s: FitSamples) -> np.ndarray:
        """(S, n, 14 n) along the samples."""
        count, n = s.q.shape
        coupling = self.robot.coupling
        friction = [coupling.T[None] * column[:, None, :] for column in (s.direction, s.qd @ coupling.T)]
        offset = np.broadcast_to(np.eye(n)[None], (count, n, n))
        return np.concatenate([self.regressor(s.q, s.qd, s.qdd), *friction, offset], axis=2)

    def regressor(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, 11 n) of links and rotors."""
        return np.concatenate([self.dynamics.regressor(q, qd, qdd), rotor_regressor(self.robot, qdd)], axis=2)

    def reach(self) -> float:
        """Reach [m] of the tip, estimated from random postures."""
        q = np.random.default_rng(0).uniform(-3, 3, (50, self.robot.dof))
        return max(float(np.linalg.norm(self.dynamics.tip_pose(q)[:, :3, 3], axis=1).max()), 0.1)

    def precision(self, s: FitSamples) -> np.ndarray:
        """(14 n,) of a prior that knows of the parameters only what these torques could lift, speed up or rub."""
        n = self.robot.dof
        torque = np.maximum(np.abs(s.torque).max(axis=0), 1e-9)
        reach = self.reach()
        gravity = max(float(np.linalg.norm(self.robot.gravity)), 1.0)
        mass, radius = torque.max() / gravity / reach, _LINK_RADIUS * reach
        link = _DOUBT * mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])
        acceleration = np.maximum(np.abs(s.qdd).max(axis=0), 0.01 * self.robot.max_acceleration)
        speed = np.maximum(np.abs(s.qd).max(axis=0), 1e-6 * self.robot.max_velocity)
        rotors = torque / acceleration / self.robot.gear_ratios**2
        rows_each = max(1.0, len(s.q) / max(s.independent, 1.0))
        sizes = np.concatenate([np.tile(link, n), rotors, torque, torque / speed, torque])
        return _PRIOR_WEIGHT * rows_each / sizes**2


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit to a torque (S, n): parameters (p,), their covariance (p, p), and the part of the torque that is left, of
    each joint (n,) and of all together."""

    parameters: np.ndarray
    covariance: np.ndarray
    left: np.ndarray
    unexplained: float


class RigidFit:
    """Fits of links, rotors, friction and offsets to torques of one motion, every joint weighted by what it leaves.

    `precision` (p,) is that of the prior.
    """

    def __init__(self, bodies: Bodies, s: FitSamples, precision: np.ndarray | None = None):
        self.bodies, self.samples = bodies, s
        self.columns = bodies.columns(s)
        self.precision = bodies.precision(s) if precision is None else precision
        self._folds = [np.flatnonzero(s.fold == fold) for fold in range(FOLDS)]
        parts = [self.columns[rows].swapaxes(0, 1) for rows in self._folds]
        self._own = np.array([part.swapaxes(1, 2) @ part for part in parts])

    def says_something(self) -> bool:
        """Whether there are enough samples, and held-out ones are predicted well enough, to compare fits."""
        s = self.samples
        rows = self.columns.reshape(s.q.size, -1)
        length = np.linalg.norm(rows, axis=0)
        known = np.linalg.matrix_rank(rows / np.where(length > 0, length, 1.0), rtol=1e-7)
        independent = s.q.shape[1] * min(len(s.q), s.independent)
        return independent > _SAMPLES_PER_PARAMETER * known and not overfitted(self, s.torque)

    def solution(self, torque: np.ndarray) -> Solution:
        """The fit to all samples of a torque (S, n)."""
        cross, square, _ = self._moments(torque)
        own, cross, square = self._own.sum(axis=0), cross.sum(axis=0), square.sum(axis=0)
        parameters, weights = self._weighted(own, cross, square)
        left = np.maximum(_squared(parameters, own, cross, square), 0.0)
        each = max(1.0, len(torque) / max(self.samples.independent, 1.0))  # rows for each independent sample
        matrix = _sum(weights, own) + np.diag(self.precision)
        scale = 1 / np.sqrt(np.diagonal(matrix))
        covariance = each * scale * np.linalg.inv(matrix * np.outer(scale, scale)) * scale[:, None]
        unexplained = float(np.sqrt(left.sum() / max(float(square.sum()), 1e-300)))
        return Solution(parameters, covariance, np.sqrt(left / np.maximum(square, 1e-300)), unexplained)

    def errors(self, torque: np.ndarray) -> np.ndarray:
        """(FOLDS, n) squared error held out of a torque (S, n), at most that of a constant one."""
        cross, square, alone = self._moments(torque)
        own_all, cross_all, square_all = self._own.sum(axis=0), cross.sum(axis=0), square.sum(axis=0)
        _, weights = self._weighted(own_all, cross_all, square_all)
        matrices = _sum(weights, own_all) - _sum(weights, self._own)
        solutions = self._solve(matrices, weights @ (cross_all - cross))
        held_out = [_squared(*of_fold) for of_fold in zip(solutions, self._own, cross, square, strict=True)]
        least = _LEAST * square_all + 1e-300
        return np.minimum(np.maximum(held_out, least), np.maximum(alone, least))

    def _moments(self, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per fold and joint: torque times columns (FOLDS, n, p), squared torque, squared change of torque."""
        cross = np.array([np.einsum("sj,sjp->jp", torque[rows], self.columns[rows]) for rows in self._folds])
        square, alone = (
            np.array([np.sum(values[rows] ** 2, axis=0) for rows in self._folds])
            for values in (torque, torque - torque.mean(axis=0))
        )
        return cross, square, alone

    def _weighted(self, own: np.ndarray, cross: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameters (p,) and weights (n,) from moments (n, p, p), (n, p), (n,)."""
        left, least = square, _LEAST * square + 1e-300
        for _ in range(_ROUNDS):
            weights = len(self.columns) / np.maximum(left, least)
            parameters = self._solve(_sum(weights, own), weights @ cross)
            left = _squared(parameters, own, cross, square)
        return parameters, len(self.columns) / np.maximum(left, least)

    def _solve(self, matrix: np.ndarray, side: np.ndarray) -> np.ndarray:
        """(…, p) solutions of normal equations (…, p, p) with sides (…, p), the prior added."""
        matrix = matrix + np.diag(self.precision)
        scale = 1 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
        scaled = matrix * (scale[..., :, None] * scale[..., None, :])
        return np.asarray(scale * np.linalg.solve(scaled, (scale * side)[..., None])[..., 0])


def overfitted(fit: RigidFit, torque: np.ndarray) -> bool:
    """Whether the joints' median torque (S, n) is predicted far worse than it is fitted.

    A log that short says nothing about mistakes.
    """
    left = np.sqrt(fit.errors(torque).sum(axis=0) / np.maximum(np.sum(torque**2, axis=0), 1e-300))
    return bool(np.median(left / np.maximum(fit.solution(torque).left, 0.01)) > _OVERFITTED)


def _sum(weights: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(…, p, p) sum over joints of moments (…, n, p, p), weighted (n,)."""
    return np.tensordot(own, weights, axes=(-3, 0))


def _squared(solution: np.ndarray, own: np.ndarray, cross: np.ndarray, square: np.ndarray) -> np.ndarray:
    """(n,) squared error of a solution (p,) from moments (n, p, p), (n, p), (n,)."""
    return np.asarray(square - 2 * cross @ solution + (own @ solution) @ solution)


def fitted_gravity(bodies: Bodies, s: FitSamples) -> np.ndarray:
    """(3,) gravity [m/s²] in the base frame of the described size, in the direction with which the samples fit best.

    Columns are linear in gravity, so that moments with each component of it serve all directions.
    """
    from scipy.optimize import minimize

    size = float(np.linalg.norm(bodies.robot.gravity)) or 9.80665
    none, *each = (
        Bodies(replace(bodies.robot, gravity=tuple(gravity))).columns(s)
        for gravity in size * np.vstack([np.zeros(3), np.eye(3)])
    )
    parts = np.array([none, *(columns - none for columns in each)]).transpose(2, 0, 1, 3)  # (n, 4, S, p)
    own = np.array([np.einsum("isa,jsb->ijab", part, part, optimize=True) for part in parts])
    cross = np.einsum("nisa,sn->nia", parts, s.torque)
    square = np.sum(s.torque**2, axis=0)
    prior = np.diag(bodies.precision(s))

    def left(gravity: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(n,) squared error with gravity (3,) in this direction."""
        along = np.append(1.0, gravity / np.linalg.norm(gravity))
        own_all, cross_all = np.tensordot(own, np.outer(along, along), axes=([1, 2], [0, 1])), along @ cross
        solution = np.linalg.solve(_sum(weights, own_all) + prior, weights @ cross_all)
        return _squared(solution, own_all, cross_all, square)

    best, errors = np.zeros(3), square
    for _ in range(_ROUNDS):
        weights = len(s.q) / np.maximum(errors, 1e-12 * square + 1e-300)

        def misfit(gravity: np.ndarray, weights: np.ndarray = weights) -> float:
            return float(weights @ left(gravity, weights))

        axes = np.vstack([np.eye(3), -np.eye(3)])
        best = best / np.linalg.norm(best) if best.any() else min(axes, key=misfit)
        around = best + 0.3 * np.vstack([np.zeros(3), np.eye(3)])
        options = {"initial_simplex": around, "xatol": 1e-3, "fatol": 1e-3}
        best = minimize(misfit, best, method="Nelder-Mead", options=options).x
        errors = left(best, weights)
    return np.asarray(size * best / np.linalg.norm(best))
