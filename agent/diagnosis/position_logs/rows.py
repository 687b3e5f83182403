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
    widest_lag,
    with_link,
)
from agent.diagnosis.position_logs.recording import LinearisedMotion
from agent.diagnosis.rows.dataset import Dataset, precision_of
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.rows.folds import folds_of, segments_of
from agent.diagnosis.rows.servos import PositionLayout, ServoParameters
from agent.diagnosis.rows.standstill import StandstillWhitening
from agent.model import IdentifiedModel, NominalModel
from agent.recording import Log
from agent.simulators import KINDS, ServoNumbers, SimulatedArm, model_of

_EXACT = 1e-6  # standard deviation of a number that may not move, over its usual change
_LEAST = 1e-3  # numerical: of the largest value, usual change of one that is zero


def assemble_positions(
    found: OutputErrorFit, arm: SimulatedArm, model: IdentifiedModel, logs: Sequence[Log]
) -> Dataset:
    """The rows of a fit; `model` is that of the file."""
    n, given = model.robot.dof, found.simulator.numbers
    as_given = _as_given(found)
    error = _expected_error(found)
    bare = replace(model.robot, joints=tuple(replace(j, nominal_motor_torque=None) for j in model.robot.joints))
    at = replace(
        arm, armature=found.numbers.armature, frictionloss=found.numbers.friction, damping=found.numbers.damping
    )
    fitted = with_link(model_of(at, bare, dict(model.provenance)), found.load)
    fitted = replace(fitted, held_out_rmse=error, residual_rmse=error)
    reference = NominalModel(fitted)
    scale = usual_scale(reference, found.numbers, found.stretches)
    layout = PositionLayout.create(len(model.independent), n)
    from_file = np.zeros(layout.size)
    from_file[layout.base] = fitted.base_values - model.base_values
    from_file[layout.coulomb] = found.numbers.friction - given.friction
    from_file[layout.viscous] = found.numbers.damping - given.damping
    from_file[layout.kp] = found.numbers.kp - given.kp
    from_file[layout.stiffness] = found.numbers.stiffness - given.stiffness
    from_file[layout.offset] = found.numbers.offset - given.offset
    from_file[layout.delay] = found.numbers.delay - given.delay
    rows: list[list[np.ndarray]] = [[] for _ in range(n)]
    signals = []
    for line, residual, numbers in zip(found.motions, found.residuals, found.columns, strict=True):
        columns, residual = (line.stretch.averaged(x) for x in (model_columns(line, reference, numbers), residual))
        at_file = residual + columns @ from_file
        for j in range(n):
            rows[j].append(np.column_stack([columns[:, j], at_file[:, j]]) / error[j])
        of_positions = replace(
            line.signals, position_response=_position_response(line), through_play=_through_play(line)
        )
        signals.append(replace(of_positions, reference=reference, kept=line.rows))
    joined = [np.concatenate(part) for part in rows]
    time = np.concatenate([s.time[s.kept] for s in signals])
    log = np.concatenate([np.full(len(s.time[s.kept]), s.log_index) for s in signals])
    sigma = np.broadcast_to(error, (len(time), n)).copy()
    cell, folds, segment_folds = folds_of(time, log, logs)
    usual = np.full(layout.size, USUAL_DELAY)
    usual[: len(model.values)] = np.abs(model.values) + _LEAST * np.abs(model.values).max()
    usual[layout.kp], usual[layout.bend] = given.kp, given.damping
    usual[layout.cut] = widest_lag(found.stretches)
    by_kind = ServoNumbers.of_table(scale[: len(KINDS) * n].reshape(-1, n))
    usual[layout.stiffness], usual[layout.offset] = by_kind.stiffness, by_kind.offset
    covariance = np.diag((_EXACT * usual) ** 2)
    index = [np.arange(len(usual))] * n
    block = segments_of(time, log, logs, LIMITS.block)
    rests = StandstillWhitening(tuple(() for _ in range(n)))
    precision = precision_of(covariance)
    nothing = np.zeros(len(usual))
    fit = Fit(reference, signals, joined, index, sigma, precision, nothing, cell, block, folds, segment_folds, rests)
    speed = np.concatenate([s.qd[s.kept] for s in signals])
    rate = 1 / float(np.median(np.diff(time)))
    judged = replace(model, robot=bare, held_out_rmse=error, residual_rmse=error, weights=1 / np.stack([error**2] * 2))
    simulator = found.simulator
    added = simulator.added_inertia(found.numbers)
    lag = widest_lag(found.stretches)
    servos = ServoParameters(
        layout,
        covariance,
        USUAL_DELAY,
        given,
        from_file,
        simulator.arm,
        added,
        load_shape(found.load[: len(LOAD_NUMBERS)]) * scale[-4:],
        by_kind.stiffness if found.parameters.springs else None,
        by_kind.offset,
        tuple(np.flatnonzero(simulator.servos.in_unit).tolist()),
        partial(_free_error, found),
        found.rmse,
        cut=lag if found.stretches[0].nearest < np.inf else 0.0,
        step=simulator.step,
        one_delay=found.parameters.one_delay,
    )
    return Dataset(bare, judged, True, fit, as_given, speed, time, log, tuple(logs), rate, rate / 2, servos)


def model_columns(line: LinearisedMotion, reference: NominalModel, numbers: np.ndarray) -> np.ndarray:
    """(S', n, p) change of the positions with each parameter of the model, each kp, the cut of commands, each bend of
    damping, each spring, each offset and each delay.

    `numbers` (S', n, 7 n + 1) are those of joints and servos (`LinearisedMotion.number_columns`).
    """
    base = reference.model.rigid.columns(line.signals.q, line.signals.qd, line.signals.qdd)
    speeds, n = line.signals.qd.T, numbers.shape[1]
    layout = PositionLayout.create(base.shape[2], n)
    columns = np.zeros((*numbers.shape[:2], layout.size))
    _, damping, friction, kp, stiffness, delay, offset, cut = np.split(
        numbers, np.arange(n, numbers.shape[2], n), axis=2
    )
    columns[:, :, layout.coulomb], columns[:, :, layout.viscous] = friction, damping
    columns[:, :, layout.kp], columns[:, :, layout.cut] = kp, cut
    columns[:, :, layout.stiffness] = stiffness
    columns[:, :, layout.offset], columns[:, :, layout.delay] = offset, delay
    columns[:, :, layout.base] = line.response.of_torque({j: base[:, j] for j in range(n)})
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
