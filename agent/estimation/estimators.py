"""The estimators, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from agent.estimation.normal_equations import (
    Moments,
    clear_gain,
    collect_moments,
    pseudo_inverse,
    scaled_rank,
    solve_scaled,
    standstill,
)
from agent.estimation.prior import link_prior
from agent.estimation.problem import Estimate, Problem
from agent.model import PSEUDO_INERTIA
from agent.robot import ParameterLayout


def weighted(problem: Problem) -> Estimate:
    """Weighted least squares with a prior; the weights follow from a first fit in which every joint counts alike.

    With row groups g of weight w_g, the estimate minimises Σ w_g |y_g - X_g θ|² + k (θ - θ₀)ᵀ Λ (θ - θ₀). The
    paper's weights are the inverse residual variance of each joint (AIM 2013, eq. 4). Here the stationary rows of a
    joint form a group of their own, never weighted above its moving rows, because stiction leaves their torque open.

    Normal equations square the condition number; one refinement step from the residuals of the rows restores the
    accuracy (corrected seminormal equations, Björck, Linear Algebra Appl. 88, 1987).
    """
    fit = problem.estimate(problem.weights())
    prior, joints = problem.prior, np.arange(fit.weights.shape[1])
    rows = [
        residual * fit.weights[still.astype(int), joints]
        for residual, still in zip(problem.residuals(fit.parameters), standstill(problem.observation), strict=True)
    ]
    slope = problem.correlation(rows) + problem.prior_weight * prior.precision @ (prior.mean - fit.parameters)
    matrix = fit.moments.weighted(fit.weights)[:-1, :-1] + problem.prior_weight * prior.precision
    return replace(fit, parameters=fit.parameters + solve_scaled(matrix, slope))


_TUNING = 1.345
_HUBER_ROUNDS = 4


def huber(problem: Problem) -> Estimate:
    """Huber's M-estimate with a scale per joint.

    A residual beyond 1.345 robust standard deviations counts linearly instead of quadratically (Huber, Annals of
    Mathematical Statistics 35, 1964): knocks, dropped samples and contacts pull less. The scale of each joint,
    moving or at standstill, is 1.4826 times the median absolute residual.
    """
    observation = problem.observation
    still, held = standstill(observation), [segment.held for segment in observation.segments]
    moments, weights = problem.moments, problem.weights()
    parameters = problem.solve(weights)
    share = 0.0
    for _ in range(_HUBER_ROUNDS):
        rows = problem.residuals(parameters)
        scale = _scales(rows, still, held)
        trusted = [
            1 / np.maximum(1, np.abs(block) / (_TUNING * scale[stop.astype(int), np.arange(block.shape[1])]))
            for block, stop in zip(rows, still, strict=True)
        ]
        moments = collect_moments(observation, problem.partition, problem.terms, problem.friction(), trusted)
        weights = 1 / scale**2
        parameters = problem.solver(moments.weighted(weights))
        share = float(np.mean(np.concatenate(trusted) < 1))
    note = f"Huber weights below 1 on {100 * share:.0f} % of the rows."
    return problem.estimate(weights, note, moments=moments)


def _scales(rows: list[np.ndarray], still: list[np.ndarray], held: list[np.ndarray]) -> np.ndarray:
    """(2, n) robust standard deviations, moving and at standstill."""
    residual, stopped, free = np.concatenate(rows), np.concatenate(still), ~np.concatenate(held)
    scale = np.empty((2, residual.shape[1]))
    for joint in range(residual.shape[1]):
        moving = residual[~stopped[:, joint] & free[:, joint], joint]
        standing = residual[stopped[:, joint], joint]
        moving, standing = (part if len(part) else residual[:, joint] for part in (moving, standing))
        scale[0, joint] = 1.4826 * np.median(np.abs(moving))
        scale[1, joint] = max(scale[0, joint], 1.4826 * np.median(np.abs(standing)))
    return np.maximum(scale, 1e-9 * np.sqrt(np.mean(residual**2)) + 1e-15)


_PLAIN_ROUNDS = 4


def paper(problem: Problem) -> Estimate:
    """The estimator of AIM 2013, section III: weights from one fit in which every joint counts alike, no prior.

        θ = (W X)⁺ W y,   W = diag(1 / σ_j) over the rows of joint j,

    with σ_j the residual deviation of joint j under ordinary least squares (eq. 4). The columns are base parameters
    and the three friction terms of eq. 2, or, for `plain`, Coulomb and viscous friction and an offset. There is no
    prior: in directions that the motion does not excite, the pseudo-inverse takes the solution of minimum norm
    (columns scaled to unit length, so that units do not matter).
    """
    return _without_prior(
        problem,
        1,
        "The paper's own estimator: Coulomb, viscous and quadratic friction, the weights of its eq. 4, no prior.",
    )


def plain(problem: Problem) -> Estimate:
    """Weighted least squares of minimum norm; the weights are iterated until they match the residuals."""
    return _without_prior(
        problem,
        _PLAIN_ROUNDS,
        "Plain weighted least squares: Coulomb and viscous friction and an offset per axle, no prior.",
    )


def _without_prior(problem: Problem, rounds: int, note: str) -> Estimate:
    moments = problem.moments
    weights = np.ones((2, problem.observation.robot.dof))
    for _ in range(rounds):
        weights = _eq_4(moments, _minimum_norm(moments.weighted(weights)))
    silent = moments.parameters - scaled_rank(moments.weighted(weights)[:-1, :-1])
    if silent:
        note += (
            f" {silent} of {moments.parameters} parameter directions are not in these data: the solution of minimum "
            "norm is taken, and their standard deviations are what such an arm could have."
        )
    return replace(problem, prior_weight=0.0).estimate(weights, note, _minimum_norm)


def _minimum_norm(total: np.ndarray) -> np.ndarray:
    return pseudo_inverse(total[:-1, :-1]) @ total[:-1, -1]


def _eq_4(moments: Moments, parameters: np.ndarray) -> np.ndarray:
    """(2, n) inverse residual variance of each joint, the same in motion and at standstill."""
    variance = moments.energy(parameters).sum(axis=0) / moments.rows.sum(axis=(0, 1))
    floor = 1e-30 + 1e-20 * moments.torque_energy().sum() / moments.rows.sum()
    return np.tile(1 / np.maximum(variance, floor), (2, 1))


#: Upper triangle of a 4 × 4 matrix, column by column: the order of Clarabel's cone.
_TRIANGLE = [(i, j) for j in range(4) for i in range(j + 1)]
_FACTORS = (1.0, 3.0, 10.0, 30.0, 100.0)  # of the prior's weight against noise alone
_SOLIDITY = 1e-4  # smallest eigenvalue of a pseudo-inertia, in units of the link's own scale


def consistent(problem: Problem) -> Estimate:
    """Weighted least squares on the set of physical robots.

    Unknowns are the standard parameters of every link, the rotor inertias and the friction terms. They minimise the
    same weighted squares and the same prior as `weighted`, with the constraints that

    * every link's pseudo-inertia [[½ tr(I) 1 - I, m c], [m cᵀ, m]] is positive definite, as that of any density over
      space (Traversaro et al., IROS 2016; Wensing, Kim and Slotine, IEEE RA-L 3, 2018);
    * rotor inertias, Coulomb and viscous friction are not negative, nor the sum of Coulomb and Stribeck
      friction at standstill.

    In directions without data the prior decides, so links stay near their URDF. Held-out error decides whether the
    prior gets more weight than against noise alone, because model errors make rows worth less. Clarabel solves the
    convex programme: the cost is one small matrix made of the moments, the cones are 4 × 4 matrices.
    """
    problem = _weigh_prior(problem)
    programme = _Programme(problem)
    weights = problem.weights()
    note = "Every link has a physical mass distribution; rotor inertias and friction are not negative."
    fit = problem.estimate(weights, note, programme.parameters)
    return replace(fit, standard=programme.solve(problem.moments.weighted(weights))[: programme.standard])


def _weigh_prior(problem: Problem) -> Problem:
    """The same problem with more weight on the prior, if that clearly lowers held-out error."""
    weights = problem.weights()
    trials = [replace(problem, prior_weight=factor * problem.prior_weight) for factor in _FACTORS]
    errors = [np.sum(weights * trial.held_out(weights), axis=(1, 2)) for trial in trials]
    best = int(np.argmin([error.sum() for error in errors]))
    return trials[best] if clear_gain(errors[0] - errors[best]) else problem


class _Programme:
    """Unknowns x = [links (10 n), rotors (n), friction terms], scaled by their prior deviations."""

    def __init__(self, problem: Problem):
        rigid = problem.observation.rigid
        mean, deviation = link_prior(problem.observation, problem.links)
        self.standard = len(mean)
        count, terms = rigid.count, problem.terms
        self.to_parameters = np.zeros((count + len(terms), self.standard + len(terms)))
        self.to_parameters[:count, : self.standard] = rigid.projection
        self.to_parameters[count:, self.standard :] = np.eye(len(terms))
        friction = 1 / np.sqrt(np.diag(problem.prior.precision)[count:])
        self.mean = np.append(mean, np.zeros(len(terms)))
        self.scale = np.append(deviation, friction)
        self.prior_weight = problem.prior_weight
        self._constraints(problem)

    def _constraints(self, problem: Problem) -> None:
        layout = ParameterLayout.of(problem.observation.robot)
        links = layout.blocks(self.scale)
        blocks, floors = [], []
        for link in range(layout.n_links):
            rows = np.zeros((10, len(self.scale)))
            # Clarabel wants off-diagonal entries times √2
            rows[:, layout.link(link)] = [(1 if i == j else np.sqrt(2)) * PSEUDO_INERTIA[:, i, j] for i, j in _TRIANGLE]
            # in units of the link's own mass and length, so that one tolerance fits all links
            unit = np.sqrt([links[link, 4] / links[link, 0]] * 3 + [1.0])
            weight = np.array([1 / (unit[i] * unit[j] * links[link, 0]) for i, j in _TRIANGLE])
            blocks.append(rows * weight[:, None] * self.scale)
            offset = (rows * weight[:, None]) @ self.mean
            floors.append(_SOLIDITY * np.array([float(i == j) for i, j in _TRIANGLE]) - offset)
        units = np.eye(len(self.scale))
        positive, breakaway = list(units[layout.rotors]), dict[int, np.ndarray]()
        for row, term in zip(units[layout.size :], problem.terms, strict=True):
            if term.form in ("coulomb", "viscous"):
                positive.append(row)
            if term.form in ("coulomb", "stribeck"):
                breakaway[term.axle] = breakaway.get(term.axle, 0) + row
        positive += list(breakaway.values())
        linear = np.array(positive)
        self._cone_rows = np.vstack([linear * self.scale, *blocks])
        self._cone_floor = np.concatenate([-linear @ self.mean, *floors])
        self._linear, self._links = len(linear), layout.n_links

    def parameters(self, total: np.ndarray) -> np.ndarray:
        """(p,) from a weighted sum of moments."""
        return self.to_parameters @ self.solve(total)

    def solve(self, total: np.ndarray) -> np.ndarray:
        """(10 n + n + T,) unknowns from a weighted sum of moments (p + 1, p + 1)."""
        import clarabel
        from scipy.sparse import csc_matrix

        columns = self.to_parameters * self.scale
        offset = self.to_parameters @ self.mean
        cost = columns.T @ total[:-1, :-1] @ columns + self.prior_weight * np.eye(len(self.scale))
        slope = columns.T @ (total[:-1, :-1] @ offset - total[:-1, -1])
        size = np.sqrt(np.max(np.diag(cost)))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        cones = [clarabel.NonnegativeConeT(self._linear), *[clarabel.PSDTriangleConeT(4)] * self._links]
        solution = clarabel.DefaultSolver(
            csc_matrix(np.triu(cost / size)),
            slope / size,
            csc_matrix(-self._cone_rows),
            -self._cone_floor,
            cones,
            settings,
        ).solve()
        return self.mean + self.scale * np.array(solution.x)


@dataclass(frozen=True)
class Estimator:
    """`fit` solves a problem; `friction` are the terms it is defined with, those of the settings if None."""

    fit: Callable[[Problem], Estimate]
    friction: str | None = None


#: Every estimator by name. Recipes may name those of `agent.recipe.schema.ESTIMATION_METHODS`.
ESTIMATORS = {
    "weighted": Estimator(weighted),
    "huber": Estimator(huber),
    "consistent": Estimator(consistent),
    "paper": Estimator(paper, friction="paper"),
    "plain": Estimator(plain, friction="plain"),
}
