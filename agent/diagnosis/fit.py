"""Candidates fitted together with the model, and scored on motions left out, all from second moments.

Residuals r of the model are explained by a change δ of its parameters and by columns Z of effects:

    minimise Σ_j |r_j − X_j δ − Z_j β|² / (T σ_j²) + (δ − δ₀)ᵀ Λ (δ − δ₀)

with σ_j the model's own held-out error of joint j (the background; more at standstill, where stiction
leaves the torque open), Λ the inverse of the covariance
stored in the model, and T rows to one independent row. Moments are kept per cell of rows, so every fold is arithmetic
on small matrices. With H = Λ + XᵀX and the Schur complement S = ZᵀZ − ZᵀX H⁻¹ XᵀZ: β = S⁻¹ (Zᵀr − ZᵀX H⁻¹ Xᵀr).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from agent.model.effects import Effect
from agent.model.signals import MotionSignals, NominalModel

_INDEPENDENT = 0.1  # s between independent rows


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect somewhere, with nonlinear parameters chosen. `blocks`: joint → (S', k) over σ, all motions in a row."""

    effect: Effect
    joints: tuple[int, ...]
    settings: Mapping[str, float]
    names: tuple[str, ...]
    blocks: dict[int, np.ndarray]
    prior_std: np.ndarray | None
    reference: NominalModel

    @property
    def place(self) -> tuple[str, tuple[int, ...]]:
        """Effect and joints."""
        return self.effect.name, self.joints


@dataclass(frozen=True, eq=False)
class Score:
    """error: held-out Σ e² / σ² with the candidate; gain: how much less than without; values (k,) fitted to all."""

    candidate: Candidate
    error: float
    gain: float
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class Fold:
    """Cells held out and cells fitted on, (cells,) bool each."""

    name: str
    test: np.ndarray
    train: np.ndarray


