"""A rigid arm fitted to samples by weighted least squares, and how well it predicts what was held out.

Mistakes are judged by likelihood: with e_j the squared error of joint j on a part of the logs held out, a mistake gains
Σ_j log(e_j as it is / e_j with it undone), twice the log-likelihood ratio for each independent sample when the noise of
every joint is estimated too. No unit and no joint with much torque decides it alone. Its mean over the parts, and its
scatter between them, say whether that is chance.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from agent.core import InputError
from agent.estimation import FilterSettings, inverse, motions, resolve_cutoff, solve_scaled
from agent.recording import Log
from agent.robot import Dynamics, rotor_regressor

_CUTOFF = 10.0  # Hz
_SAMPLES = 600  # of all logs together
FOLDS = 8  #: parts of every log that are held out in turn
_ROUNDS = 3  # of weights from residuals
_PRIOR_WEIGHT = 10.0  # independent samples that the sizes of parameters count for
_DOUBT = 2.5  # standard deviation of a parameter, relative to the largest that the torques could hold
_LINK_RADIUS = 0.5  # of the reach: the size of such a link
SAMPLES_PER_PARAMETER = 4.0  #: independent samples: a shorter log does not distinguish a mistake from chance
_LEAST = 1e-10  # squared error of a joint, relative to its torque, below which round-off begins


@dataclass(frozen=True, eq=False)
class FitSamples:
    """S low-passed samples: q, qd, qdd, torque and the direction of motion, all (S, n), and the `fold` (S,) that each
    is held out with; `independent` is the number of independent samples. `braked` (S, n): where a brake holds a
    joint, so that its torque is not measured; nowhere without."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray
    direction: np.ndarray
    fold: np.ndarray
    independent: float
    braked: np.ndarray | None = None

    @property
    def rows_each(self) -> float:
        """Samples for each independent one."""
        return max(1.0, len(self.q) / max(self.independent, 1.0))

    @property
    def moving(self) -> np.ndarray:
        """(S,) where any joint moves: in a pause friction is anything within stiction."""
        moving: np.ndarray = np.any(np.abs(self.direction) > np.tanh(1.0), axis=1)
        return moving

    def in_motion(self) -> FitSamples:
        """Those without the pauses."""
        moving = self.moving
        names = ("q", "qd", "qdd", "torque", "direction", "fold")
        parts = {name: getattr(self, name)[moving] for name in names}
        braked = None if self.braked is None else self.braked[moving]
        return replace(self, **parts, independent=self.independent * float(moving.mean()), braked=braked)


