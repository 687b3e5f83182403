"""Which rows are held out together: clusters for resampling, folds for cross-validation, guards between them.

Samples near in time are not independent, and cycles of one motion are copies of each other. So rows are cut by
where they are in a motion, all its cycles together: leaving such a segment out tells how a model does where it has not
been, which leaving a cycle out does not. With three motions or more the folds are whole motions, unless a joint slides
in one of them only: without it, the others say nothing of that joint's friction and gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.estimation.signals.observation import Segment

#: A joint slides above this part of its highest speed; less than that part of its sliding is none.
SLIDING_SHARE, SELDOM_SHARE = 0.05, 0.02
_CLUSTERS = 40  # enough to see the scatter of a fit, long enough to be independent
_SHORTEST = 6.0  # of a cluster, in periods of the cut-off
_GUARD = 2.0  # likewise
_FOLDS = 6  # at most


@dataclass(frozen=True, eq=False)
class Partition:
    """`labels[s]` (S',) gives each row of segment s its cell; a cell has one cluster, fold and guarded fold (-1: none).

    A row that guards fold k is near enough to it to know it: it is not trained on when k is held out.
    """

    labels: tuple[np.ndarray, ...]
    cluster: np.ndarray
    fold: np.ndarray
    guards: np.ndarray

    @property
    def folds(self) -> int:
        """Number of folds."""
        return int(self.fold.max()) + 1

    @property
    def clusters(self) -> int:
        """Number of clusters."""
        return int(self.cluster.max()) + 1

    @property
    def whole_motions(self) -> bool:
        """Whether folds are whole motions, as opposed to segments of them."""
        return bool(np.all(self.guards < 0))

    def training(self, fold: int) -> np.ndarray:
        """(cells,) bool: what may be fitted on when `fold` is held out."""
        return (self.fold != fold) & (self.guards != fold)


def partition(segments: Sequence[Segment]) -> Partition:
    """Cut filtered segments into cells."""
    logs = sorted({segment.log_index for segment in segments})
    parts = {1: 5, 2: 3}.get(len(logs), 1 if _slides_in_several(segments) else 3)
    spans = {index: _span([s for s in segments if s.log_index == index]) for index in logs}
    total = sum(length for _, length, _ in spans.values())
    period_of_cutoff = 1 / segments[0].motion.cutoff
    rows: list[np.ndarray] = []
    clusters_before = {}
    clusters = 0
    for index in logs:
        length = spans[index][1] / parts
        clusters_before[index] = (
            clusters,
            int(np.clip(min(_CLUSTERS * length / total, length / period_of_cutoff / _SHORTEST), 1, None)),
        )
        clusters += parts * clusters_before[index][1]
    for segment in segments:
        start, length, cycle = spans[segment.log_index]
        since = segment.time - start
        phase = np.clip((since if cycle is None else since % cycle) / length, 0, 1 - 1e-9) * parts
        part = phase.astype(int)
        position = logs.index(segment.log_index)
        fold = (position * parts) % _FOLDS + part
        width = _GUARD * period_of_cutoff / length * parts
        guards = np.full(len(phase), -1)
        after, before = (phase - part < width) & (part > 0), (phase - part > 1 - width) & (part < parts - 1)
        guards[after], guards[before] = fold[after] - 1, fold[before] + 1
        first, per_part = clusters_before[segment.log_index]
        rows.append(np.stack([first + (phase * per_part).astype(int), fold, guards], axis=1))
    cells, labels = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    cuts = np.cumsum([len(row) for row in rows])[:-1]
    return Partition(tuple(np.split(labels.ravel(), cuts)), cells[:, 0], cells[:, 1], cells[:, 2])


def _slides_in_several(segments: Sequence[Segment]) -> bool:
    """Whether no joint slides in one log only."""
    least = SLIDING_SHARE * np.max([np.abs(segment.speed).max(axis=0) for segment in segments], axis=0)
    rows = np.zeros((1 + max(segment.log_index for segment in segments), len(least)))
    for segment in segments:
        rows[segment.log_index] += np.sum(np.abs(segment.speed) > least, axis=0)
    return bool(np.all(rows.sum(axis=0) - rows.max(axis=0) >= SELDOM_SHARE * rows.sum(axis=0)))


def _span(segments: Sequence[Segment]) -> tuple[float, float, float | None]:
    """Start, length and period (None without cycles) of a log [s]."""
    start, end = float(segments[0].time[0]), float(segments[-1].time[-1])
    cycles = np.asarray(segments[0].motion.cycle_starts)
    if len(cycles) < 2:
        return start, max(end - start, 1e-9), None
    period = float(np.median(np.diff(cycles)))
    return float(cycles[0]), min(period, end - float(cycles[0])), period
