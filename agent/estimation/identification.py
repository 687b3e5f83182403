"""Entry point of the estimation: logs in, identified model out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from agent.core import InputError, keep_freed_memory, on_one_blas_thread
from agent.estimation.estimators import ESTIMATORS
from agent.estimation.model_building import build_model
from agent.estimation.normal_equations import predicts_better
from agent.estimation.partition import Partition, partition
from agent.estimation.problem import Problem, standstill_runs
from agent.estimation.selection import (
    LOWEST,
    best_estimate,
    choose_links,
    paper_terms,
    predictive_cutoff,
    select_friction_terms,
)
from agent.estimation.signals.filtering import FilterSettings
from agent.estimation.signals.observation import ENOUGH_TIME, Observation, observe
from agent.model import IdentifiedModel, Reversal
from agent.recording import Log
from agent.robot import RigidBodies, RobotDescription, Tool, rigid_bodies

AUTO = "auto"
_COMPARED = ("weighted", "huber", "consistent", "plain")
_MORE_FRICTION = 0.1  # of the squared error held out: what must be gained by more than the plain terms of friction


def methods() -> tuple[str, ...]:
    """Names that `method` may have."""
    return (AUTO, *ESTIMATORS)


@dataclass(frozen=True)
class EstimationSettings:
    """How to estimate.

    method: one of `methods()`; "auto" is decided by held-out error. friction: "selected" (terms by held-out error) or
    "paper" (its three terms, nothing else).
    """

    filter: FilterSettings = field(default_factory=FilterSettings)
    method: str = AUTO
    friction: str = "selected"

    @classmethod
    def create(
        cls,
        cutoff: float | None = None,
        method: str | None = None,
        order: int = 8,
        friction: str = "selected",
    ) -> EstimationSettings:
        """Settings from what a user named; None is the default.

        Raises:
            InputError: unknown method or friction, or a cut-off that is none.
        """
        if cutoff is not None and not (np.isfinite(cutoff) and cutoff >= 0.1):  # as in a recipe
            raise InputError(f"--cutoff {cutoff:g}: a frequency of at least 0.1 Hz is needed")
        if method is not None and method not in methods():
            raise InputError(f"method {method!r} is not known; choose one of {', '.join(methods())}")
        if friction not in ("selected", "paper"):
            raise InputError(f"friction {friction!r} is not known; choose selected or paper")
        return cls(FilterSettings(cutoff, order), method or AUTO, friction)


@on_one_blas_thread
def estimate(
    robot: RobotDescription, logs: Sequence[Log], settings: EstimationSettings | None = None, tool: Tool | None = None
) -> IdentifiedModel:
    """Identify base parameters and friction from logs. `tool` is part of what is expected of the last link.

    Args:
        robot: description of the arm.
        logs: of one machine.
        settings: method, cut-off and friction; None: the usual ones.
        tool: mounted at the flange.

    Raises:
        InputError: no logs, one given twice, nothing that moves or no torque in them, or what `observe` refuses.
    """
    keep_freed_memory()
    if not logs:
        raise InputError("no logs were given, so there is nothing to estimate from")
    _check_motion(logs)
    _check_twice(logs)
    settings = settings or EstimationSettings()
    observation = observe_predictable(rigid_bodies(robot, tool), logs, settings.filter)
    cells = partition(observation.segments)
    if standstill_runs(observation):
        observation = _first_problem(observation, cells, "offset").discount_held().observation
    names = _COMPARED if settings.method == AUTO else (settings.method,)
    terms = {name: ESTIMATORS[name].friction or settings.friction for name in names}
    problems = {friction: _problem(observation, cells, friction) for friction in dict.fromkeys(terms.values())}
    tried = {name: ESTIMATORS[name].fit(problems[terms[name]]) for name in names}
    method, chosen = best_estimate(tried) if settings.method == AUTO else next(iter(tried.items()))
    return build_model(problems[terms[method]], chosen, method, logs)


def _problem(observation: Observation, cells: Partition, friction: str) -> Problem:
    """The problem of fitting one set of friction terms, the prior with the weight that its residuals ask for."""
    if friction == "paper":
        return _first_problem(observation, cells).with_own_prior_weight()
    usual = choose_links(_first_problem(observation, cells, "offset"))
    if friction == "plain":
        return usual
    selected = select_friction_terms(observation, cells).discount_held().with_own_prior_weight()
    weights = selected.weights()
    before, after = (each.held_out(weights) for each in (usual, selected))
    return selected if predicts_better(before, after, weights, _MORE_FRICTION) else usual


def observe_predictable(rigid: RigidBodies, logs: Sequence[Log], settings: FilterSettings) -> Observation:
    """Logs filtered with the cut-off asked for, or with one up to which a first fit predicts their torque.

    A lower cut-off needs longer segments; one that would lose much of the logs is not taken.

    Raises:
        InputError: as `observe`.
    """
    observation = observe(rigid, logs, settings)
    highest = observation.segments[0].motion.cutoff
    if settings.cutoff is not None or highest <= LOWEST:
        return observation
    lowest = _lower(observation, logs, settings, LOWEST)
    if lowest is None:
        return observation
    first = choose_links(_first_problem(lowest))
    better = predictive_cutoff(_first_problem(observation), first.solve(first.weights()))
    if better is None:
        return observation
    cutoff, joint = better
    lower = lowest if cutoff == LOWEST else _lower(observation, logs, settings, cutoff)
    return observation if lower is None else replace(lower, noisy=joint)


def _lower(
    observation: Observation, logs: Sequence[Log], settings: FilterSettings, cutoff: float
) -> Observation | None:
    """The logs filtered with a lower cut-off; None where that would lose much of them."""
    try:
        lower = observe(observation.rigid, logs, replace(settings, cutoff=cutoff))
    except InputError:
        return None
    return lower if lower.seconds >= ENOUGH_TIME * observation.seconds else None


def _first_problem(observation: Observation, cells: Partition | None = None, third: str = "quadratic") -> Problem:
    """Three terms of friction an axle, none of them with a reversal that was learned."""
    terms = paper_terms([Reversal()] * observation.robot.dof, (third,))
    return Problem.pose(observation, cells or partition(observation.segments), terms)


def _check_motion(logs: Sequence[Log]) -> None:
    names = ", ".join(str(log.path) for log in logs)
    if not any(np.any(log.position[part] != log.position[0]) for log in logs for part in log.scratch.parts(len(log.t))):
        raise InputError(f"{names}: no joint moves, so there is nothing to estimate from; record a motion")


def _check_twice(logs: Sequence[Log]) -> None:
    # Held-out error would be that of rows that were fitted.
    for log, other in combinations(logs, 2):
        if len(log.t) == len(other.t) and _same(log, other):
            raise InputError(f"{log.path} and {other.path} are the same recording; give each log once")


def _same(log: Log, other: Log) -> bool:
    measured = [(log.position, other.position)]
    if log.effort is not None and other.effort is not None:
        measured.append((log.effort, other.effort))
    elif log.effort is not other.effort:
        return False
    rows = log.scratch.parts(len(log.t))
    return all(np.array_equal(a[part], b[part]) for part in other.scratch.each(rows) for a, b in measured)
