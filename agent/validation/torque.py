"""Torque prediction on logs that took no part in a fit (AIM 2013, eq. 7-8, with the true root mean square)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from agent.core import InputError, finite
from agent.estimation import FilterSettings, Motion, check_log, motions, resolve_cutoff
from agent.model import IdentifiedModel
from agent.recording import Log
from agent.robot import torque_units

SCHEMA = "validation/1"
_MOVING = 1e-3  # of a joint's highest speed by the robot description
_TRAVELS = 0.01  # rad or m, from where on a joint says something of its channels
PREDICTED = 0.35  #: of how a joint's torque varies: the median error of a model that predicts it
_SAME_UNIT = 4.0  # times, at most, that measured torque is larger or smaller than predicted
_USUAL = 2.0  # times its held-out error, as motions differ


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of each joint, (n,): `rmse` [N·m, or N of a slide], the same over nominal torque, and over the measured
    torque (paper, eq. 7-8); the last of all joints together. None where there is nothing to divide by."""

    rmse: tuple[float, ...]
    normalised_rmse: tuple[float | None, ...]
    relative_error: tuple[float | None, ...]
    relative_error_all_joints: float | None


@dataclass(frozen=True)
class LogErrors(TorqueErrors):
    """The errors of one log, with its number of samples."""

    log: str
    samples: int


