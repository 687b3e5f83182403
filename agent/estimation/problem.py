"""Input and output of an estimator, and its cross-validation."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from agent.estimation.normal_equations import (
    Moments,
    autocorrelation_time,
    collect_moments,
    log_evidence,
    observed_standstill_speed,
    reweight,
    solve_sum,
)
from agent.estimation.partition import Partition
from agent.estimation.prior import DESCRIPTION, Prior, physical_prior
from agent.estimation.signals.observation import Observation
from agent.model import FrictionTerm

_ROUNDS = 4  # of weights from residuals
_MOST = 0.5  # half, of samples: most of them
#: Weighted sum of moments (p + 1, p + 1) to parameters (p,).
Solver = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Problem:
    """Data and columns. The prior's precision counts `prior_weight` times, as rows are not independent.

    `load` (b,) are base parameters of an earlier fit, for the terms that depend on the transmitted torque.
    """

    observation: Observation
    partition: Partition
    terms: tuple[FrictionTerm, ...]
    load: np.ndarray
    moments: Moments
    prior: Prior
    prior_weight: float
    links: str = DESCRIPTION
    _friction: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def pose(
        cls,
        observation: Observation,
        partition: Partition,
        terms: tuple[FrictionTerm, ...],
        load: np.ndarray | None = None,
        prior_weight: float = 1.0,
        keep: bool = False,
        links: str = DESCRIPTION,
    ) -> Problem:
        """Of fitting these terms; without `load`, it is that of the URDF's links. `keep` the columns of friction."""
        prior = physical_prior(observation, terms, links)
        load = prior.mean[: observation.rigid.count] if load is None else load
        friction = (observation.friction(segment, terms, load) for segment in observation.segments)
        stored = _kept(observation, friction) if keep else []
        moments = collect_moments(observation, partition, terms, stored or friction)
        return cls(observation, partition, terms, load, moments, prior, prior_weight, links, stored)

    def select(self, chosen: np.ndarray) -> Problem:
        """The same with some of the terms, by index."""
        base = self.observation.rigid.count
        columns = np.concatenate([np.arange(base), base + chosen])
        return replace(
            self,
            terms=tuple(self.terms[k] for k in chosen),
            moments=self.moments.select(columns),
            prior=self.prior.select(columns),
            _friction=_kept(self.observation, (columns.T[chosen].T for columns in self._friction)),
        )

    def with_links(self, links: str) -> Problem:
        """The same under another prior of the links."""
        return replace(self, links=links, prior=physical_prior(self.observation, self.terms, links))

    def friction(self) -> list[np.ndarray]:
        """Per segment (S', T): the terms' filtered columns, worked out once."""
        if not self._friction:
            friction = (
                self.observation.friction(segment, self.terms, self.load) for segment in self.observation.segments
            )
            self._friction.extend(_kept(self.observation, friction))
        return self._friction

    def with_own_prior_weight(self) -> Problem:
        """The same with the prior_weight that the autocorrelation of its own residuals asks for, the joints' median."""
        times = self.autocorrelation_times(self.solve(self.weights()))
        return replace(self, prior_weight=float(np.median(times)))

    def autocorrelation_times(self, parameters: np.ndarray) -> np.ndarray:
        """(n,) samples per independent one, of the residuals of parameters (p,)."""
        return autocorrelation_time(self.free_residuals(parameters))

    def weights(self) -> np.ndarray:
        """(2, n) weights from the residuals that the weights before leave, starting from equal ones of sliding joints.

        A start with standstill in it may stay at weights of which neither sliding nor stationary joints fit well.
        """
        variance = self.moments.torque_energy().sum() / self.moments.rows.sum()
        weights = np.zeros((2, len(self.moments.index)))
        weights[0] = 1 / max(variance, 1e-30)
        for _ in range(_ROUNDS):
            weights = reweight(self.moments, self.solve(weights))
        return weights

    def solver(self, total: np.ndarray) -> np.ndarray:
        """(p,) least squares with the prior, from a weighted sum of moments (p + 1, p + 1)."""
        return solve_sum(total, self.prior, self.prior_weight)

    def solve(self, weights: np.ndarray) -> np.ndarray:
        """(p,) the same with weights (2, n)."""
        return self.solver(self.moments.weighted(weights))

    def log_evidence(self, weights: np.ndarray) -> float:
        """How probable the prior makes the torques; to be compared with another prior's of the same weight."""
        return log_evidence(self.moments.weighted(weights), self.prior, self.prior_weight)

    def held_out(self, weights: np.ndarray, solver: Solver | None = None, moments: Moments | None = None) -> np.ndarray:
        """(folds, 2, n) squared error of every fold's rows under a fit to the `moments` of the others."""
        cells, moments, solver = self.partition, moments or self.moments, solver or self.solver
        errors = np.zeros((cells.folds, *weights.shape))
        for fold in range(cells.folds):
            train, test = cells.training(fold), cells.fold == fold
            if train.any() and test.any():
                errors[fold] = self.moments.energy(solver(moments.weighted(weights, train)), test)
        return errors

    def estimate(
        self, weights: np.ndarray, note: str = "", solver: Solver | None = None, moments: Moments | None = None
    ) -> Estimate:
        """What a solver makes of moments and weights (2, n), cross-validated just so."""
        moments, solver = moments or self.moments, solver or self.solver
        parameters = solver(moments.weighted(weights))
        held_out = self.held_out(weights, solver, moments)
        return Estimate(parameters, weights, moments, held_out, solver, self.prior_weight, note)

    def residuals(self, parameters: np.ndarray) -> list[np.ndarray]:
        """Per segment (S', n) [N·m]: filtered measured torque minus what parameters (p,) explain."""
        result = []
        for segment, friction in zip(self.observation.segments, self.friction(), strict=True):
            error = np.empty(segment.torque.shape)
            for joint, (index, rows) in enumerate(self.observation.joint_rows(segment, self.terms, friction)):
                error[:, joint] = rows @ np.append(-parameters[index], 1.0)
            result.append(error)
        return result

    def discount_held(self) -> Problem:
        """The same problem where rows of joints that stand still while others move count as little as they say.

        Stiction takes up changes of their load, up to the Coulomb level f and always with the same sign. With the
        weight that their residuals earn, inertia that couples joints came out half as large, and no scatter showed it.
        At worst the error of a run of N rows is proportional to one of its columns. So the run counts as one
        independent row with an error that is uniform within ±f: its rows are multiplied by √(3 k σ² / (N f²)), with σ
        the deviation of the sliding joint and k rows per independent one. All three are from a fit without held rows.
        """
        if not (runs := standstill_runs(self.observation)):
            return self
        fit = self._with_shares([np.where(rows > 0, 0.0, 1.0) for rows in runs])
        weights = fit.weights()
        parameters = fit.solve(weights)
        level = np.zeros(self.observation.robot.dof)
        for term, value in zip(self.terms, parameters[self.observation.rigid.count :], strict=True):
            level[term.axle] += abs(value) if term.form == "coulomb" else 0.0
        level = np.maximum(level @ np.abs(self.observation.robot.coupling), 1e-9)
        row = float(np.median(fit.autocorrelation_times(parameters))) / weights[0] / (level**2 / 3)
        below = 1 - 1e-9  # a share of 1 means not held
        shares = (np.sqrt(np.minimum(row / np.maximum(rows, 1), below)) for rows in runs)
        return self._with_shares(np.where(rows > 0, share, 1.0) for rows, share in zip(runs, shares, strict=True))

    def _with_shares(self, shares: Iterable[np.ndarray]) -> Problem:
        observation = self.observation
        parts = zip(observation.segments.items, shares, strict=True)
        items = tuple(replace(segment, share=share) for segment, share in parts)
        observation = replace(observation, segments=replace(observation.segments, items=items))
        moments = collect_moments(observation, self.partition, self.terms, self.friction())
        return replace(self, observation=observation, moments=moments)

    def free_residuals(self, parameters: np.ndarray) -> list[np.ndarray]:
        """The same with zero where a joint is held: that error is stiction's, and does not scatter."""
        parts = zip(self.residuals(parameters), self.observation.segments, strict=True)
        return [np.where(segment.held, 0.0, rows) for rows, segment in parts]

    def correlation(self, rows: list[np.ndarray]) -> np.ndarray:
        """(p,) Xᵀ r for r given segment by segment (S', n)."""
        total = np.zeros(self.moments.parameters)
        for segment, friction, targets in zip(self.observation.segments, self.friction(), rows, strict=True):
            for joint, (index, block) in enumerate(self.observation.joint_rows(segment, self.terms, friction)):
                total[index] += block[:, :-1].T @ targets[:, joint]
        return total