def fit_samples(logs: Sequence[Log]) -> FitSamples | None:
    """Samples of all logs that are long enough to be filtered; None where that leaves too few."""
    parts, folds, braked, independent = [], [], [], 0.0
    for log in logs:
        cutoff = min(_CUTOFF, resolve_cutoff(log, FilterSettings()))
        try:
            filtered = list(motions(log, FilterSettings(cutoff)))
        except InputError:
            continue
        for motion in filtered:
            assert motion.torque is not None
            still = 0.01 * np.maximum(np.abs(motion.qd).max(axis=0), 1e-9)
            torque = np.where(motion.braked, 0.0, motion.torque)
            signals = (motion.q, motion.qd, motion.qdd, torque, np.tanh(motion.qd / still))
            parts.append(motion.low_pass(np.hstack(signals)))
            braked.append(np.broadcast_to(motion.braked, (len(parts[-1]), len(motion.braked))))
            folds.append(_held_together(motion.time[motion.kept], motion.cycle_starts))
            independent += 2 * cutoff * float(np.ptp(motion.time[motion.kept]))
    rows = np.concatenate(parts) if parts else np.empty((0, 5))
    every = max(1, -(-len(rows) // _SAMPLES))
    rows, fold = rows[::every], np.concatenate([*folds, np.empty(0, dtype=int)])[::every]
    if len(rows) * rows.shape[1] // 5 < 100:
        return None
    q, qd, qdd, torque, direction = np.split(rows, 5, axis=1)
    return FitSamples(q, qd, qdd, torque, direction, fold, independent, np.concatenate(braked)[::every])


def _held_together(time: np.ndarray, cycle_starts: Sequence[float]) -> np.ndarray:
    """(S,) fold of each sample: a part of the motion, in all of its cycles, as one would tell of the next."""
    if len(cycle_starts) > 1:
        starts = np.asarray(cycle_starts)
        time = time - starts[np.maximum(np.searchsorted(starts, time, side="right") - 1, 0)]
    first, last = (time.min(), time.max()) if len(time) else (0.0, 1.0)
    return np.minimum((time - first) / max(last - first, 1e-9) * FOLDS, FOLDS - 1).astype(int)


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit to a torque (S, n): parameters (p,), their covariance (p, p), and the part of the torque that is left, of
    each joint (n,) and of all together."""

    parameters: np.ndarray
    covariance: np.ndarray
    left: np.ndarray
    unexplained: float


class RigidFit:
    """Fits of links, rotors, Coulomb and viscous friction of the axles and offsets of the joints, 14 n parameters, to
    torques of one motion; every joint is weighted by what it leaves. All it needs of torque y and regressor X are the
    second moments of [X y], joint by joint.

    `precision` (14 n,) is that of the prior, by default that of these samples.
    """

    def __init__(self, dynamics: Dynamics, s: FitSamples, precision: np.ndarray | None = None):
        self.dynamics, self.robot, self.samples = dynamics, dynamics.robot, s
        coupling, offset = self.robot.coupling, np.eye(self.robot.dof)
        friction = [coupling.T[None] * column[:, None, :] for column in (s.direction, s.qd @ coupling.T)]
        bodies = self.regressor(s.q, s.qd, s.qdd)
        columns = np.concatenate([bodies, *friction, np.broadcast_to(offset, (len(s.q), *offset.shape))], axis=2)
        self.columns = columns if s.braked is None else columns * ~s.braked[:, :, None]
        self.precision = self._sizes() ** -2 * _PRIOR_WEIGHT * s.rows_each if precision is None else precision

    def sprung(self, joint: int) -> RigidFit:
        """The same with a spring at a joint (from 0), as a hose is."""
        position, sprung, offset = self.samples.q[:, joint], copy.copy(self), joint - self.robot.dof
        bend = (position - position.mean()) / max(float(np.ptp(position)), 1e-9)
        sprung.columns = np.concatenate([self.columns, self.columns[:, :, [offset]] * bend[:, None, None]], axis=2)
        sprung.precision = np.append(self.precision, self.precision[offset])
        vars(sprung).pop("_products", None)
        return sprung

    def regressor(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, 11 n) of links and rotors."""
        return np.concatenate([self.dynamics.regressor(q, qd, qdd), rotor_regressor(self.robot, qdd)], axis=2)

    def _sizes(self) -> np.ndarray:
        """(14 n,) of the parameters, of which the prior knows only what these torques could lift, speed up or rub."""
        robot, s, reach = self.robot, self.samples, self.dynamics.reach
        torque = np.maximum(np.abs(s.torque).max(axis=0), 1e-9)
        mass, radius = torque.max() / max(float(np.linalg.norm(robot.gravity)), 1.0) / reach, _LINK_RADIUS * reach
        link = _DOUBT * mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])
        acceleration = np.maximum(np.abs(s.qdd).max(axis=0), 0.01 * robot.max_acceleration)
        speed = np.maximum(np.abs(s.qd).max(axis=0), 1e-6 * robot.max_velocity)
        rotors = torque / acceleration / robot.gear_ratios**2
        return np.concatenate([np.tile(link, robot.dof), rotors, torque, torque / speed, torque])

    def says_something(self) -> bool:
        """Whether there are enough samples to compare fits."""
        s = self.samples
        rows = self.columns.reshape(s.q.size, -1)
        length = np.linalg.norm(rows, axis=0)
        known = np.linalg.matrix_rank(rows / np.where(length > 0, length, 1.0), rtol=1e-7)
        return bool(s.q.shape[1] * min(len(s.q), s.independent) > SAMPLES_PER_PARAMETER * known)

    def solution(self, torque: np.ndarray) -> Solution:
        """The fit to all samples of a torque (S, n)."""
        moments = self._moments(torque).sum(axis=0)
        parameters, weights = _fitted(moments, self)
        lost, square = np.maximum(_squared_error(moments, parameters), 0.0), moments[:, -1, -1]
        matrix = np.tensordot(weights, moments[:, :-1, :-1], 1) + np.diag(self.precision)
        unexplained = float(np.sqrt(lost.sum() / max(float(square.sum()), 1e-300)))
        each = np.sqrt(np.where(square > 0, lost / np.maximum(square, 1e-300), 0.0))
        return Solution(parameters, self.samples.rows_each * inverse(matrix), each, unexplained)

    def errors(self, torque: np.ndarray) -> np.ndarray:
        """(FOLDS, n) squared error held out of a torque (S, n), at most that of a constant one."""
        moments = self._moments(torque)
        whole, held_out = moments.sum(axis=0), np.empty(moments.shape[:2])
        weights = _fitted(whole, self)[1]
        squared_deviation = (torque - torque.mean(axis=0)) ** 2
        products = moments.reshape(*moments.shape[:2], -1)
        of_folds = (weights @ products).reshape(-1, *moments.shape[2:])
        for fold, parameters in enumerate(_solved(of_folds.sum(axis=0) - of_folds, self.precision)):
            error = _squared_error(moments[fold], parameters)
            held_out[fold] = np.minimum(error, squared_deviation[self.samples.fold == fold].sum(axis=0))
        # a joint without torque says nothing, whatever is fitted
        return np.where(whole[:, -1, -1] > 0, np.maximum(held_out, _LEAST * whole[:, -1, -1] + 1e-300), 1.0)

    def _moments(self, torque: np.ndarray) -> np.ndarray:
        """(FOLDS, n, p + 1, p + 1) of a torque (S, n), the last row and column."""
        products = self._products
        width = products.shape[-1]
        moments = np.empty((*products.shape[:2], width + 1, width + 1))
        moments[:, :, :width, :width] = products
        for of_fold, fold in zip(moments, range(FOLDS), strict=True):
            columns, own = self._part(self.columns, fold), self._part(torque, fold)[:, :, None]
            of_fold[:, :width, -1:] = columns.swapaxes(1, 2) @ own
            of_fold[:, -1, :width] = of_fold[:, :width, -1]
            of_fold[:, -1:, -1:] = own.swapaxes(1, 2) @ own
        return moments

    @cached_property
    def _products(self) -> np.ndarray:
        """(FOLDS, n, p, p) of the columns with themselves: torques differ, and they do not."""
        parts = (self._part(self.columns, fold) for fold in range(FOLDS))
        return np.array([part.swapaxes(1, 2) @ part for part in parts])

    def _part(self, values: np.ndarray, fold: int) -> np.ndarray:
        """(n, S', …) those of (S, n, …) that are held out together."""
        return values[self.samples.fold == fold].swapaxes(0, 1)


