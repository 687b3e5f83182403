"""Samples that no arm can have: torn rows, encoders that wrap around, single wrong positions and torques.

The reader drops or mends them, so nothing behind it has to expect them. Friction and contact step; they do not come and
go within one sample. Filtered, a spike looks like any other error, so the median of five samples finds it before.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from agent.recording.log import NANO, Repair
from agent.robot import RobotDescription

#: What no joint reaches in any unit that people mistake for SI: 1600 turns [rad], N·mm of the largest arms.
LIMITS = {"position": 1e4, "velocity": 1e6, "effort": 1e9}
_ALONE = 1e3  # times the 99 % quantile: no impact and no spike of a current sensor
_SPIKE = 12.0  # times the median step between samples
_SPIKE_SHARE = 1.5  # of the range of 98 % of the samples: no friction comes back that far
_MOST = 0.01  # of the samples; with more outliers, the channel, the unit or the description is wrong
_EVERY = 8  # samples; quantiles need no more
_TIMES, _LATE = 5.0, 0.010  # times the highest speed; s that stamps may be late
_TURN = 2 * np.pi
_MOST_TURNS = 100  # of an encoder that wraps around; in larger numbers every step is near some whole turn
_TORN = 5  # samples in a row that may be wrong; after more, the joint is there


def impossible(values: np.ndarray, quantity: str) -> np.ndarray:
    """(S,) samples of `position`, `velocity` or `effort` (S, n) with a number that no arm can have; NaN does not count.

    A velocity or effort a thousand times its 99 % quantile counts as well.
    """
    size, limit = np.abs(values), LIMITS[quantity]
    absurd = np.any(size > limit, axis=1)
    if quantity == "position" or not len(values):
        return absurd
    largest = np.quantile(np.nan_to_num(size[::_EVERY], posinf=0.0), 0.99, axis=0)
    outlying = np.any(size > np.where(largest > 0, _ALONE * np.minimum(largest, limit), np.inf), axis=1)
    return absurd | outlying if np.count_nonzero(outlying) <= _MOST * len(values) else absurd


def find_spikes(effort: np.ndarray) -> np.ndarray:
    """(K,) indices of samples of effort (S, n) that stand out from both of their neighbours."""
    step = np.abs(np.diff(effort, axis=0))
    low, high = np.quantile(effort[::_EVERY], [0.01, 0.99], axis=0)
    limit = np.maximum(_SPIKE * np.median(step[::_EVERY], axis=0), _SPIKE_SHARE * (high - low))
    steps = np.flatnonzero(np.any(step > limit, axis=1))
    places = np.unique(np.concatenate([steps, steps + 1]))
    places = places[(places >= 2) & (places < len(effort) - 2)]
    around = effort[places[:, None] + np.arange(-2, 3)]
    spikes = places[np.any(np.abs(effort[places] - np.median(around, axis=1)) > limit, axis=1)]
    return spikes if len(spikes) <= _MOST * len(effort) else spikes[:0]


@dataclass(frozen=True)
class Jumps:
    """Samples to drop, samples before which the position of a joint was lost, and what to report."""

    dropped: tuple[int, ...] = ()
    cuts: tuple[int, ...] = ()
    repairs: list[Repair] = field(default_factory=list)


def mend_jumps(stamp: np.ndarray, position: np.ndarray, robot: RobotDescription) -> Jumps:
    """Unwrap positions (S, n) in place, and find other jumps beyond the joint's range.

    Between two samples at sorted stamps (S,) [ns], a joint moves at most five times as far as its highest speed allows,
    plus 10 ms of it for late stamps.
    """
    step = np.diff(position, axis=0)
    limit = robot.max_velocity * (_TIMES * np.diff(stamp)[:, None] / NANO + _LATE)
    turns = np.round(step / _TURN)
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    jump = np.abs(step) > limit
    wrapped = jump & turning & (turns != 0) & (np.abs(turns) <= _MOST_TURNS) & (np.abs(step - turns * _TURN) <= limit)
    jump &= ~wrapped
    if np.count_nonzero(jump) > _MOST * len(stamp):
        return Jumps()
    position[1:] -= _TURN * np.cumsum(np.where(wrapped, turns, 0.0), axis=0)
    time = (stamp - stamp[0]) / NANO
    repairs = []
    for name, turned in zip(robot.joint_names, wrapped.T, strict=True):
        repairs += Repair.of(f"positions of {name} that wrap around, made continuous", time[1:], turned)
    dropped: list[int] = []
    cuts: list[int] = []
    known = 0  # first sample whose position is trusted again
    for before, joint in np.argwhere(jump).tolist():
        if before < known:
            continue
        known = _trusted_again(time, position, robot.max_velocity, before)
        dropped += range(before + 1, known)
        if known == before + 1:
            cuts.append(known)
            how_far = f"{robot.joint_names[joint]} jumps by {step[before, joint]:.3g}, further than it can move"
            repairs.append(Repair(f"{how_far}; cut there", float(time[known]), 1))
    repairs += Repair.of("samples with an impossible position, dropped", time, dropped)
    return Jumps(tuple(dropped), tuple(cuts), repairs)


def _trusted_again(time: np.ndarray, position: np.ndarray, fastest: np.ndarray, before: int) -> int:
    """First sample after a jump where the arm can have come to since sample `before`; the next one if it stays away."""
    later = np.arange(before + 2, min(before + 2 + _TORN, len(time)))
    limit = fastest * ((time[later] - time[before])[:, None] + 2 * _LATE)
    within_limit = later[np.all(np.abs(position[later] - position[before]) <= limit, axis=1)]
    return int(within_limit[0]) if len(within_limit) else before + 1