def standstill_runs(observation: Observation) -> list[np.ndarray]:
    """Per segment (S', n) int: length of the run in which a joint is held; 0 where it is not. Nothing if none is.

    A held joint stands still in most of a segment while others move, and moves elsewhere.
    """
    slowest = observed_standstill_speed(observation)
    still = [np.abs(segment.speed) <= slowest for segment in observation.segments]
    moves = np.any([~stopped.all(axis=0) for stopped in still], axis=0)
    lengths = []
    for stopped in still:
        others = np.append(0, np.cumsum(~stopped.all(axis=1)))
        runs = np.zeros(stopped.shape, dtype=int)
        for joint in np.flatnonzero(moves & (stopped.mean(axis=0) > _MOST)):
            edges = np.flatnonzero(np.diff(stopped[:, joint], prepend=False, append=False)).tolist()
            for first, stop in zip(edges[::2], edges[1::2], strict=True):
                if others[stop] - others[first] > _MOST * (stop - first):
                    runs[first:stop, joint] = stop - first
        lengths.append(runs * (np.mean(runs > 0, axis=0) > _MOST))
    return lengths if any(map(np.any, lengths)) else []


def _kept(observation: Observation, columns: Iterable[np.ndarray]) -> list[np.ndarray]:
    return [observation.segments.scratch.keep(block) for block in columns]


@dataclass(frozen=True, eq=False)
class Estimate:
    """parameters (p,); `weights` (2, n), `moments` and `solver` that lead to them; `held_out` (folds, 2, n) squared
    error on rows left out; `prior_weight` that went into them; `standard` (10 n + n,) the inertial parameters
    behind the base parameters, where there are.
    """

    parameters: np.ndarray
    weights: np.ndarray
    moments: Moments
    held_out: np.ndarray
    solver: Solver
    prior_weight: float
    note: str
    standard: np.ndarray | None = None