def _fitted(moments: np.ndarray, fit: RigidFit, rounds: int = _ROUNDS) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (p,) and the joints' weights (n,) from moments (n, p + 1, p + 1) of all samples of a fit."""
    square = moments[:, -1, -1]
    rows, least = np.where(square > 0, len(fit.samples.q), 0), _LEAST * square + 1e-300  # parked: no torque, no weight
    weights = rows / np.maximum(square, least)
    for _ in range(rounds):
        parameters = _solved(np.tensordot(weights, moments, 1), fit.precision)
        weights = rows / np.maximum(_squared_error(moments, parameters), least)
    return parameters, weights


def _solved(moments: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """(…, p) from the weighted sum of moments (…, p + 1, p + 1), the prior added."""
    matrix = moments[..., :-1, :-1].copy()
    np.einsum("...ii->...i", matrix)[...] += precision
    return solve_scaled(matrix, moments[..., :-1, -1])


def _squared_error(moments: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """(n,) that parameters (p,) leave, from moments (n, p + 1, p + 1)."""
    extended = np.append(parameters, -1.0)
    return np.asarray(moments @ extended @ extended)


def fitted_gravity(plain: RigidFit) -> np.ndarray:
    """(3,) gravity [m/s²] in the base frame of the described size, in the direction with which the samples fit best.

    Columns are linear in gravity, so that moments with each component of it serve all directions.
    """
    from scipy.optimize import minimize

    robot, s = plain.robot, plain.samples
    size = robot.weight_per_mass
    without, *along = (
        RigidFit(Dynamics(replace(robot, gravity=tuple(gravity))), s, plain.precision).columns
        for gravity in size * np.vstack([np.zeros(3), np.eye(3)])
    )
    rows = [np.dstack([without, s.torque]), *(np.dstack([columns - without, 0 * s.torque]) for columns in along)]
    moments = np.einsum("isna,jsnb->ijnab", rows, rows, optimize=True)
    first, second = np.triu_indices(len(rows))
    pairs = np.ascontiguousarray((moments + moments.swapaxes(0, 1))[first, second])
    once = np.where(first == second, 0.5, 1.0)

    def misfit(gravity: np.ndarray, rounds: int = _ROUNDS) -> float:
        """Twice the negative log-likelihood, but for a constant."""
        parts = np.append(1.0, gravity / np.linalg.norm(gravity))
        weights = _fitted(np.tensordot(once * parts[first] * parts[second], pairs, 1), plain, rounds)[1]
        return -len(s.q) * float(np.log(weights[weights > 0]).sum())

    axis = min([*np.eye(3), *-np.eye(3)], key=lambda direction: misfit(direction, 1))
    options = {"initial_simplex": axis + 0.3 * np.vstack([np.zeros(3), np.eye(3)]), "xatol": 1e-3, "fatol": 1e-3}
    best = minimize(misfit, axis, method="Nelder-Mead", options=options).x
    return np.asarray(size * best / np.linalg.norm(best))
