"""Rows of positions: what a simulator's free motion leaves, and how each number of its file would move it.

The fit is linear about the numbers of `OutputErrorFit`, θ. Residuals are carried over to the file's own numbers by the
same derivatives, e + X (θ − θ_file): numbers are released and effects are tried from the file on, as with torque.

A row is the mean over `LIMITS.row_correlation_time`. Rounding and jitter of stamps differ from frame to frame, so most
of them goes, and what differs for longer stays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.fitting import (
    LOAD_NUMBERS,
    USUAL_DELAY,
    OutputErrorFit,
    load_shape,
    missed,
    position_step,
    usual_scale,
    usual_twist,
    with_link,
)
from agent.diagnosis.position_logs.stretch import LinearisedMotion
from agent.diagnosis.rows.dataset import Dataset, precision_of
from agent.diagnosis.rows.fit import Fit, FitRows
from agent.diagnosis.rows.folds import folds_of, segments_of
from agent.diagnosis.rows.joined import joined, log_of_rows
from agent.diagnosis.rows.servos import ComparedSimulation, PositionLayout, ServoParameters, ServoPrior
from agent.diagnosis.rows.standstill import StandstillWhitening
from agent.model import IdentifiedModel, MotionSignals, NominalModel
from agent.recording import Log
from agent.robot import RobotDescription
from agent.simulators import KINDS, ServoNumbers, Simulator, model_of

_EXACT = 1e-6  # standard deviation of a number that may not move, over its usual change
_LEAST = 1e-3  # numerical: of the largest value, usual change of one that is zero


def assemble_positions(
    fit: OutputErrorFit, simulator: Simulator, logs: Sequence[Log], known_kp: bool, later: float
) -> Dataset:
    """The rows of a fit of a simulator's file; `later` [s] and `known_kp` as in `ServoParameters`."""
    error, model = _expected_error(fit), simulator.model
    bare = replace(model.robot, joints=tuple(replace(j, nominal_motor_torque=None) for j in model.robot.joints))
    reference = _fitted_reference(fit, simulator, bare, error)
    servos = _servo_parameters(fit, reference, model, known_kp, later)
    signals, rows = _rows(fit, reference, servos.fitted, error)
    time = joined(signals, "time")
    log = log_of_rows(signals)
    sigma = np.broadcast_to(error, (len(time), len(error))).copy()
    cell, folds, segment_folds = folds_of(time, log, logs)
    prior = precision_of(servos.prior.covariance), np.zeros(servos.layout.size)
    index = [np.arange(servos.layout.size)] * len(error)
    block = segments_of(time, log, logs, LIMITS.segment_duration)
    rests = StandstillWhitening(tuple(() for _ in error))
    of_rows = Fit(FitRows(reference, signals, rows, index, sigma, *prior, cell, block, folds, segment_folds, rests))
    speed = joined(signals, "qd")
    rate = 1 / float(np.median(np.diff(time)))
    judged = replace(model, robot=bare, held_out_rmse=error, residual_rmse=error, weights=1 / np.stack([error**2] * 2))
    as_given = _as_given(fit)
    return Dataset(bare, judged, True, of_rows, as_given, speed, time, log, tuple(logs), rate, rate / 2, servos)


def _fitted_reference(
    fit: OutputErrorFit, simulator: Simulator, robot: RobotDescription, error: np.ndarray
) -> NominalModel:
    """The model of the file with the numbers and the load of the fit, which leaves an error (n,) [rad or m]."""
    arm, numbers = simulator.arm, fit.numbers
    arm = replace(arm, armature=numbers.armature, frictionloss=numbers.friction, damping=numbers.damping)
    model = model_of(arm, robot, dict(simulator.model.provenance))
    return NominalModel(replace(with_link(model, fit.load), held_out_rmse=error, residual_rmse=error))


def _servo_parameters(
    fit: OutputErrorFit, reference: NominalModel, model: IdentifiedModel, known_kp: bool, later: float
) -> ServoParameters:
    """Numbers of the file, of which `model` is, and of the fit, of which the `reference` is."""
    simulator, file = fit.simulator, fit.simulator.numbers
    layout = PositionLayout.create(len(model.independent), len(file.kp))
    fitted = np.zeros(layout.size)
    fitted[layout.base] = reference.model.base_values - model.base_values
    for kind, place in layout.of_numbers.items():
        fitted[place] = getattr(fit.numbers, kind) - getattr(file, kind)
    scale = usual_scale(reference, fit.numbers, fit.stretches)
    spring, offset = scale.servos.stiffness, scale.servos.offset
    usual = np.full(layout.size, USUAL_DELAY)
    usual[: len(model.values)] = np.abs(model.values) + _LEAST * np.abs(model.values).max()
    usual[layout.kp], usual[layout.bend] = file.kp, file.damping
    usual[layout.cut], usual[layout.stiffness], usual[layout.offset] = scale.cut, spring, offset
    prior = ServoPrior(
        covariance=np.diag((_EXACT * usual) ** 2),
        delay=USUAL_DELAY,
        spring=spring if fit.parameters.springs else None,
        offset=offset,
        with_offset=tuple(np.flatnonzero(simulator.servos.in_unit).tolist()),
        load=load_shape(fit.load[: len(LOAD_NUMBERS)]) * scale.load,
        cut=scale.cut if fit.stretches[0].nearest < np.inf else 0.0,
        one_delay=fit.parameters.one_delay,
        kp_known=known_kp,
    )
    inertia, error = simulator.added_inertia(fit.numbers), partial(_free_error, fit)
    simulation = ComparedSimulation(simulator.arm, simulator.step, inertia, error, fit.rmse)
    return ServoParameters(layout, file, fitted, prior, simulation, later)