class Fit:
    """The residual of a model on some logs, ready to try candidates on.

    rows[j] (S', p_j + 1): columns of the model's parameters index[j] and the residual of joint j, over `sigma` (S', n);
    `cell` (S',) of every row (-1: guard); `block` (S',) segment of the motion, the same in all of its cycles; `folds`
    for what repeats, `single` folds for what happens once.
    """

    def __init__(
        self,
        reference: NominalModel,
        signals: Sequence[MotionSignals],
        rows: Sequence[np.ndarray],
        index: Sequence[np.ndarray],
        sigma: np.ndarray,
        precision: np.ndarray,
        shift: np.ndarray,
        cell: np.ndarray,
        block: np.ndarray,
        folds: Sequence[Fold],
        single: Sequence[Fold],
        chosen: Sequence[Candidate] = (),
        shared: dict[str, Any] | None = None,
    ):
        self.reference, self.signals = reference, list(signals)
        self.rows, self.index = list(rows), list(index)
        self.sigma, self.precision, self.shift = sigma, precision, shift
        self.cell, self.block, self.folds, self.single = cell, block, list(folds), list(single)
        self.chosen = tuple(chosen)
        self._shared: dict[str, Any] = {} if shared is None else shared
        lengths = [len(range(*s.kept.indices(len(s.time)))) for s in self.signals]
        self.cuts = np.cumsum(lengths)[:-1]
        rate = 1 / float(np.median(np.diff(self.signals[0].time[self.signals[0].kept])))
        self.repeat = max(1.0, _INDEPENDENT * rate)
        self._extend()

    def _extend(self) -> None:
        """Moments of the model's columns, those of the effects chosen already, and the residual."""
        if not self._shared:
            self._shared.update(self._sorted())
        self.cells, self.count = self._shared["cells"], self._shared["count"]
        base = len(self.precision)
        ends = base + np.cumsum([0, *(len(c.names) for c in self.chosen)])
        self.size = size = int(ends[-1])
        keep = np.append(np.arange(base), size)
        self.gram = np.zeros((self.cells, size + 1, size + 1))
        self.gram[:, keep[:, None], keep] = self._shared["gram"]
        self.prior = np.zeros((size, size))
        self.prior[:base, :base] = self.precision
        spans = [slice(a, b) for a, b in pairwise(ends)]
        for number, (candidate, (cross, own)) in enumerate(self._base_moments(self.chosen)):
            span = spans[number]
            self.gram[:, keep, span] = cross
            self.gram[:, span, keep] = np.swapaxes(cross, 1, 2)
            self.gram[:, span, span] = own
            for other, other_span in zip(self.chosen[:number], spans[:number], strict=True):
                both = self._between(other, candidate)
                self.gram[:, other_span, span] = both
                self.gram[:, span, other_span] = np.swapaxes(both, 1, 2)
            diagonal = np.arange(span.start, span.stop)
            self.prior[diagonal, diagonal] = self.ridge(candidate, own.sum(axis=0).diagonal())
        self.pull = np.zeros(size)
        self.pull[:base] = self.shift
        self._solved: dict[int, tuple] = {}

    def _sorted(self) -> dict[str, Any]:
        """Rows in the order of their cells, and the moments of the model's columns: what all fits to them share."""
        cells = int(self.cell.max()) + 1
        order = np.argsort(self.cell, kind="stable")
        edges = np.searchsorted(self.cell[order], np.arange(cells + 1))
        order = order[edges[0] :]
        slices = [slice(a, b) for a, b in pairwise(edges - edges[0])]
        rows = [block[order] for block in self.rows]
        base = len(self.precision)
        gram = np.zeros((cells, base + 1, base + 1))
        for block, index in zip(rows, self.index, strict=True):
            place = np.append(index, base)
            for cell, part in enumerate(slices):
                gram[cell][np.ix_(place, place)] += block[part].T @ block[part]
        count = np.array([part.stop - part.start for part in slices]) * len(rows)
        shared = {"cells": cells, "order": order, "slices": slices, "rows": rows, "gram": gram, "count": count}
        return {**shared, "known": {}, "made": {}}

    def _between(self, first: Candidate, second: Candidate) -> np.ndarray:
        """(cells, k, l) moments of two candidates with each other."""
        total = np.zeros((self.cells, len(first.names), len(second.names)))
        order, slices = self._shared["order"], self._shared["slices"]
        for joint in first.blocks.keys() & second.blocks.keys():
            a, b = first.blocks[joint][order], second.blocks[joint][order]
            for cell, part in enumerate(slices):
                total[cell] += a[part].T @ b[part]
        return total

    def ridge(self, candidate: Candidate, energy: np.ndarray) -> np.ndarray:
        """(k,) prior precision of a candidate's parameters, from the energy (k,) of its columns."""
        weak = 1e-7 * energy / self.repeat + 1e-12
        return weak if candidate.prior_std is None else weak + 1 / candidate.prior_std**2

    def with_chosen(self, chosen: Sequence[Candidate]) -> Fit:
        """The same data with these effects as part of the model."""
        return Fit(
            self.reference, self.signals, self.rows, self.index, self.sigma, self.precision, self.shift,
            self.cell, self.block, self.folds, self.single, chosen, self._shared,
        )  # fmt: skip

    def with_prior(self, precision: np.ndarray) -> Fit:
        """The same data without effects, and with another prior precision (p, p) of the model's parameters."""
        return Fit(
            self.reference, self.signals, self.rows, self.index, self.sigma, precision, self.shift,
            self.cell, self.block, self.folds, self.single, (), self._shared,
        )  # fmt: skip

    @property
    def sigmas(self) -> list[np.ndarray]:
        """Per motion (S', n) [N·m]: the background."""
        return self._split(self.sigma)

    @property
    def given(self) -> bool:
        """Whether the model is of other data; one that was fitted to these is pulled by its prior."""
        return not np.any(self.shift)

    @property
    def near_rest(self) -> np.ndarray:
        """(S', n) bool: rows so near to a standstill of their joint that stiction may leave the torque open."""
        return self.sigma > 1.01 * self.sigma.min(axis=0)

    @property
    def residuals(self) -> list[np.ndarray]:
        """Per motion (S', n) [N·m]: what is left of the torque after a fit to all rows of model and chosen effects."""
        parameters = self.solve(np.ones(self.cells, dtype=bool))[1]
        return self._split(self.remaining(parameters))

    def remaining(self, parameters: np.ndarray) -> np.ndarray:
        """(S'total, n) [N·m] residual with parameters (size,) of model change and chosen effects."""
        base = len(self.precision)
        ends = base + np.cumsum([0, *(len(c.names) for c in self.chosen)])
        left = np.empty((len(self.cell), len(self.rows)))
        for joint, (rows, index) in enumerate(zip(self.rows, self.index, strict=True)):
            column = rows[:, -1] - rows[:, :-1] @ parameters[index]
            for candidate, (a, b) in zip(self.chosen, pairwise(ends), strict=True):
                if joint in candidate.blocks:
                    column = column - candidate.blocks[joint] @ parameters[a:b]
            left[:, joint] = column * self.sigma[:, joint]
        return left

    def _split(self, rows: np.ndarray) -> list[np.ndarray]:
        return np.split(rows, self.cuts)

    def solve(self, train: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of H and the parameters for training cells."""
        key = hash(train.tobytes())
        if key not in self._solved:
            total = self.gram[train].sum(axis=0) / self.repeat
            matrix = total[:-1, :-1] + self.prior
            scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
            inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
            self._solved[key] = inverse, inverse @ (total[:-1, -1] + self.pull)
        return self._solved[key]

    def out_of_fold(self, single: bool = False, taken_out: int | None = None) -> np.ndarray:
        """(S'total, n) [N·m] residual of every row under the fit that did not see it; NaN on guards.

        `taken_out`: that one of the chosen effects is set to zero after the fit.
        """
        ends = len(self.precision) + np.cumsum([0, *(len(c.names) for c in self.chosen)])
        result = np.full((len(self.cell), len(self.rows)), np.nan)
        for fold in self.single if single else self.folds:
            parameters = self.solve(fold.train)[1].copy()
            if taken_out is not None:
                parameters[ends[taken_out] : ends[taken_out + 1]] = 0
            test = np.isin(self.cell, np.flatnonzero(fold.test))
            result[test] = self.remaining(parameters)[test]
        return result

    def error(self, single: bool = False) -> float:
        """Held-out Σ e² / σ² of model and chosen effects."""
        total = 0.0
        for fold in self.single if single else self.folds:
            extended = np.append(self.solve(fold.train)[1], -1.0)
            total += float(extended @ self.gram[fold.test].sum(axis=0) @ extended)
        return total

    @property
    def values(self) -> list[np.ndarray]:
        """Per chosen effect (k,): its parameters fitted to all rows."""
        return self.fitted()[1]

    @property
    def change(self) -> np.ndarray:
        """(p,) change of the model's parameters, fitted to all rows together with the chosen effects."""
        return self.fitted()[0]

    def fitted(self, fold: Fold | None = None) -> tuple[np.ndarray, list[np.ndarray]]:
        """Change of the model's parameters (p,) and parameters of each chosen effect (k,): of all rows, or a fold's."""
        train = np.ones(self.cells, dtype=bool) if fold is None else fold.train
        change, effects = np.split(self.solve(train)[1], [len(self.precision)])
        ends = np.cumsum([len(c.names) for c in self.chosen])
        return change, np.split(effects, ends[:-1]) if len(ends) else []

    def candidate(self, effect: Effect, joints: tuple[int, ...], settings: Mapping[str, float]) -> Candidate:
        """Columns of an effect, filtered as the torque is."""
        return self.candidates([(effect, joints, settings)])[0]

    def candidates(self, wanted: Sequence[tuple[Effect, tuple[int, ...], Mapping[str, float]]]) -> list[Candidate]:
        """Columns of several effects at once; those asked for before are remembered."""
        keys = [(effect, joints, tuple(settings.items())) for effect, joints, settings in wanted]
        made = self._shared["made"]
        new = {key: entry for key, entry in zip(keys, wanted, strict=True) if key not in made}
        if new:
            made.update(zip(new, self._make(list(new.values())), strict=True))
        return [made[key] for key in keys]

    def _make(self, wanted: Sequence[tuple[Effect, tuple[int, ...], Mapping[str, float]]]) -> list[Candidate]:
        parts: list[dict[int, list[np.ndarray]]] = [{} for _ in wanted]
        for kind in {effect for effect, *_ in wanted}:
            kind.prepare(self.signals, [(joints, settings) for effect, joints, settings in wanted if effect is kind])
        for signals, sigma in zip(self.signals, self.sigmas, strict=True):
            pending: list[tuple[int, int, np.ndarray]] = []
            for number, (effect, joints, settings) in enumerate(wanted):
                for joint, block in effect.columns(signals, joints, settings).items():
                    pending.append((number, joint, block))
            for first in range(0, len(pending), 64):
                some = pending[first : first + 64]
                filtered = signals.low_pass(np.hstack([block for *_, block in some]))
                ends = np.cumsum([block.shape[1] for *_, block in some])[:-1]
                for (number, joint, _), block in zip(some, np.split(filtered, ends, axis=1), strict=True):
                    parts[number].setdefault(joint, []).append(block / sigma[:, joint, None])
        result = []
        for (effect, joints, settings), found in zip(wanted, parts, strict=True):
            blocks = {joint: np.concatenate(block) for joint, block in found.items()}
            prior_std = effect.prior_std(self, joints, settings)
            result.append(
                Candidate(effect, joints, dict(settings), effect.names(settings), blocks, prior_std, self.reference)
            )
        return result

    def fit(self, effect: Effect, joints: tuple[int, ...], settings: Mapping[str, float]) -> np.ndarray:
        """(k,) parameters fitted to all the data together with the model, under its prior."""
        return self.score([self.candidate(effect, joints, settings)])[0].values

    def gains_alone(self, joint: int, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) Σ e² / σ² that each column (S', K) [N·m] on one joint would take away, and its factor (K,).

        Model and chosen effects adapt; all rows are fitted and none held out, so this only picks what to try.
        """
        inverse, alone = self.solve(np.ones(self.cells, dtype=bool))
        block = columns / self.sigma[:, joint, None]
        rows = self.rows[joint]
        cross = np.zeros((self.size, block.shape[1]))
        cross[self.index[joint]] = rows[:, :-1].T @ block
        at = len(self.precision)
        for candidate in self.chosen:
            if joint in candidate.blocks:
                cross[at : at + len(candidate.names)] = candidate.blocks[joint].T @ block
            at += len(candidate.names)
        side = (block.T @ rows[:, -1] - cross.T @ alone) / self.repeat
        energy = np.sum(block**2, axis=0) / self.repeat
        schur = energy - np.sum(cross * (inverse @ cross), axis=0) / self.repeat**2
        schur = np.maximum(schur, 1e-6 * energy + 1e-12)
        return side**2 / schur * self.repeat, side / schur

    def score(self, candidates: Sequence[Candidate]) -> list[Score]:
        """Held-out score of each candidate added to the model and the chosen effects."""
        return [self._score(candidate, *moments) for candidate, moments in self.moments(candidates)]

    def moments(self, candidates: Sequence[Candidate]) -> Iterator[tuple[Candidate, tuple[np.ndarray, np.ndarray]]]:
        """Per candidate: moments (cells, size + 1, k) with model, chosen effects and residual, and its own."""
        base = len(self.precision)
        for candidate, (cross, own) in self._base_moments(candidates):
            if self.chosen:
                with_chosen = [self._between(other, candidate) for other in self.chosen]
                cross = np.concatenate([cross[:, :base], *with_chosen, cross[:, base:]], axis=1)
            yield candidate, (cross, own)

    def _base_moments(self, candidates: Sequence[Candidate]) -> list[tuple[Candidate, tuple[np.ndarray, np.ndarray]]]:
        """The same with model and residual only: (cells, base + 1, k), remembered for every candidate."""
        known = self._shared["known"]
        new = [c for c in candidates if c not in known]
        for first in range(0, len(new), 100):
            self._work_out(new[first : first + 100])
        return [(c, known[c]) for c in candidates]

    def _work_out(self, some: Sequence[Candidate]) -> None:
        order, slices, base = self._shared["order"], self._shared["slices"], len(self.precision)
        cross = [np.zeros((self.cells, base + 1, len(c.names))) for c in some]
        own = [np.zeros((self.cells, len(c.names), len(c.names))) for c in some]
        for joint, (block, index) in enumerate(zip(self._shared["rows"], self.index, strict=True)):
            here = [k for k, c in enumerate(some) if joint in c.blocks]
            if not here:
                continue
            place = np.append(index, base)
            together = np.hstack([some[k].blocks[joint] for k in here])[order]
            ends = np.cumsum([0, *(some[k].blocks[joint].shape[1] for k in here)])
            for cell, part in enumerate(slices):
                product = block[part].T @ together[part]
                for k, (a, b) in zip(here, pairwise(ends), strict=True):
                    cross[k][cell][place] += product[:, a:b]
                    own[k][cell] += together[part, a:b].T @ together[part, a:b]
        self._shared["known"].update(zip(some, zip(cross, own, strict=True), strict=True))

    def _score(self, candidate: Candidate, cross: np.ndarray, own: np.ndarray) -> Score:
        single = candidate.effect.once or any(c.effect.once for c in self.chosen)
        energy = own.sum(axis=0).diagonal()
        if not np.all(np.isfinite(energy)) or np.all(energy <= 1e-9):
            return Score(candidate, self.error(single), 0.0, np.zeros(len(candidate.names)))
        ridge = np.diag(self.ridge(candidate, np.maximum(energy, 1e-9)))
        total = 0.0
        for fold in self.single if single else self.folds:
            change, values = self._both(fold.train, cross, own, ridge)
            extended = np.append(change, -1.0)
            b, a = cross[fold.test].sum(axis=0), own[fold.test].sum(axis=0)
            total += float(extended @ self.gram[fold.test].sum(axis=0) @ extended)
            total += float(2 * extended @ b @ values + values @ a @ values)
        _, values = self._both(np.ones(self.cells, dtype=bool), cross, own, ridge)
        return Score(candidate, total, self.error(single) - total, values)

    def _both(
        self, train: np.ndarray, cross: np.ndarray, own: np.ndarray, ridge: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        inverse, alone = self.solve(train)
        b = cross[train].sum(axis=0) / self.repeat
        a = own[train].sum(axis=0) / self.repeat + ridge
        reach = inverse @ b[:-1]
        schur = a - b[:-1].T @ reach
        scale = 1 / np.sqrt(np.maximum(np.diag(a), 1e-300))
        side = scale * (b[-1] - b[:-1].T @ alone)
        values = scale * np.linalg.solve(schur * np.outer(scale, scale) + 1e-9 * np.eye(len(a)), side)
        return alone - reach @ values, values

    def practical(self, candidate: Candidate) -> np.ndarray:
        """(k,) parameters at which the effect has its practical size and the model can follow it least."""
        from scipy.linalg import eigh

        (_, (cross, own)), *_ = self.moments([candidate])
        b, a = cross.sum(axis=0)[:-1] / self.repeat, own.sum(axis=0) / self.repeat
        schur = a - b.T @ self.solve(np.ones(self.cells, dtype=bool))[0] @ b
        torque = np.zeros_like(a)
        for joint, block in candidate.blocks.items():
            part = block * (self.sigma[:, joint, None] / self.reference.scale[joint])
            torque += part.T @ part / len(part)
        size = np.sqrt(np.maximum(np.diag(torque), 1e-300))
        scaled = torque / np.outer(size, size) + 1e-9 * np.eye(len(size))
        vector = eigh(schur / np.outer(size, size), scaled)[1][:, -1]
        return candidate.effect.practical * vector / np.sqrt(vector @ scaled @ vector) / size
