"""Torque with the drives off: distinguishes an offset of the channel from friction that looks like one.

A motor without current makes no torque, so what its channel shows then is its zero. An offset that a diagnosis found is
there as well, alone or with the one that the model had before; friction by direction, a spring or a hose is not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent.core import InputError
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.score import EvaluatedHypothesis
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.model import Effect, IdentifiedModel
from agent.recording import Log
from agent.robot import RobotDescription

_OUTLIER = 5.0  # standard errors: a log of another day says no more against any hypothesis


@dataclass(frozen=True, eq=False)
class ChannelZero:
    """`torque` (n,) [N·m] of a log with the drives off and its standard `error` (n,), both NaN where the channel is off
    too."""

    torque: np.ndarray
    error: np.ndarray


def channel_zero(robot: RobotDescription, log: Log, model: IdentifiedModel | None) -> ChannelZero:
    """The zero of every torque channel, from a log that was recorded with the drives off.

    Args:
        robot: description of the arm.
        log: with the drives off.
        model: whose friction says what the arm holds by itself; None: none.

    Raises:
        InputError: the log has no torque, is short, is of an arm that moves or whose drives hold it, or the model is a
            simulator's file.
    """
    if model is not None and model.of_file:
        raise InputError(
            f"{log.name}: a log with the drives off needs an estimated model; with a simulator's file, leave it out"
        )
    if log.effort is None:
        raise InputError(f"{log.name}: has no torque, so it does not say what the channels show with the drives off")
    if log.t[-1] - log.t[0] < LIMITS.segment_duration or len(log.t) < LIMITS.min_samples:
        raise InputError(
            f"{log.name}: {log.t[-1] - log.t[0]:.2g} s with the drives off are too short, record "
            f"{LIMITS.segment_duration:g} s and {LIMITS.min_samples} samples at least"
        )
    for joint, travel in zip(robot.joints, np.ptp(log.position, axis=0), strict=True):
        if travel > LIMITS.least_travel:
            raise InputError(
                f"{log.name}: {joint.name} moves by {travel:.2g} {joint.position_unit}: with the drives off the brakes "
                "hold an arm"
            )
    _check_off(robot, log, model)
    means = np.array([block.mean(axis=0) for block in np.array_split(log.effort, LIMITS.log_parts)])
    off = np.ptp(log.effort, axis=0) == 0
    torque, error = means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(LIMITS.log_parts)
    return ChannelZero(np.where(off, np.nan, torque), np.where(off, np.nan, error))


def _check_off(robot: RobotDescription, log: Log, model: IdentifiedModel | None) -> None:
    """Raises:
    InputError: torque that no drive without current shows.
    """
    assert log.effort is not None
    nominal, mean, swing = robot.nominal_torque, log.effort.mean(axis=0), log.effort.std(axis=0)
    advice = "switch the drives off, let the brakes hold the arm, and record again"
    for joint, entry in enumerate(robot.joints):
        unit = entry.torque_unit
        if swing[joint] > LIMITS.negligible * nominal[joint]:
            raise InputError(
                f"{log.name}: the torque of {entry.name} varies by {swing[joint]:.3g} {unit} (standard deviation) "
                f"while the arm stands, which no motor without current does: {advice}"
            )
        if abs(mean[joint]) > nominal[joint]:
            raise InputError(
                f"{log.name}: the torque of {entry.name} is {mean[joint]:.4g} {unit}, and its nominal torque "
                f"{nominal[joint]:.4g}: that is no zero of a channel; {advice}, or mend the units in its import"
            )
    if model is None:
        return
    still = np.zeros((1, robot.dof))
    torque, friction = model.predict_parts(log.position.mean(axis=0)[None], still, still)
    static_torque = (torque - friction)[0]
    loaded = np.abs(static_torque) > Effect.practical * np.where(
        np.isnan(nominal), np.abs(static_torque).max(), nominal
    )
    remaining = np.linalg.norm((mean - _known_offsets(model) - static_torque)[loaded])
    if loaded.any() and remaining < (1 - LIMITS.explained) * np.linalg.norm(static_torque[loaded]):
        names = ", ".join(np.array(robot.joint_names)[loaded])
        raise InputError(
            f"{log.name}: the torque of {names} is what it takes to hold the arm there, so its drives are on: {advice}"
        )


def zero_likelihood(zero: ChannelZero, model: IdentifiedModel) -> Callable[[Evidence, EvaluatedHypothesis], float]:
    """Return the log likelihood that each hypothesis gives to the zeros of the channels.

    An effect that adds to the report of a channel shows there with its own size, alone or with the offset that the
    model had before; without one the channel shows nothing, or that.
    """
    before = _known_offsets(model)
    recorded = np.flatnonzero(np.isfinite(zero.torque))

    def log_likelihood(evidence: Evidence, hypothesis: EvaluatedHypothesis) -> float:
        offset = np.zeros(evidence.dof)
        for k, values in zip(hypothesis.effects, hypothesis.values, strict=True):
            candidate = evidence.pool.candidate(k)
            if candidate.effect.adds_to_report is not None:
                offset[candidate.joints[0]] += values[candidate.names.index(candidate.effect.adds_to_report)]
        miss = np.minimum(np.abs(zero.torque - offset), np.abs(zero.torque - offset - before))[recorded]
        slack = np.hypot(zero.error, Effect.practical * evidence.noise.nominal)[recorded]
        return float(-0.5 * np.sum(np.minimum(miss / slack, _OUTLIER) ** 2))

    return log_likelihood


def zero_remarks(dataset: Dataset, selected: SelectedCauses, zero: ChannelZero) -> tuple[str, ...]:
    """Return what a log with the drives off says of the causes, one text a channel that it may concern."""
    sizes = zip(selected.causes, selected.fit.values, strict=True)
    offsets = {c.joints[0]: float(np.abs(v).max()) for c, v in sizes if c.effect.adds_to_report is not None}
    before, remarks = _known_offsets(dataset.model), []
    for joint, entry in enumerate(dataset.robot.joints):
        shown, least = zero.torque[joint], Effect.practical * dataset.fit.reference.scale[joint]
        unit = entry.torque_unit
        if np.isnan(shown):
            if joint in offsets:
                remarks.append(f"the torque channel of {entry.name} is off with its drive, so it settles nothing")
        elif LIMITS.significant_deviations * zero.error[joint] > offsets.get(joint, np.inf):
            remarks.append(f"with the drives off the torque of {entry.name} is too restless to show an offset")
        elif joint in offsets:
            remarks.append(
                f"with the drives off the torque of {entry.name} is {shown:.3g} {unit}: its channel has an offset"
            )
        elif min(abs(shown), abs(shown - before[joint])) > LIMITS.significant_deviations * zero.error[joint] + least:
            remarks.append(
                f"with the drives off the torque of {entry.name} is {shown:.3g} {unit}, and in motion no offset of its "
                "channel was found: was it recorded on the same day, by the same channel, with the drives off?"
            )
    return tuple(remarks or ["with the drives off no torque channel shows an offset"])


def _known_offsets(model: IdentifiedModel) -> np.ndarray:
    """(n,) what the model has of them already [N·m], of the channel or not."""
    offsets = np.zeros(model.robot.dof)
    for term, value in zip(model.terms, model.values[len(model.independent) :], strict=True):
        if term.form == "offset":
            offsets[term.axle] += value
    return offsets
