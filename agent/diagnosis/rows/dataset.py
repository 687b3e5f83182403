"""From logs and a model to residuals and model columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from agent.core import InputError, symmetric_eigen
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.fit import Fit, FitRows
from agent.diagnosis.rows.folds import folds_of, segments_of
from agent.diagnosis.rows.joined import joined, log_of_rows
from agent.diagnosis.rows.rounding import rounding_noise
from agent.diagnosis.rows.servos import ServoParameters
from agent.diagnosis.rows.standstill import noise_level
from agent.estimation import (
    DESCRIPTION,
    EITHER,
    EstimationSettings,
    FilterSettings,
    estimate,
    observe,
    physical_prior,
    with_torque_in_time,
)
from agent.model import IdentifiedModel, MotionSignals, NominalModel, known_effects, known_payload
from agent.recording import Log
from agent.robot import RobotDescription


@dataclass(frozen=True, eq=False)
class Dataset:
    """The fit, the raw residual of the model (S', n) [N·m], and where each row lies.

    time, log (S',): time in its log [s] and which log; speed (S', n) of the joints; rate, cutoff [Hz] of the rows and
    of their filter; has_reference: whether a model was given (`Fit.keeps_parameters`). Where positions are judged
    instead of torque, `servos` has the parameters of the servos, and [N·m] above is rad or m.
    """

    robot: RobotDescription
    model: IdentifiedModel
    has_reference: bool
    fit: Fit
    residual: np.ndarray
    speed: np.ndarray
    time: np.ndarray
    log: np.ndarray
    logs: tuple[Log, ...]
    rate: float
    cutoff: float
    servos: ServoParameters | None = None

    @property
    def stored_covariance(self) -> np.ndarray:
        """(p, p) covariance of the parameters as they were given."""
        return self.model.covariance if self.servos is None else self.servos.prior.covariance

    @cached_property
    def open_error(self) -> np.ndarray:
        """(n,) [N·m] standard deviation of the predicted torque due to the model's parameters, root mean square.

        It is large along parameter directions that the logs of the fit did not excite. Zero for a simulator's file, and
        for a model of these logs.
        """
        error = np.zeros(self.robot.dof)
        if not self.has_reference or self.model.of_file:
            return error
        for joint, (rows, index) in enumerate(zip(self.fit.rows, self.fit.parameter_index, strict=True)):
            columns = rows[:, :-1] * self.fit.sigma[:, joint, None]
            moments = columns.T @ columns / len(columns)
            error[joint] = np.sqrt(max(np.sum(moments * self.model.covariance[np.ix_(index, index)]), 0.0))
        return error

    @property
    def open_joints(self) -> np.ndarray:
        """(n,) bool: joints whose torque on these motions is open by more than usual of the model's held-out error."""
        return self.fit.beyond_usual(self.open_error)

    @property
    def of(self) -> str:
        """What is judged: torque, or position."""
        return "torque" if self.servos is None else "position"

    @property
    def model_error(self) -> float | None:
        """The model's held-out error over the torque of these logs; None of a simulator's file."""
        if self.model.of_file:
            return None
        torque = np.concatenate([log.effort for log in self.logs if log.effort is not None])
        share = float(np.linalg.norm(self.model.held_out_rmse) / np.sqrt(np.mean(torque**2, axis=0).sum()))
        return share


def assemble(
    robot: RobotDescription,
    model: IdentifiedModel | None,
    logs: Sequence[Log],
    cutoff: float | None,
    friction: IdentifiedModel | None = None,
    refitted: bool = False,
) -> Dataset:
    """Residuals of a model, given or fitted, on logs.

    `friction` gives the stiction level at standstill if the model's own levels do not. Parameters of a model that was
    fitted to these very logs are `refitted` in every fold.

    Raises:
        InputError: a log or model of another robot, a log too short for the filter or without torque, or one with a
            known payload and no model.
    """
    has_reference = model is not None
    loads = [known_payload(log.metadata) for log in logs]
    if model is None and any(loads):
        raise InputError(
            f"{next(log.name for log, load in zip(logs, loads, strict=True) if load)}: was recorded with a "
            "known mass mounted, which needs a model of the bare arm: name one with --model"
        )
    if model is None:
        model = plain_model(robot, logs, cutoff)
    elif model.robot.joint_names != robot.joint_names:
        raise InputError(
            f"the model is of a robot with joints {', '.join(model.robot.joint_names)}; "
            f"{robot.name} has {', '.join(robot.joint_names)}"
        )
    reference = NominalModel(model)
    carriers = [reference if load is None else NominalModel(model, load) for load in loads]
    settings = FilterSettings(model.cutoff if cutoff is None else cutoff, model.order)
    observation = observe(model.rigid, logs, settings)
    n = robot.dof
    scale = reference.scale
    background = np.maximum(_moving_error(model), LIMITS.least_background * scale)
    if not has_reference:
        torque = np.concatenate([segment.torque for segment in observation.segments])
        background = expected_error(robot, torque, LIMITS.unknown_error)
    cutoff = observation.segments[0].motion.cutoff
    background = np.maximum(background, rounding_noise(reference, logs, cutoff))
    signals: list[MotionSignals] = []
    rows: list[list[np.ndarray]] = [[] for _ in range(n)]
    index: list[np.ndarray] = []
    begun = _start_times(logs)
    for segment in observation.segments:
        motion = segment.motion
        carrier = carriers[segment.log_index]
        state, number = (motion.time, motion.q, motion.qd, motion.qdd), segment.log_index
        more = (motion.kept, tuple(motion.cycle_starts), begun[number], motion.low_pass)
        signals.append(MotionSignals(carrier, *state, number, *more))
        extra = known_effects(model, signals[-1])
        per_joint = observation.joint_columns(segment, model.terms, carrier.model.base_values)
        index = [places for places, _ in per_joint]
        for joint, (places, columns) in enumerate(per_joint):
            unexplained = segment.torque[:, joint] - columns @ carrier.model.values[places] - extra[:, joint]
            rows[joint].append(np.column_stack([columns, unexplained]))
    speed = joined(signals, "qd")
    sigma = noise_level(reference if friction is None else NominalModel(friction), background, signals)
    over_sigma = [np.concatenate(parts) / sigma[:, joint, None] for joint, parts in enumerate(rows)]
    time = joined(signals, "time")
    log = log_of_rows(signals)
    residual = np.stack([block[:, -1] for block in over_sigma], axis=1) * sigma
    cell, folds, segment_folds = folds_of(time, log, logs)
    if has_reference and not refitted:
        precision, prior_information = precision_of(model.covariance), np.zeros(len(model.values))
    else:
        prior = physical_prior(observation, model.terms, _links(model))
        precision, prior_information = prior.precision, prior.precision @ (prior.mean - model.values)
    block = segments_of(time, log, logs, LIMITS.segment_duration)
    split = (cell, block, folds, segment_folds)
    fit = Fit(FitRows(reference, signals, over_sigma, index, sigma, precision, prior_information, *split))
    rate = 1 / float(np.median(np.diff(time)))
    return Dataset(robot, model, has_reference, fit, residual, speed, time, log, tuple(logs), rate, cutoff)


def _start_times(logs: Sequence[Log]) -> list[float]:
    """Per log, when it began [s] from the first on. Stamps that have logs of one arm overlap are no times of day: the
    logs are taken to follow one another as they are given."""
    order = sorted(logs, key=lambda log: log.stamp)
    if all(b.stamp >= a.stamp + a.t[-1] for a, b in pairwise(order)):
        return [log.stamp - order[0].stamp for log in logs]
    return [float(end) for end in np.cumsum([0.0, *(log.t[-1] for log in logs[:-1])])]


def _links(model: IdentifiedModel) -> str:
    """Prior of the links for a fit that leaves gaps open: the description's, unless the data refute it."""
    chosen = str(model.provenance["link_prior"])
    return DESCRIPTION if chosen == EITHER else chosen


def expected_error(robot: RobotDescription, torque: np.ndarray, share: float) -> np.ndarray:
    """Usual error (n,) [N·m] of a model of motions with this torque (S, n) if there are no others: a share of it."""
    usual = share * np.std(torque, axis=0)
    least = np.where(np.isfinite(robot.nominal_torque), LIMITS.least_background * robot.nominal_torque, 0.0)
    return np.maximum(np.maximum(usual, least), 1e-9)


def _moving_error(model: IdentifiedModel) -> np.ndarray:
    """(n,) [N·m] held-out error of moving rows, root mean square; of all rows where no other is known.

    Not by the weights of the fit: those of a robust one are of most of its rows, and what it gives up is its error too.
    """
    moving = model.held_out_rmse if model.group_rmse is None else model.group_rmse[0]
    return moving if model.sliding_rmse is None else np.minimum(moving, model.sliding_rmse)


def precision_of(covariance: np.ndarray) -> np.ndarray:
    """Inverse (p, p) of a covariance, which may be singular apart from round-off."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(deviation, deviation)
    values, vectors = symmetric_eigen(0.5 * (correlation + correlation.T))
    inverse = (vectors / np.maximum(values, 1e-9)) @ vectors.T
    return inverse / np.outer(deviation, deviation)


def plain_model(robot: RobotDescription, logs: Sequence[Log], cutoff: float | None) -> IdentifiedModel:
    """A model of bodies and direction-independent friction, fitted to the logs: the remainder is the gap.

    A delay of the torque is no part of the model. It is taken out before, unless other motion is then predicted worse:
    an elastic gear looks late, too.
    """
    settings = EstimationSettings.create(cutoff=cutoff)
    model = estimate(robot, logs, settings)
    if (in_time := with_torque_in_time(robot, logs, cutoff)) is not None:
        model = min(estimate(robot, in_time, settings), model, key=lambda m: float(np.log(m.held_out_rmse).sum()))
    count = len(model.independent)
    symmetric = [k for k, term in enumerate(model.terms) if term.form not in ("offset", "viscous_asymmetry")]
    kept = np.array([*range(count), *(count + k for k in symmetric)])
    return replace(
        model,
        terms=tuple(model.terms[k] for k in symmetric),
        values=model.values[kept],
        covariance=model.covariance[np.ix_(kept, kept)],
        prior=None if model.prior is None else model.prior.part(kept),
        effects=(),
    )
