"""A rigid arm fitted to samples by plain least squares, and how well it predicts what was held out.

Mistakes are judged by likelihood: with e_j the squared error of joint j on a part of the logs held out, a mistake gains
Σ_j log(e_j as it is / e_j with it undone), twice the log-likelihood ratio for each independent sample when the noise of
every joint is estimated too. No unit and no joint with much torque decides it alone. Its mean over the parts, and its
scatter between them, say whether that is chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from agent.core import InputError
from agent.estimation import FilterSettings, motions, resolve_cutoff
from agent.recording import Log
from agent.robot import RobotDescription

_CUTOFF = 10.0  # Hz
_SAMPLES = 600  # of all logs together
FOLDS = 8  #: parts of every log that are held out in turn
_ROUNDS = 3  # of weights from residuals
_PRIOR_WEIGHT = 10.0  # independent samples that the sizes of parameters count for
_DOUBT = 2.5  # standard deviation of a parameter, relative to the largest that the torques could hold
_LINK_RADIUS = 0.5  # of the reach: the size of such a link
_OVERFITTED = 2.5  # times the error of a fit; of two real arms, as they are or mistaken, at most 1.5
_LEAST = 1e-10  # squared error of a joint, relative to its torque, below which round-off begins


@dataclass(frozen=True, eq=False)
class FitSamples:
    """S low-passed samples: q, qd, qdd, torque and the direction of motion, all (S, n), and the `fold` (S,) that each
    is held out with; so many are `independent`."""

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


def torque_noise(log: Log, cutoff: float) -> np.ndarray:
    """(n,) standard deviation of white noise on the torque, from sample to sample, as a filter at `cutoff` [Hz] leaves
    it."""
    assert log.effort is not None
    fourth = np.median(np.abs(np.diff(log.effort, 4, axis=0)), axis=0) / (0.6745 * np.sqrt(70))
    return np.asarray(fourth * np.sqrt(min(1.0, 2 * cutoff / log.sample_rate)))


class Bodies:
    """Rigid links and rotors of a robot, with Coulomb and viscous friction of its axles and offsets of its joints."""

    def __init__(self, robot: RobotDescription):
        from agent.robot import Dynamics

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
        from agent.robot import rotor_regressor

        return np.concatenate([self.dynamics.regressor(q, qd, qdd), rotor_regressor(self.robot, qdd)], axis=2)

    def reach(self) -> float:
        """[m] of the tip, as far as random postures show it."""
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
        return (
            _PRIOR_WEIGHT * rows_each / np.concatenate([np.tile(link, n), rotors, torque, torque / speed, torque]) ** 2
        )


class HeldOutFit:
    """Second moments of a motion's columns with themselves and with every joint's torque, per fold and joint.

    Torques that are swapped or flipped are fits to the same moments.
    """

    def __init__(self, bodies: Bodies, s: FitSamples, precision: np.ndarray):
        columns = bodies.columns(s)
        self.bodies, self._samples = bodies, s
        folds = [np.flatnonzero(s.fold == fold) for fold in range(FOLDS)]
        self._precision = precision
        self._rows = np.array([len(rows) for rows in folds])
        self._torque = np.array([np.sum(s.torque[rows] ** 2, axis=0) for rows in folds])
        centred = s.torque - s.torque.mean(axis=0)
        self._alone = np.array([np.sum(centred[rows] ** 2, axis=0) for rows in folds])
        parts = [[columns[rows, joint] for joint in range(s.q.shape[1])] for rows in folds]
        self._own = np.array([[part.T @ part for part in joints] for joints in parts])
        self._own_all = self._own.sum(axis=0)
        self._with = np.array(
            [[s.torque[rows].T @ part for part in joints] for rows, joints in zip(folds, parts, strict=True)]
        )

    def undone(self, order: np.ndarray, sign: np.ndarray) -> FitSamples:
        """The samples with the torque of channel order[j], times sign[j], on every joint j."""
        return replace(self._samples, torque=self._samples.torque[:, order] * sign)

    def errors(self, order: np.ndarray, sign: np.ndarray) -> np.ndarray:
        """(FOLDS, n) squared error held out of every torque channel, at most that of a constant torque.

        Joint j has the torque of channel order[j], times sign[j].
        """
        joints = np.arange(len(order))
        own, cross = self._own, self._with[:, joints, order] * sign[:, None]
        torque = self._torque[:, order]
        own_all, cross_all, torque_all = self._own_all, cross.sum(axis=0), torque.sum(axis=0)
        least = _LEAST * torque_all + 1e-300
        left = torque_all
        for _ in range(_ROUNDS):
            weights = self._rows.sum() / np.maximum(left, least)
            solution = self._solve(_weighted(weights, own_all), weights @ cross_all)
            left = _squared(solution, own_all, cross_all, torque_all)
        weights = self._rows.sum() / np.maximum(left, least)
        without = _weighted(weights, own_all) - _weighted(weights, own), weights @ (cross_all - cross)
        errors = np.empty(torque.shape)
        for fold, solution in enumerate(self._solve(*without)):
            errors[fold, order] = np.maximum(_squared(solution, own[fold], cross[fold], torque[fold]), least)
        return np.minimum(errors, np.maximum(self._alone, least[np.argsort(order)]))

    def _solve(self, matrix: np.ndarray, side: np.ndarray) -> np.ndarray:
        """(…, p) solutions of normal equations (…, p, p) with sides (…, p), the prior added."""
        matrix = matrix + np.diag(self._precision)
        scale = 1 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
        scaled = matrix * (scale[..., :, None] * scale[..., None, :])
        return np.asarray(scale * np.linalg.solve(scaled, (scale * side)[..., None])[..., 0])


def _weighted(weights: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(…, p, p) sum over joints of moments (…, n, p, p), weighted (n,)."""
    size = own.shape[-1]
    return (weights @ own.reshape(*own.shape[:-2], size * size)).reshape(*own.shape[:-3], size, size)


