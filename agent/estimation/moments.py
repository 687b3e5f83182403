"""Second moments of regressor and torque: all that weighting, cross-validation and resampling need of the data.

For Z = [X y], the sums Zᵀ Z are additive over rows: fitting without a fold, under other weights or with fewer columns
is arithmetic on small matrices, whatever the length of the logs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from agent.estimation.blocks import Partition
from agent.estimation.observation import Observation
from agent.model import FrictionTerm, standstill_speed

_SURELY_SLIDES = 0.005  # of the highest speed: more than where a diagnosis leaves the torque open

Cells = np.ndarray | slice
ALL_CELLS = slice(None)


@dataclass(frozen=True, eq=False)
class Moments:
    """Of p parameters on n joints. Weights and energies are (2, n): a joint's rows while it moves, then at standstill.

    index[i] (c_i,): which parameters act on joint i; sums[i] (cells, 2, c_i + 1, c_i + 1): Zᵀ Z of its rows;
    rows (cells, 2, n): their number.
    """

    parameters: int
    index: tuple[np.ndarray, ...]
    sums: tuple[np.ndarray, ...]
    rows: np.ndarray
    _totals: dict[tuple[int, bytes], np.ndarray] = field(default_factory=dict)

    def weighted(self, weights: np.ndarray, cells: Cells = ALL_CELLS) -> np.ndarray:
        """(p + 1, p + 1): sum over cells and rows, the last row and column are the torque's."""
        total = np.zeros((self.parameters + 1, self.parameters + 1))
        for joint, index in enumerate(self.index):
            place = np.append(index, self.parameters)
            moving, still = self._over(joint, cells)
            total[place[:, None], place] += weights[0, joint] * moving + weights[1, joint] * still
        return total

    def _over(self, joint: int, cells: Cells) -> np.ndarray:
        """(2, c_i + 1, c_i + 1) sum over cells; the same few sums are asked for again and again."""
        key = joint, b"" if isinstance(cells, slice) else cells.tobytes()
        if key not in self._totals:
            self._totals[key] = self.sums[joint][cells].sum(axis=0)
        return self._totals[key]

    def energy(self, parameters: np.ndarray, cells: Cells = ALL_CELLS) -> np.ndarray:
        """(2, n) squared residual left by parameters (p,), not below the round-off of this difference."""
        energy = np.empty((2, len(self.index)))
        for joint, index in enumerate(self.index):
            extended = np.append(parameters[index], -1.0)
            total = self._over(joint, cells)
            energy[:, joint] = np.maximum(total @ extended @ extended, 1e-15 * total[:, -1, -1])
        return energy

    def torque_energy(self) -> np.ndarray:
        """(2, n) squared measured torque."""
        return np.stack([self._over(joint, ALL_CELLS)[:, -1, -1] for joint in range(len(self.sums))], axis=1)

    def select(self, chosen: np.ndarray) -> Moments:
        """The moments of some of the parameters, in the order given."""
        position = np.full(self.parameters, -1)
        position[chosen] = np.arange(len(chosen))
        index, sums, places = [], [], []
        for old, old_sums in zip(self.index, self.sums, strict=True):
            keep = np.flatnonzero(position[old] >= 0)
            keep = keep[np.argsort(position[old[keep]])]
            place = np.append(keep, len(old))
            index.append(position[old[keep]])
            places.append((slice(None), place[:, None], place))
            sums.append(old_sums[:, *places[-1]])
        known = {(joint, cells): total[places[joint]] for (joint, cells), total in self._totals.items()}
        return Moments(len(chosen), tuple(index), tuple(sums), self.rows, known)


def collect(
    observation: Observation,
    partition: Partition,
    terms: tuple[FrictionTerm, ...],
    friction: Iterable[np.ndarray],
    trusted: Sequence[np.ndarray] | None = None,
) -> Moments:
    """Moments of the base parameters and these terms, whose columns `friction` (S', T) gives segment by segment.

    `trusted`, per segment (S', n), weights single rows between 0 and 1.
    """
    n = observation.robot.dof
    cells = len(partition.cluster)
    index: list[np.ndarray] = []
    sums: list[np.ndarray] = []
    rows = np.zeros((cells, 2, n), dtype=int)
    still = standstill(observation)
    for number, (segment, columns) in enumerate(zip(observation.segments, friction, strict=True)):
        labels, stopped = partition.labels[number], still[number]
        for joint, (acting, block) in enumerate(observation.joint_rows(segment, terms, columns)):
            if len(sums) == joint:
                index.append(acting)
                sums.append(np.zeros((cells, 2, block.shape[1], block.shape[1])))
            if trusted is not None:
                block *= np.sqrt(trusted[number][:, joint, None])
            keys = 2 * labels + stopped[:, joint]
            edges = [0, *(np.flatnonzero(np.diff(keys)) + 1).tolist(), len(keys)]
            for first, stop in pairwise(edges):
                cell, group = divmod(int(keys[first]), 2)
                sums[joint][cell, group] += block[first:stop].T @ block[first:stop]
                rows[cell, group, joint] += stop - first
    return Moments(observation.rigid.count + len(terms), tuple(index), tuple(sums), rows)


def standstill(observation: Observation) -> list[np.ndarray]:
    """Per segment (S', n) bool: where a joint stands still, so that its friction is anything within stiction."""
    slowest = observed_standstill_speed(observation)
    return [np.abs(segment.speed) <= slowest for segment in observation.segments]


def observed_standstill_speed(observation: Observation) -> np.ndarray:
    """(n,) [rad/s] up to which a joint counts as standing still: what friction is fitted to surely slides."""
    speeds = [segment.speed for segment in observation.segments]
    return standstill_speed(speeds, observation.robot.max_velocity, _SURELY_SLIDES)
