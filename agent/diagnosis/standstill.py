"""Where joints stand still: stiction holds them there, and the torque is anything below the Coulomb level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.model import MotionSignals, standstill_speed


def standing(
    signals: Sequence[MotionSignals], limits: DecisionLimits = LIMITS, beside: Sequence[MotionSignals] = ()
) -> list[np.ndarray]:
    """Per motion (S, n) bool: whether a joint stands. One that travels nowhere always does, whatever its noise.

    `beside` are other motions of the same arm: how slow is standing depends on how fast the joint goes in any.
    """
    known = [*beside, *signals]
    slowest = standstill_speed([motion.qd for motion in known], known[0].reference.robot.max_velocity)
    slowest = np.where(moves(known, limits), slowest, np.inf)
    return [np.abs(motion.qd) <= slowest for motion in signals]


def moves(signals: Sequence[MotionSignals], limits: DecisionLimits = LIMITS) -> np.ndarray:
    """(n,) bool: whether a joint travels anywhere in one of the motions."""
    logs = {
        motion.log_index: [other.q for other in signals if other.log_index == motion.log_index] for motion in signals
    }
    return np.max([np.ptp(np.concatenate(parts), axis=0) for parts in logs.values()], axis=0) > limits.least_travel


def at_rest(signals: Sequence[MotionSignals], limits: DecisionLimits = LIMITS) -> np.ndarray:
    """(S', n) bool, all motions in a row: whether a joint stands there for a while, or close by."""
    parts = []
    for motion, still in zip(signals, standing(signals, limits), strict=True):
        rate = 1 / float(np.median(np.diff(motion.time)))
        shortest, reach = max(int(limits.long_rest * rate), 1), int(limits.near_rest * rate)
        begins = _count(still, 0, shortest - 1) == shortest
        long = _count(begins, shortest - 1, 0) > 0
        parts.append((_count(long, reach, reach) > 0)[motion.kept])
    return np.concatenate(parts)


def _count(rows: np.ndarray, before: int, after: int) -> np.ndarray:
    """(S, n) how many of the rows (S, n) bool from so many `before` each to so many `after` it are set."""
    total = np.concatenate([np.zeros((1, rows.shape[1]), dtype=int), np.cumsum(rows, axis=0)])
    place = np.arange(len(rows))
    ends = np.minimum(place + after + 1, len(rows))
    return np.asarray(total[ends] - total[np.maximum(place - before, 0)])