def _squared(solution: np.ndarray, own: np.ndarray, cross: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """(n,) squared error of a solution (p,) from moments (n, p, p), (n, p), (n,)."""
    return torque - 2 * cross @ solution + (own @ solution) @ solution


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
    columns = bodies.columns(s)
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


def fitted_gravity(bodies: Bodies, s: FitSamples) -> np.ndarray:
    """(3,) gravity [m/s²] in the base frame of the described size, in the direction with which the samples fit best.

    Columns are linear in gravity, so that moments with each component of it serve all directions. These are tried
    about a sphere, then nearer and nearer to the best.
    """
    count, n = s.q.shape
    robot, rest = bodies.robot, np.zeros((count, n))
    size = float(np.linalg.norm(robot.gravity)) or 9.80665
    x = Bodies(replace(robot, gravity=(0.0, 0.0, 0.0))).columns(s)
    parts = [x]
    for axis in size * np.eye(3):
        part = np.zeros_like(x)
        part[:, :, : 11 * n] = Bodies(replace(robot, gravity=tuple(axis.tolist()))).regressor(s.q, rest, rest)
        parts.append(part)
    by_joint = [np.array([part[:, k] for part in parts]) for k in range(n)]  # (4, S, p) each
    own_each = np.array([np.einsum("isa,jsb->ijab", a, a, optimize=True) for a in by_joint])
    cross_each = np.array([a.transpose(0, 2, 1) @ s.torque[:, k] for k, a in enumerate(by_joint)])
    prior, left = np.diag(bodies.precision(s)), np.sum(s.torque**2, axis=0)
    corners = [d / np.linalg.norm(d) for d in np.array(list(product((-1.0, 0.0, 1.0), repeat=3))) if d.any()]
    best = np.zeros(3)
    for _ in range(_ROUNDS):
        weights = count / np.maximum(left, 1e-12 * np.sum(s.torque**2, axis=0) + 1e-300)
        own, cross = (np.tensordot(weights, each, axes=1) for each in (own_each, cross_each))

        def solution(direction: np.ndarray, own: np.ndarray = own, cross: np.ndarray = cross) -> np.ndarray:
            along = np.append(1.0, direction)
            return np.linalg.solve(np.tensordot(np.outer(along, along), own, axes=2) + prior, along @ cross)

        def explained(direction: np.ndarray, cross: np.ndarray = cross) -> float:
            return float(np.append(1.0, direction) @ cross @ solution(direction))

        best = best if best.any() else max(corners, key=explained)
        for reach in 0.4 * 0.5 ** np.arange(8):
            for d in corners:
                near = best + reach * d
                best = max((best, near / np.linalg.norm(near)), key=explained)
        fit = solution(best)
        along = np.append(1.0, best)
        left = np.array([np.sum((s.torque[:, k] - along @ (a @ fit)) ** 2) for k, a in enumerate(by_joint)])
    return np.asarray(size * best)


def overfitted(robot: RobotDescription, s: FitSamples, joints: np.ndarray) -> bool:
    """Whether what is held out is predicted so much worse than it is fitted that few seconds say nothing of mistakes.

    joints (n,): part of each torque that a fit to all samples leaves. The joints' median decides.
    """
    bodies = Bodies(robot)
    held_out = HeldOutFit(bodies, s, bodies.precision(s)).errors(np.arange(robot.dof), np.ones(robot.dof))
    left = np.sqrt(held_out.sum(axis=0) / np.maximum(np.sum(s.torque**2, axis=0), 1e-300))
    return bool(np.median(left / np.maximum(joints, 0.01)) > _OVERFITTED)
