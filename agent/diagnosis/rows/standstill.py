"""Stretches where joints are stationary: stiction holds them, and the torque is anything below the Coulomb level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.model import MotionSignals, NominalModel, standstill_speed


def stationary_samples(signals: Sequence[MotionSignals], others: Sequence[MotionSignals] = ()) -> list[np.ndarray]:
    """Per motion (S, n) bool: whether a joint is stationary. A joint that never travels always is, whatever its noise.

    It is where it reverses, too: a fast reversal may pass the speed threshold between two rows. `others` are other
    motions of the same arm: the threshold depends on the joint's highest speed in all motions.
    """
    all_motions = [*others, *signals]
    slowest = standstill_speed([motion.qd for motion in all_motions], all_motions[0].reference.robot.max_velocity)
    slowest = np.where(travelling_joints(all_motions), slowest, np.inf)
    return [(np.abs(motion.qd) <= slowest) | _reverses(motion.qd) for motion in signals]


def _reverses(speed: np.ndarray) -> np.ndarray:
    """(S, n) bool: rows next to a change of sign."""
    turned = speed[1:] * speed[:-1] < 0
    nowhere = np.zeros_like(turned[:1])
    return np.asarray(np.concatenate([turned, nowhere]) | np.concatenate([nowhere, turned]))


def travelling_joints(signals: Sequence[MotionSignals]) -> np.ndarray:
    """(n,) bool: whether a joint travels anywhere in one of the motions."""
    logs = {
        motion.log_index: [other.q for other in signals if other.log_index == motion.log_index] for motion in signals
    }
    return np.max([np.ptp(np.concatenate(parts), axis=0) for parts in logs.values()], axis=0) > LIMITS.least_travel


def standstill_rows(signals: Sequence[MotionSignals]) -> np.ndarray:
    """(S', n) bool, all motions in a row: whether a joint stands there for a while, or close by."""
    parts = []
    for motion, still in zip(signals, stationary_samples(signals), strict=True):
        rate = 1 / float(np.median(np.diff(motion.time)))
        shortest, reach = max(int(LIMITS.row_correlation_time * rate), 1), int(0.5 * LIMITS.row_correlation_time * rate)
        begins = _count(still, 0, shortest - 1) == shortest
        long = _count(begins, shortest - 1, 0) > 0
        parts.append((_count(long, reach, reach) > 0)[motion.kept])
    return np.concatenate(parts)


def noise_level(
    reference: NominalModel,
    moving: np.ndarray,
    signals: Sequence[MotionSignals],
    others: Sequence[MotionSignals] = (),
) -> np.ndarray:
    """Model error (S', n) [N·m]: the held-out error (n,), and more close to a standstill.

    At a standstill, stiction allows any torque below the Coulomb level. The torque's filter shows a part of that: the
    part of its window in which the joint is stationary, which is small where it reverses at once.

    Args:
        reference: model whose Coulomb levels count.
        moving: (n,) held-out error of moving joints [N·m].
        signals: filtered motions, whose rows are returned.
        others: motions of the same arm, as for `stationary_samples`.
    """
    still = np.maximum(LIMITS.stiction * stiction(reference), 2 * moving)
    parts = [
        np.clip(motion.low_pass(resting.astype(float)), 0.0, 1.0)
        for motion, resting in zip(signals, stationary_samples(signals, others), strict=True)
    ]
    return np.hypot(moving, still * np.concatenate(parts))


def stiction(reference: NominalModel) -> np.ndarray:
    """Coulomb level (n,) [N·m]: bound of the torque of a stationary joint in either direction."""
    model, level = reference.model, np.zeros(reference.robot.dof)
    for k, term in enumerate(model.terms):
        if term.form == "coulomb":
            level[term.axle] = abs(model.values[len(model.independent) + k])
    return level @ np.abs(reference.coupling)


@dataclass(frozen=True, eq=False)
class StandstillWhitening:
    """Where each joint stands for a while: stiction is one unknown torque all through such a stretch.

    With an error of covariance σ² (I + 1 1ᵀ) over the N independent rows of a stretch, as large a constant as what
    differs from row to row, rows are whitened by taking off 1 − 1 / √(1 + N) of their mean (a random intercept: Laird
    and Ware, Biometrics 38, 1982). So a rest of any length says as much about a constant torque as one row,
    and everything about changes during it.

    `stretches`: per joint its (first row, row after the last, N).
    """

    stretches: tuple[tuple[tuple[int, int, float], ...], ...]

    @classmethod
    def of(cls, signals: Sequence[MotionSignals], repeat: float) -> StandstillWhitening:
        """Of some motions in a row, `repeat` rows of which are an independent one."""
        still = standstill_rows(signals)
        ends = np.cumsum([len(motion.time[motion.kept]) for motion in signals])
        stretches_per_joint = []
        for column in still.T:
            number = np.where(column, np.searchsorted(ends, np.arange(len(column)), side="right"), -1)
            edges = np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1, [len(number)]])
            spans = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
            stretches_per_joint.append(tuple((a, b, (b - a) / repeat) for a, b in spans if a < b and column[a]))
        return cls(tuple(stretches_per_joint))

    def whitened(self, joint: int, block: np.ndarray) -> np.ndarray:
        """Whitened rows (S', k) of a joint, which are divided by the noise level."""
        if not self.stretches[joint]:
            return block
        rows, starts, lengths, share = self._at[joint]
        inside = block[rows]
        part = share.reshape(-1, *[1] * (block.ndim - 1)) * np.add.reduceat(inside, starts, axis=0)
        block = block.copy()
        block[rows] = inside - np.repeat(part, lengths, axis=0)
        return block

    @cached_property
    def _at(self) -> list[tuple[np.ndarray, ...]]:
        """Per joint the rows of all stretches, where each begins among these, its length, and what is taken off of its
        sum."""
        parts: list[tuple[np.ndarray, ...]] = []
        for stretches in self.stretches:
            lengths = np.array([after - first for first, after, _ in stretches], dtype=int)
            rows = np.concatenate(
                [np.arange(first, after) for first, after, _ in stretches] or [np.empty(0, dtype=int)]
            )
            count = np.array([count for *_, count in stretches])
            parts.append((rows, np.cumsum(lengths) - lengths, lengths, (1 - 1 / np.sqrt(1 + count)) / lengths))
        return parts

    def inside(self, count: int) -> np.ndarray:
        """(S', n) bool, of S' = `count` rows: which are in a rest of a joint; one that never moves has no others."""
        inside = np.zeros((count, len(self.stretches)), dtype=bool)
        for joint, (rows, *_) in enumerate(self._at):
            inside[rows, joint] = True
        return inside


def _count(rows: np.ndarray, before: int, after: int) -> np.ndarray:
    """Count (S, n) of set rows (S, n) bool, from `before` rows before each row to `after` rows after it."""
    total = np.concatenate([np.zeros((1, rows.shape[1]), dtype=int), np.cumsum(rows, axis=0)])
    place = np.arange(len(rows))
    ends = np.minimum(place + after + 1, len(rows))
    return np.asarray(total[ends] - total[np.maximum(place - before, 0)])