@dataclass(frozen=True)
class Validation:
    """What a model leaves of measured torque, log by log and of all samples: the document of docs/estimation.md.

    `units`: of each joint's torque, N·m, or N of a slide.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    cutoff_hz: float
    logs: tuple[LogErrors, ...]
    overall: TorqueErrors

    def to_dict(self) -> dict[str, Any]:
        """The document `validation/1`."""
        figures = {key: value for key, value in asdict(self).items() if key != "units"}
        return {"schema": SCHEMA, **figures, "logs": [{"log": entry.log, **asdict(entry)} for entry in self.logs]}


@dataclass(frozen=True, eq=False)
class Prediction:
    """Measured and predicted torque of one log, both filtered alike, edges dropped. S samples, n joints.

    time (S,) [s]; measured, predicted (S, n) [N·m]; friction (S, n): what the friction terms have in the prediction;
    moving (S,): where any joint moves.
    """

    model: IdentifiedModel
    log: str
    cutoff: float
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    friction: np.ndarray
    moving: np.ndarray
    _motions: tuple[Motion, ...]

    @property
    def error(self) -> np.ndarray:
        """(S, n) [N·m]; zero where a brake holds a joint, as no measured torque says with what."""
        return np.where(self.braked, 0.0, self.measured - self.predicted)

    @property
    def braked(self) -> np.ndarray:
        """(S, n) bool: where a brake holds a joint."""
        each = ((motion.braked, len(motion.time[motion.kept])) for motion in self._motions)
        return np.concatenate([np.broadcast_to(braked, (samples, len(braked))) for braked, samples in each])

    @property
    def position(self) -> np.ndarray:
        """(S, n) position of the joints at the same samples."""
        return np.concatenate([motion.q[motion.kept] for motion in self._motions])

    @property
    def velocity(self) -> np.ndarray:
        """(S, n) likewise."""
        return np.concatenate([motion.qd[motion.kept] for motion in self._motions])

    @property
    def acceleration(self) -> np.ndarray:
        """(S, n) likewise."""
        return np.concatenate([motion.qdd[motion.kept] for motion in self._motions])

    def rmse(self, moving: bool = False) -> np.ndarray:
        """(n,) [N·m]; `moving`: of samples where the arm moves."""
        return _rmse(self.error, self.braked, self.moving if moving else slice(None))

    @cached_property
    def half_width(self) -> np.ndarray:
        """(S, n) [N·m] half of the 95 % interval."""
        parts = []
        for motion in self._motions:
            columns = filtered_columns(self.model, motion)
            parts.append(self.model.prediction_interval(columns, motion.low_pass(motion.qd)))
        return np.concatenate(parts)

    @cached_property
    def parts(self) -> dict[str, np.ndarray]:
        """What sums to the prediction, (S, n) each [N·m]: torque of gravity, of acceleration ("inertia"), Coriolis and
        centrifugal torque, friction, and effects where the model has any."""
        torque, base, rigid = self.model.rigid.torque, self.model.base_values, []
        for motion in self._motions:
            still = np.zeros_like(motion.q)
            gravity = torque(motion.q, still, still, base)
            accelerated = torque(motion.q, still, motion.qdd, base) - gravity
            turning = torque(motion.q, motion.qd, still, base) - gravity
            rigid.append([motion.low_pass(value) for value in (gravity, accelerated, turning)])
        joined = map(np.concatenate, zip(*rigid, strict=True))
        parts = dict(zip(("gravity", "inertia", "Coriolis"), joined, strict=True)) | {"friction": self.friction}
        if self.model.effects:
            parts["effects"] = self.predicted - np.sum(list(parts.values()), axis=0)
        return parts

    def by(self, model: IdentifiedModel) -> Prediction:
        """The same samples predicted by another model of the same robot, filtered as they are here."""
        parts = [m.low_pass(np.hstack(model.predict_parts(m.q, m.qd, m.qdd, m.time))) for m in self._motions]
        predicted, friction = np.split(np.concatenate(parts), 2, axis=1)
        return replace(self, model=model, predicted=predicted, friction=friction)


def filtered_columns(model: IdentifiedModel, motion: Motion) -> np.ndarray:
    """(S', n, p) the model's columns along a motion, filtered."""
    columns = model.columns(motion.q, motion.qd, motion.qdd)
    return motion.low_pass(columns.reshape(len(columns), -1)).reshape(-1, *columns.shape[1:])


def pooled_rmse(predictions: Sequence[Prediction]) -> np.ndarray:
    """(n,) RMSE [N·m] over the moving samples of all motions."""
    error, braked, moving = (
        np.concatenate([getattr(p, key) for p in predictions]) for key in ("error", "braked", "moving")
    )
    return _rmse(error, braked, moving)


def _rmse(error: np.ndarray, braked: np.ndarray, rows: np.ndarray | slice) -> np.ndarray:
    """(n,) of the rows of errors (S, n) in which no brake holds the joint; 0 where one always does."""
    return np.sqrt(np.sum(error[rows] ** 2, axis=0) / np.maximum(np.sum(~braked[rows], axis=0), 1))


def predict_log(model: IdentifiedModel, log: Log, cutoff: float | None = None) -> Prediction:
    """Predict every sample of a log. `cutoff` [Hz] is the model's unless given.

    Args:
        model: that predicts.
        log: of the same robot, with torque.
        cutoff: of the torque filter [Hz]; None: the model's.

    Raises:
        InputError: a log of another robot, without torque, too short, or sampled too slowly for the cut-off.
    """
    check_log(model.robot, log)
    settings = FilterSettings(model.cutoff if cutoff is None else cutoff, model.order)
    segments = tuple(motions(log, settings, reduce=False))
    time, torques, moving = [], [], []
    for motion in segments:
        parts = model.predict_parts(motion.q, motion.qd, motion.qdd, motion.time)
        time.append(motion.time[motion.kept])
        assert motion.torque is not None
        torques.append(motion.low_pass(np.hstack([motion.torque, *parts])))
        moving.append(np.any(np.abs(motion.qd[motion.kept]) > _MOVING * model.robot.max_velocity, axis=1))
    measured, predicted, friction = np.split(np.concatenate(torques), 3, axis=1)
    return Prediction(
        model=model,
        log=log.name,
        cutoff=resolve_cutoff(log, settings),
        time=np.concatenate(time),
        measured=measured,
        predicted=predicted,
        friction=friction,
        moving=np.concatenate(moving),
        _motions=segments,
    )


def predicts(model: IdentifiedModel, logs: Sequence[Log]) -> bool:
    """Whether a model predicts the torque of every joint that moves, most of the time, as well as it usually does or
    far better than not at all: no channel of such logs can be mistaken, whatever else there may be at times.

    A channel that is flipped, swapped or of another unit errs by about as much as its torque varies, all along. While a
    joint stands its torque is anything within stiction, and says nothing of that.
    """
    signals = _pooled(model, logs, "position", "velocity", "measured", "error")
    if signals is None:
        return False
    position, velocity, measured, error = signals
    moving = _moving(model, position, velocity)
    most = np.maximum(PREDICTED * np.std(measured, axis=0), _USUAL * model.held_out_rmse)
    return bool(moving) and all(np.median(np.abs(error[rows, k])) < most[k] for k, rows in moving.items())


def same_scale(model: IdentifiedModel, logs: Sequence[Log]) -> bool:
    """Whether the torque of the joint that carries most is of about the size that a model predicts: it is of that unit.

    A joint that carries little shows its friction, which a simulator may leave out.
    """
    signals = _pooled(model, logs, "measured", "predicted")
    if signals is None:
        return False
    size, expected = (np.median(np.abs(signal), axis=0) for signal in signals)
    most = int(np.argmax(expected))
    return bool(size[most] < _SAME_UNIT * expected[most] and expected[most] < _SAME_UNIT * size[most])


def flipped_joints(model: IdentifiedModel, log: Log) -> list[str]:
    """Joints whose torque a model predicts with the other sign only."""
    signals = _pooled(model, [log], "position", "velocity", "measured", "predicted")
    if signals is None:
        return []
    position, velocity, measured, predicted = signals
    names = []
    for k, rows in _moving(model, position, velocity).items():
        size = np.std(measured[:, k])
        as_given, turned = (np.median(np.abs(s * measured[rows, k] - predicted[rows, k])) for s in (1, -1))
        if turned < PREDICTED * size and as_given > size:
            names.append(model.robot.joint_names[k])
    return names


def _moving(model: IdentifiedModel, position: np.ndarray, velocity: np.ndarray) -> dict[int, np.ndarray]:
    """Of every joint that travels, (S,) bool: where it moves."""
    moving = np.abs(velocity) > _MOVING * model.robot.max_velocity
    travels = np.ptp(position, axis=0) > _TRAVELS
    return {k: moving[:, k] for k in np.flatnonzero(travels & moving.any(axis=0)).tolist()}


def _pooled(model: IdentifiedModel, logs: Sequence[Log], *signals: str) -> list[np.ndarray] | None:
    """Signals of `Prediction`, (S, n) over all logs; None where one of these cannot be predicted."""
    try:
        predictions = [predict_log(model, log) for log in logs]
    except InputError:
        return None
    return [np.concatenate([getattr(each, signal) for each in predictions]) for signal in signals]


def validate(model: IdentifiedModel, logs: Sequence[Log], cutoff: float | None = None) -> Validation:
    """Errors of the model on these logs: every sample counts, standstill included.

    Args:
        model: that predicts.
        logs: that took no part in its fit.
        cutoff: of the torque filter [Hz]; None: the model's.

    Raises:
        InputError: as `predict_log`.
    """
    return summary([predict_log(model, log, cutoff) for log in logs])


def summary(predictions: Sequence[Prediction]) -> Validation:
    """The same from predictions at hand (at least one)."""
    model = predictions[0].model
    everything = _figures(model, predictions)
    logs = [LogErrors(**_figures(model, [p]), log=p.log, samples=len(p.time)) for p in predictions]
    return Validation(
        model.robot.joint_names,
        torque_units(model.robot),
        predictions[0].cutoff,
        tuple(logs),
        TorqueErrors(**everything),
    )


def _figures(model: IdentifiedModel, predictions: Sequence[Prediction]) -> dict[str, Any]:
    error, braked, measured = (
        np.concatenate([getattr(p, key) for p in predictions]) for key in ("error", "braked", "measured")
    )
    rmse = _rmse(error, braked, slice(None))
    length = np.linalg.norm(measured, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.linalg.norm(error, axis=0) / length
        together = np.linalg.norm(error) / np.linalg.norm(measured)
    return {
        "rmse": tuple(rmse.tolist()),
        "normalised_rmse": tuple(finite(rmse / model.robot.nominal_torque)),
        "relative_error": tuple(finite(relative)),
        "relative_error_all_joints": finite(together),
    }
