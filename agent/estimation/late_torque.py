"""By how much the recorded torque of an arm lags its motion.

Torque that is d late is τ(t) = X(t − d) β. A fit at equal times hides most of d in wrong inertias, wrong viscous
friction and friction that turns too slowly. So the d is looked for with which columns X fit τ(t + d) best, on rows that
a reversal is far from: how friction reverses looks like a delay, and no other part of an arm's torque does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.estimation.normal_equations import CERTAIN, autocorrelation_time, observed_standstill_speed
from agent.estimation.selection import paper_terms
from agent.estimation.signals.filtering import FilterSettings
from agent.estimation.signals.observation import Observation, observe
from agent.model import Reversal
from agent.recording import Log
from agent.robot import RobotDescription, rigid_bodies

_NOTICED = 1e-3  # s, from where on a fit at equal times hides much of it
_ROUNDS = 10  # numerical: of Gauss and Newton, each of which leaves a small part of what the one before left
_RANK = 1e-6  # numerical: singular value, over the largest, of columns that add nothing


def with_torque_in_time(robot: RobotDescription, logs: Sequence[Log], cutoff: float | None) -> list[Log] | None:
    """The logs with the torque that belongs to their motion; None where theirs is late or early by less than 1 ms.

    Args:
        robot: description of the arm.
        logs: with torque.
        cutoff: of the torque filter [Hz]; None: the usual one.

    Raises:
        InputError: logs that cannot be used (see `observe`).
    """
    delay = torque_delay(observe(rigid_bodies(robot), logs, FilterSettings(cutoff)))
    return [replace(log, effort=_later(log, delay)) for log in logs] if abs(delay) >= _NOTICED else None


def torque_delay(observation: Observation) -> float:
    """Seconds by which torque lags the motion, negative where it leads; zero where that may be chance.

    Every joint has parameters of its own.
    """
    joints = list(_joints(observation))
    delay, precision = 0.0, 0.0
    for _ in range(_ROUNDS if joints else 0):
        sides, precisions = zip(*(joint.step(delay) for joint in joints), strict=True)
        precision = sum(precisions)
        delay += sum(sides) / max(precision, 1e-300)
    return delay if delay**2 * precision > CERTAIN**2 else 0.0


def _later(log: Log, delay: float) -> np.ndarray:
    """(S, n) the torque that is recorded a delay [s] after each sample; that of the end where the log has no more."""
    from scipy.interpolate import CubicSpline  # slow to load

    assert log.effort is not None
    later = log.effort.copy()
    for part in (slice(*ends) for ends in log.segments if ends[1] - ends[0] > 1):
        time = log.t[part]
        later[part] = CubicSpline(time, log.effort[part])(np.clip(time + delay, time[0], time[-1]))
    return later


@dataclass(frozen=True, eq=False)
class _Joint:
    """Torque of one joint in segments, over time and after the filter, and the rows of each that a reversal is far
    from; `span` (S, c): an orthonormal basis of the columns of these rows."""

    torque: Sequence[Callable[..., np.ndarray]]
    times: Sequence[np.ndarray]
    span: np.ndarray

    def step(self, delay: float) -> tuple[float, float]:
        """Precision [1/s²] of the delay, times by how much it is larger than this one, and this precision."""
        later = [time + delay for time in self.times]
        remaining, slope = (
            self._remaining(
                np.concatenate([spline(time, order) for spline, time in zip(self.torque, later, strict=True)])
            )
            for order in (0, 1)
        )
        variance = float(remaining @ remaining) / max(len(remaining) - self.span.shape[1] - 1, 1)
        variance *= float(autocorrelation_time([remaining[:, None]])[0])
        return -float(slope @ remaining) / variance, float(slope @ slope) / variance

    def _remaining(self, torque: np.ndarray) -> np.ndarray:
        return torque - self.span @ (self.span.T @ torque)


def _joints(observation: Observation) -> Iterator[_Joint]:
    """The joints that slide long enough away from reversals and standstills."""
    from scipy.interpolate import CubicSpline  # slow to load

    terms = paper_terms([Reversal()] * observation.robot.dof, ("offset",))
    slowest = observed_standstill_speed(observation)
    parts: list[list[tuple[CubicSpline, np.ndarray, np.ndarray]]] = [[] for _ in slowest]
    for segment in observation.segments:
        motion, time = segment.motion, segment.time
        reach = round(motion.edge / motion.step)
        for joint, (_, columns) in enumerate(observation.joint_columns(segment, terms)):
            speed = segment.speed[:, joint]
            turns = (np.abs(speed) <= slowest[joint]) | (np.diff(speed < 0, append=speed[-1] < 0))
            turns[[0, -1]] = True
            far_from_turns = np.convolve(turns, np.ones(2 * reach + 1))[reach : reach + len(turns)] < 0.5
            if far_from_turns.any():
                parts[joint].append(
                    (CubicSpline(time, segment.torque[:, joint]), time[far_from_turns], columns[far_from_turns])
                )
    for torque, times, rows in (zip(*of_joint, strict=True) for of_joint in parts if of_joint):
        columns = np.concatenate(rows)
        columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        span, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        span = span[:, sizes > _RANK * sizes[0]]
        if len(columns) > 2 * span.shape[1]:
            yield _Joint(torque, times, span)