def _rows(
    fit: OutputErrorFit, reference: NominalModel, fitted: np.ndarray, error: np.ndarray
) -> tuple[list[MotionSignals], list[np.ndarray]]:
    """Signals per stretch, and per joint (S', p + 1) the columns and the residual of the file, over the error (n,)."""
    signals, columns, residuals = [], [], []
    for line, residual, numbers in zip(fit.motions, fit.residuals, fit.columns, strict=True):
        columns.append(line.stretch.averaged(model_columns(line, reference, numbers)))
        residuals.append(line.stretch.averaged(residual) + columns[-1] @ fitted)
        responses = replace(line.signals, position_response=_position_response(line), through_play=_through_play(line))
        signals.append(replace(responses, reference=reference, kept=line.rows))
    whole = np.concatenate([np.concatenate(columns), np.concatenate(residuals)[:, :, None]], axis=2)
    return signals, [np.ascontiguousarray(whole[:, j]) / error[j] for j in range(len(error))]


def model_columns(line: LinearisedMotion, reference: NominalModel, numbers: np.ndarray) -> np.ndarray:
    """(S', n, p) change of the positions with each parameter of the model, each kp, the cut of commands, each bend of
    damping, each spring, each offset and each delay.

    `numbers` (S', n, 7 n + 1) are those of joints and servos (`LinearisedMotion.number_columns`).
    """
    base = reference.model.rigid.columns(line.signals.q, line.signals.qd, line.signals.qdd)
    speeds, n = line.signals.qd.T, numbers.shape[1]
    layout = PositionLayout.create(base.shape[2], n)
    columns = np.zeros((*numbers.shape[:2], layout.size))
    columns[:, :, layout.base] = line.response.of_torque({j: base[:, j] for j in range(n)})
    for kind, place in layout.of_numbers.items():
        columns[:, :, place] = numbers[:, :, KINDS.index(kind) * n :][:, :, :n]
    columns[:, :, layout.cut] = numbers[:, :, len(KINDS) * n :]
    bends = [line.response.of_torque({j: (qd * np.abs(qd))[:, None]}) for j, qd in enumerate(speeds)]
    columns[:, :, layout.bend] = np.concatenate(bends, axis=2)
    return columns


def _as_given(fit: OutputErrorFit) -> np.ndarray:
    """(R, n) residual of the file as it is: its own free motion."""
    parts = []
    for stretch in fit.stretches:
        motion = stretch.run(fit.simulator, fit.simulator.numbers)
        parts.append(stretch.averaged(stretch.position[stretch.judged] if motion is None else missed(stretch, motion)))
    return np.concatenate(parts)


def _free_error(fit: OutputErrorFit, numbers: ServoNumbers, load: np.ndarray) -> np.ndarray:
    """(n,) [rad or m] root mean square error of the free motion with other numbers; infinite where it blows up."""
    arm = fit.simulator.carrying(load) if load.any() else fit.simulator
    motions = [stretch.run(arm, numbers) for stretch in fit.stretches]
    parts = [missed(s, m) for s, m in zip(fit.stretches, motions, strict=True) if m is not None]
    if len(parts) < len(motions):
        return np.full(len(numbers.kp), np.inf)
    return np.asarray(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)))


def _expected_error(fit: OutputErrorFit) -> np.ndarray:
    """(n,) [rad or m] what is expected of a right file: the rounding of positions, a share of the torque, and friction
    of another day.

    The share is that of the joint in the middle, as with torque (`expected_share`).
    """
    rounding = _rounding(fit)
    twist = usual_twist([line.motion for line in fit.motions], fit.numbers.kp)
    rows = [stretch.averaged(residual) for stretch, residual in zip(fit.stretches, fit.residuals, strict=True)]
    residual = np.sqrt(np.maximum(np.mean(np.concatenate(rows) ** 2, axis=0) - rounding**2, 0.0))
    share = LIMITS.expected_share(residual / twist)
    daily = LAW.daily * fit.numbers.friction / np.maximum(fit.numbers.kp, 1e-9)
    return np.sqrt(rounding**2 + (share * twist) ** 2 + daily**2)


def _rounding(fit: OutputErrorFit) -> np.ndarray:
    """(n,) [rad or m] error of a row by rounding: it stays where a joint rests."""
    step = np.maximum(position_step(fit.stretches), 1e-300)
    parts = []
    for stretch, residual in zip(fit.stretches, fit.residuals, strict=True):
        simulated = stretch.position[stretch.judged] - residual
        parts.append(stretch.averaged(step * np.round(simulated / step) - simulated))
    return np.asarray(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)))


def _position_response(line: LinearisedMotion) -> Callable[[Mapping[int, np.ndarray]], dict[int, np.ndarray]]:
    """What the positions of all joints show of torque columns."""

    def position_response(columns: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        moved = line.stretch.averaged(line.response.of_torque(columns))
        return {j: moved[:, j] for j in range(moved.shape[1])}

    return position_response


def _through_play(line: LinearisedMotion) -> Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """What the positions of a joint show of gears with play before what its servo reads."""

    def through_play(joint: int, stiffness: np.ndarray, gap: np.ndarray, damping: np.ndarray) -> np.ndarray:
        return line.stretch.averaged(line.through_play(joint, stiffness, gap, damping))

    return through_play
