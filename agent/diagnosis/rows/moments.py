"""Second moments of rows, cell by cell: of a model's columns and residual, and of candidates with these."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import pairwise

import numpy as np

from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.standstill import StandstillWhitening

_AT_ONCE = 25  # numerical: candidates worked out together: what fits into memory that the C library keeps


class FitMoments:
    """Moments of the rows of a fit, which all fits to these rows share.

    rows[j] (S', p_j + 1): columns of the model's parameters parameter_index[j] of `parameters`, and the residual, of
    joint j; `cell_of_row` (S',), -1: guard; `whitening` of rows, and of candidates' blocks, before they are multiplied.
    `gram` (cells, p + 1, p + 1) are those of columns and residual, summed over joints, and `count` (cells,) the rows in
    them.
    """

    def __init__(
        self,
        rows: Sequence[np.ndarray],
        parameter_index: Sequence[np.ndarray],
        cell_of_row: np.ndarray,
        parameters: int,
        whitening: StandstillWhitening,
    ):
        self.cells = cells = int(cell_of_row.max()) + 1
        self._parameter_index, self._base, self._whitening = list(parameter_index), parameters, whitening
        order = np.argsort(cell_of_row, kind="stable")
        edges = np.searchsorted(cell_of_row[order], np.arange(cells + 1))
        self._order = order[edges[0] :]
        self._slices = [slice(a, b) for a, b in pairwise(edges - edges[0])]
        self._rows = [self._sorted(joint, block) for joint, block in enumerate(rows)]
        self.gram = np.zeros((cells, parameters + 1, parameters + 1))
        for block, index in zip(self._rows, self._parameter_index, strict=True):
            places = np.append(index, parameters)
            for number, part in enumerate(self._slices):
                self.gram[number][np.ix_(places, places)] += block[part].T @ block[part]
        self.count = np.array([part.stop - part.start for part in self._slices]) * len(rows)
        self._products: dict[Candidate, tuple[np.ndarray, np.ndarray]] = {}
        self._same_columns: FitMoments | None = None
        self._between: dict[tuple[Candidate, Candidate], np.ndarray] = {}

    def _sorted(self, joint: int, block: np.ndarray) -> np.ndarray:
        """Rows (S', k) whitened, and those of a cell together."""
        return self._whitening.whitened(joint, block)[self._order]

    def with_residual(self, rows: Sequence[np.ndarray]) -> FitMoments:
        """Of the same columns with another residual: what is known of the columns is not worked out again."""
        other = copy(self)
        other._rows = [self._sorted(joint, block) for joint, block in enumerate(rows)]
        other._products, other._same_columns, other.gram = {}, self, self.gram.copy()
        last = self._base
        other.gram[:, last, :] = other.gram[:, :, last] = 0.0
        for block, columns in zip(other._rows, self._parameter_index, strict=True):
            for number, part in enumerate(self._slices):
                side = block[part].T @ block[part, -1]
                other.gram[number, last, columns] += side[:-1]
                other.gram[number, columns, last] += side[:-1]
                other.gram[number, last, last] += side[-1]
        return other

    def of(self, candidates: Sequence[Candidate]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per candidate its moments (cells, p + 1, k) with columns and residual, and its own (cells, k, k); kept."""
        new = [c for c in candidates if c not in self._products]
        if self._same_columns is not None:
            pairs = zip(new, self._same_columns.of(new), strict=True)
            self._products.update({c: (self._with_this_residual(c, cross), squares) for c, (cross, squares) in pairs})
            new = []
        for first in range(0, len(new), _AT_ONCE):
            self._compute(new[first : first + _AT_ONCE])
        return [self._products[c] for c in candidates]

    def between(self, first: Candidate, others: Sequence[Candidate]) -> list[np.ndarray]:
        """Per candidate (cells, k, l): moments of the first with it; kept."""
        new = [c for c in others if (first, c) not in self._between]
        first_rows = {joint: self._sorted(joint, block) for joint, block in first.blocks.items()} if new else {}
        for second in new:
            total = np.zeros((self.cells, len(first.names), len(second.names)))
            for joint in first.blocks.keys() & second.blocks.keys():
                block = self._sorted(joint, second.blocks[joint])
                for cell, part in enumerate(self._slices):
                    total[cell] += first_rows[joint][part].T @ block[part]
            self._between[first, second] = total
        return [self._between[first, c] for c in others]

    def _with_this_residual(self, candidate: Candidate, cross: np.ndarray) -> np.ndarray:
        """Moments (cells, p + 1, k) with this residual, from those with another."""
        cross = cross.copy()
        cross[:, self._base] = 0.0
        for joint, block in candidate.blocks.items():
            columns = self._sorted(joint, block)
            for cell, part in enumerate(self._slices):
                cross[cell, self._base] += self._rows[joint][part, -1] @ columns[part]
        return cross

    def _compute(self, candidates: Sequence[Candidate]) -> None:
        cross = [np.zeros((self.cells, self._base + 1, len(c.names))) for c in candidates]
        squares = [np.zeros((self.cells, len(c.names), len(c.names))) for c in candidates]
        for joint, (block, index) in enumerate(zip(self._rows, self._parameter_index, strict=True)):
            on_joint = [k for k, c in enumerate(candidates) if joint in c.blocks]
            if not on_joint:
                continue
            places = np.append(index, self._base)
            together = self._sorted(joint, np.hstack([candidates[k].blocks[joint] for k in on_joint]))
            ends = np.cumsum([0, *(candidates[k].blocks[joint].shape[1] for k in on_joint)])
            for cell, part in enumerate(self._slices):
                product = block[part].T @ together[part]
                for k, (a, b) in zip(on_joint, pairwise(ends), strict=True):
                    cross[k][cell][places] += product[:, a:b]
                    squares[k][cell] += together[part, a:b].T @ together[part, a:b]
        self._products.update(zip(candidates, zip(cross, squares, strict=True), strict=True))
