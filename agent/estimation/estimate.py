"""The front: logs in, identified model out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.errors import InputError
from agent.estimation.blocks import Partition, partition
from agent.estimation.filtering import FilterSettings
from agent.estimation.friction_terms import FrictionTerm, Reversal
from agent.estimation.least_squares import iterate_weights, ordinary_weights, residuals, solve_rows
from agent.estimation.model import IdentifiedModel
from agent.estimation.moments import Moments, collect
from agent.estimation.observation import Observation, RigidBodies, observe
from agent.estimation.prior import Prior, physical_prior
from agent.estimation.selection import paper_terms, select_terms
from agent.estimation.uncertainty import autocorrelation_time, covariance, held_out_energy, silent_directions
from agent.recording.log import Log
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot.dynamics import Tool

METHODS = ("weighted", "ordinary")
_BAD_CONDITION = 1000.0


@dataclass(frozen=True)
class EstimationSettings:
    """How to estimate. friction: "ladder" (terms by held-out error) or "paper" (its three terms, nothing else)."""

    filter: FilterSettings = field(default_factory=FilterSettings)
    method: str = "weighted"
    friction: str = "ladder"

    @classmethod
    def create(
        cls, cutoff: float | None = None, method: str | None = None, order: int = 8, friction: str = "ladder"
    ) -> EstimationSettings:
        """Settings from what a user named; None is the default.

        Raises:
            InputError: unknown method or friction.
        """
        if method is not None and method not in METHODS:
            raise InputError(f"method {method!r} is not known; choose one of {', '.join(METHODS)}")
        if friction not in ("ladder", "paper"):
            raise InputError(f"friction {friction!r} is not known; choose ladder or paper")
        return cls(FilterSettings(cutoff, order), method or METHODS[0], friction)


def estimate(
    robot: RobotDescription, logs: Sequence[Log], settings: EstimationSettings | None = None, tool: Tool | None = None
) -> IdentifiedModel:
    """Identify base parameters and friction from logs. `tool` is part of what is expected of the last link.

    Raises:
        InputError: no logs, or one that cannot be used (see `observe`).
    """
    if not logs:
        raise InputError("no logs were given, so there is nothing to estimate from")
    settings = settings or EstimationSettings()
    rigid, names, combinations = rigid_bodies(robot, tool)
    observation = observe(rigid, logs, settings.filter)
    cells = partition(observation.stretches)
    terms = paper_terms([Reversal()] * robot.dof)
    trust = fit(observation, cells, terms, settings.method, 1.0).trust
    if settings.friction == "ladder":
        terms = select_terms(observation, cells, trust)
    solution = fit(observation, cells, terms, settings.method, trust)
    solution = fit(observation, cells, terms, settings.method, solution.trust, solution.rigid_parameters)
    return _model(observation, cells, solution, settings, names, combinations, logs)


def rigid_bodies(
    robot: RobotDescription, tool: Tool | None = None
) -> tuple[RigidBodies, tuple[str, ...], tuple[str, ...]]:
    """Regressor of a robot's base parameters, the names of its standard parameters, and the combinations as text."""
    from agent.robot.base_parameters import base_parameters
    from agent.robot.dynamics import Dynamics

    base = base_parameters(robot)
    return RigidBodies(Dynamics(robot, tool), base.independent, base.projection), base.standard_names, base.names


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit with given terms. parameters (p,); triangle (p + 1, p + 1) of its weighted rows; times (n,): samples per
    independent one; trust: their median, which is what the prior's precision has to be multiplied with.
    """

    terms: tuple[FrictionTerm, ...]
    parameters: np.ndarray
    triangle: np.ndarray
    moments: Moments
    weights: np.ndarray
    prior: Prior
    times: np.ndarray
    trust: float
    rigid_parameters: np.ndarray


def fit(
    observation: Observation,
    cells: Partition,
    terms: tuple[FrictionTerm, ...],
    method: str,
    trust: float,
    rigid_parameters: np.ndarray | None = None,
) -> Solution:
    """Fit given terms; the load some need comes from `rigid_parameters` (b,) of an earlier fit, else from the prior."""
    prior = physical_prior(observation, terms)
    count = observation.rigid.count
    load = prior.mean[:count] if rigid_parameters is None else rigid_parameters
    moments = collect(observation, cells, terms, load)
    weights = ordinary_weights(moments) if method == "ordinary" else iterate_weights(moments, prior, trust)
    parameters, triangle = solve_rows(observation, terms, weights, prior, trust, load)
    times = autocorrelation_time(residuals(observation, terms, parameters, load))
    return Solution(
        terms, parameters, triangle, moments, weights, prior, times, float(np.median(times)), parameters[:count]
    )


def _model(
    observation: Observation,
    cells: Partition,
    solution: Solution,
    settings: EstimationSettings,
    names: tuple[str, ...],
    combinations: tuple[str, ...],
    logs: Sequence[Log],
) -> IdentifiedModel:
    moments, weights, prior = solution.moments, solution.weights, solution.prior
    rows = moments.rows.sum(axis=(0, 1))
    held_out = held_out_energy(moments, cells, weights, prior, solution.trust).sum(axis=0)
    condition = condition_number(solution.triangle)
    rigid = observation.rigid
    first = observation.stretches[0].motion
    model = IdentifiedModel(
        robot=observation.robot,
        independent=rigid.independent,
        projection=rigid.projection,
        standard_names=names,
        combinations=combinations,
        terms=solution.terms,
        values=solution.parameters,
        covariance=covariance(moments, cells, weights, prior, solution.trust, solution.times),
        cutoff=first.cutoff,
        order=first.order,
        method=settings.method,
        weights=weights,
        residual_rmse=np.sqrt(moments.energy(solution.parameters).sum(axis=0) / rows),
        held_out_rmse=np.sqrt(held_out / rows),
        condition_number=condition,
        provenance=_provenance(observation, logs),
    )
    return replace(model, notes=tuple(_notes(model, cells, solution, logs)))


def condition_number(triangle: np.ndarray) -> float:
    """Of the weighted observation matrix with its columns scaled to unit length, from its R; inf if one is zero."""
    columns = triangle[:, :-1]
    length = np.linalg.norm(columns, axis=0)
    if np.any(length <= 1e-12 * length.max()):
        return float("inf")
    return float(np.linalg.cond(columns / length))


def _notes(model: IdentifiedModel, cells: Partition, solution: Solution, logs: Sequence[Log]) -> Iterator[str]:
    """What a user should know about this fit."""
    kind = (
        "whole motions" if len(logs) > 2 else "stretches of the motion, all cycles together, with a guard between them"
    )
    yield f"Held-out errors: {cells.folds} folds of {kind}."
    directions = silent_directions(solution.moments, solution.weights, solution.prior, solution.times)
    if model.condition_number > _BAD_CONDITION:
        yield (
            f"The condition number of the observation matrix is {model.condition_number:.3g}: these motions hardly "
            "tell some parameters apart. Together they are sound on motions like these, each alone is "
            "not; a motion planned for excitation, or a larger sub-region, separates them."
        )
    if len(directions):
        names = _leading_names(model.names, directions)
        yield (
            f"{len(directions)} of {len(model.values)} parameter directions are not in these data and stay near their "
            f"prior (links near the URDF): mainly {', '.join(names)}."
        )
    still = solution.moments.rows[:, 1].sum(axis=0) / solution.moments.rows.sum(axis=(0, 1))
    if np.any(still > 0.05):
        lighter = np.sqrt(solution.weights[1] / solution.weights[0])
        parts = [
            f"{name} {100 * share:.0f} % (weight {weight:.2f})"
            for name, share, weight in zip(model.robot.joint_names, still, lighter, strict=True)
            if share > 0.05
        ]
        yield (
            "Standstill, where friction is anything within stiction, is in the fit with the weight its residuals "
            f"earn: {', '.join(parts)}."
        )


def _leading_names(names: Sequence[str], directions: np.ndarray, most: int = 8) -> list[str]:
    """The parameters that have most of these directions (d, p), largest first."""
    share = np.sum(directions**2, axis=0)
    order = np.argsort(-share)[:most]
    return [names[k] for k in order if share[k] > 0.1]


def _provenance(observation: Observation, logs: Sequence[Log]) -> dict[str, Any]:
    samples = [sum(len(s.time) for s in observation.stretches if s.log_index == k) for k in range(len(logs))]
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "logs": [
            {
                "log": log.name,
                "samples": len(log.t),
                "rate_hz": float(log.sample_rate),
                "duration_s": float(log.t[-1] - log.t[0]),
                "rows_per_joint": rows,
                "repairs": [str(repair) for repair in log.repairs],
            }
            for log, rows in zip(logs, samples, strict=True)
        ],
        "smoothing_hz": float(observation.stretches[0].motion.pass_edge),
    }
