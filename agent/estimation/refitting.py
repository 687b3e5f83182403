"""Estimating again from fresh logs what an earlier model says: its friction alone, or everything.

The structure stays that of the earlier model (its base parameters, its friction terms with their reversals), so that
parameters of one loop can be compared over the years. Its friction values are no prior: each estimate stands on its own
data, else a drift would be found late and too small.

Friction alone: base parameters β stay where they are, the friction φ minimises Σ w_g |y_g - B_g β - F_g φ|² + k φᵀ Λ φ.
What β may be off goes on into φ by G = ∂φ/∂β = -(A_φφ + k Λ)⁻¹ A_φβ, so with S the covariance of φ at given β

    cov = [[Σ_β, Σ_β Gᵀ], [G Σ_β, S + G Σ_β Gᵀ]].

Two models that share β differ by what S says, which `conditional_covariance` gets back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.core import InputError
from agent.estimation.estimators import ESTIMATORS
from agent.estimation.model_building import build_model
from agent.estimation.normal_equations import reweight, solve_scaled
from agent.estimation.partition import partition
from agent.estimation.problem import Estimate, Problem
from agent.estimation.signals.filtering import FilterSettings
from agent.estimation.signals.observation import Observation, observe
from agent.estimation.uncertainty import jackknife
from agent.model import IdentifiedModel, ParameterPrior
from agent.recording import Log
from agent.robot import Tool, rigid_bodies

_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Refit:
    """The model estimated again, and RMSE (n,) [N·m] over samples in which the joint moves.

    `held_out` is the new model's, each fold predicted by a fit to the others; `before` the earlier model's on the same
    rows, none of which it has seen.
    """

    model: IdentifiedModel
    held_out: np.ndarray
    before: np.ndarray


def refit(model: IdentifiedModel, logs: Sequence[Log], parameters: str = "friction", tool: Tool | None = None) -> Refit:
    """Estimate `parameters` ("friction" or "all") of a model again from logs that it has not seen.

    Args:
        model: to be brought up to date.
        logs: of the arm as it is now.
        parameters: "friction" or "all".
        tool: at the flange in these logs; None: the model's.

    Raises:
        InputError: logs that cannot be used, or a model whose base parameters are not this version's.
    """
    rigid = rigid_bodies(model.robot, tool)
    if not np.array_equal(rigid.independent, model.independent):
        raise InputError("the earlier model has other base parameters than this version identifies; calibrate anew")
    observation = observe(rigid, logs, FilterSettings(model.cutoff, model.order))
    observation = _without_effects(observation, model)
    cells = partition(observation.segments)
    problem = Problem.pose(observation, cells, model.terms, model.base_values).discount_held()
    if parameters == "all":
        problem = problem.with_own_prior_weight()
        fit = ESTIMATORS[model.method].fit(problem)
        fresh = build_model(problem, fit, model.method, logs)
        return _judged(problem, fit, replace(fresh, effects=model.effects), model)
    times = problem.autocorrelation_times(_friction(problem, model).parameters)
    problem = replace(problem, prior_weight=float(np.median(times)))
    fit = _friction(problem, model)
    fresh = build_model(problem, fit, model.method, logs)
    notes = (fresh.notes[0], "Friction estimated again; base parameters are those of the model before.")
    fresh = replace(
        fresh,
        covariance=_covariance(problem, fit, model),
        condition_number=model.condition_number,
        effects=model.effects,
        prior=_mixed_prior(model.prior, fresh.prior, len(model.independent)),
        notes=notes,
    )
    return _judged(problem, fit, fresh, model)


def conditional_covariance(model: IdentifiedModel) -> np.ndarray:
    """(T, T) covariance of the friction terms if the base parameters were exactly the model's."""
    b = len(model.independent)
    cross = model.covariance[b:, :b]
    base = model.covariance[:b, :b]
    scale = 1 / np.sqrt(np.maximum(np.diag(base), 1e-300))
    known = np.linalg.lstsq(base * np.outer(scale, scale), scale[:, None] * cross.T, rcond=1e-12)[0]
    conditional = model.covariance[b:, b:] - cross @ (scale[:, None] * known)
    # round-off may take a little more than there is
    return conditional + np.diag(np.maximum(0.0, 1e-12 * np.diag(model.covariance[b:, b:]) - np.diag(conditional)))


def _friction(problem: Problem, model: IdentifiedModel) -> Estimate:
    base = len(model.independent)
    moments, precision = problem.moments, problem.prior_weight * problem.prior.precision[base:, base:]

    def solver(total: np.ndarray) -> np.ndarray:
        right = total[base:-1, -1] - total[base:-1, :base] @ model.base_values
        friction = solve_scaled(total[base:-1, base:-1] + precision, right)
        return np.append(model.base_values, friction)

    parameters = model.values
    for _ in range(_ROUNDS):
        weights = reweight(moments, parameters)
        parameters = solver(moments.weighted(weights))
    return replace(problem.estimate(weights, solver=solver), standard=model.standard)


def _mixed_prior(before: ParameterPrior | None, fresh: ParameterPrior | None, base: int) -> ParameterPrior | None:
    """The prior of friction, and that of base parameters which are those of the model before."""
    if before is None or fresh is None:
        return None
    arrays = zip(vars(before).values(), vars(fresh).values(), strict=True)
    return ParameterPrior(*(np.append(old[:base], new[base:]) for old, new in arrays))


def _covariance(problem: Problem, fit: Estimate, model: IdentifiedModel) -> np.ndarray:
    base = len(model.independent)
    times = problem.autocorrelation_times(fit.parameters)
    moments, precision = problem.moments, problem.prior.precision[base:, base:]
    stationary = np.linalg.inv(moments.weighted(fit.weights / times)[base:-1, base:-1] + precision)
    total = moments.weighted(fit.weights)
    widen = np.sqrt(np.maximum(1.0, jackknife(problem, fit)[base:] / np.diag(stationary)))
    own = stationary * np.outer(widen, widen)
    gain = -np.linalg.solve(total[base:-1, base:-1] + problem.prior_weight * precision, total[base:-1, :base])
    of_base = model.covariance[:base, :base]
    passed_on = gain @ of_base
    return np.block([[of_base, passed_on.T], [passed_on, own + passed_on @ gain.T]])


def _judged(problem: Problem, fit: Estimate, fresh: IdentifiedModel, model: IdentifiedModel) -> Refit:
    moments = problem.moments
    rows = np.maximum(1, moments.rows[:, 0].sum(axis=0))
    held_out = np.sqrt(fit.held_out[:, 0].sum(axis=0) / rows)
    return Refit(fresh, held_out, np.sqrt(moments.energy(model.values)[0] / rows))


def _without_effects(observation: Observation, model: IdentifiedModel) -> Observation:
    """What the model's effects explain is no friction: it is taken off the measured torque."""
    if not model.effects:
        return observation
    bare = replace(model, effects=())
    segments = []
    for segment in observation.segments:
        m = segment.motion
        added = model.predict(m.q, m.qd, m.qdd, m.time) - bare.predict(m.q, m.qd, m.qdd, m.time)
        segments.append(replace(segment, torque=segment.torque - m.low_pass(added)))
    return replace(observation, segments=replace(observation.segments, items=tuple(segments)))
