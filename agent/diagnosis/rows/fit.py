"""Effects fitted together with the model, and judged on motions left out, all from second moments.

Residuals r of the model are explained by a change δ of its parameters and by columns Z of effects:

    minimise Σ_j |r_j − X_j δ − Z_j β|² / (T σ_j²) + (δ − δ₀)ᵀ Λ (δ − δ₀)

with σ_j the noise level, Λ the inverse of the covariance stored in the model, and T rows to one independent row. The
noise level is the model's own held-out error of joint j. It is larger at standstill, where stiction leaves the torque
open; these rows are whitened (`StandstillWhitening`). Moments are kept per cell of rows, so every fold is arithmetic
on small matrices. With H = Λ + XᵀX and the Schur complement S = ZᵀZ − ZᵀX H⁻¹ XᵀZ: β = S⁻¹ (Zᵀr − ZᵀX H⁻¹ Xᵀr).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate, Fold, Wanted, make_candidates, parameter_ends
from agent.diagnosis.rows.moments import FitMoments
from agent.diagnosis.rows.standstill import StandstillWhitening, noise_level
from agent.model import Effect, MotionSignals, NominalModel


@dataclass(frozen=True, eq=False)
class FitRows:
    """Rows of a model's columns and residual on some logs, and how they are split.

    rows[j] (S', p_j + 1): columns of the model's parameters parameter_index[j] and the residual of joint j, over
    `sigma` (S', n); `precision` (p, p) and `prior_information` (p,) of the parameters; `cell_of_row` (S',), -1: guard;
    `segment_of_row` (S',) of the motion, the same in all of its cycles; `folds` for what repeats, `segment_folds` for
    what happens once; `whitening` is that of the motions unless it is given.
    """

    reference: NominalModel
    signals: Sequence[MotionSignals]
    rows: Sequence[np.ndarray]
    parameter_index: Sequence[np.ndarray]
    sigma: np.ndarray
    precision: np.ndarray
    prior_information: np.ndarray
    cell_of_row: np.ndarray
    segment_of_row: np.ndarray
    folds: Sequence[Fold] = ()
    segment_folds: Sequence[Fold] = ()
    whitening: StandstillWhitening | None = None


#: Candidates that were made, by effect, joints and nonlinear parameters.
_Made = dict[tuple[Effect, tuple[int, ...], tuple[tuple[str, float], ...]], Candidate]


class Fit:
    """The residual of a model on some logs, ready to try candidates on.

    Parameters
    ----------
    data : FitRows
        Whose fields are attributes of the fit too.
    chosen : sequence of Candidate, optional
        Effects that are part of the model; `spans` are their parameters, behind the model's.
    moments : FitMoments, optional
        Those of the rows, where they are known.
    made : dict, optional
        Candidates that were made on these rows.
    """

    def __init__(
        self,
        data: FitRows,
        chosen: Sequence[Candidate] = (),
        moments: FitMoments | None = None,
        made: _Made | None = None,
    ):
        self.reference, self.signals = data.reference, data.signals
        self.rows, self.parameter_index = data.rows, data.parameter_index
        self.sigma, self.precision, self.prior_information = data.sigma, data.precision, data.prior_information
        self.cell_of_row, self.segment_of_row = data.cell_of_row, data.segment_of_row
        self.folds, self.segment_folds = data.folds, data.segment_folds
        lengths = [len(range(*s.kept.indices(len(s.time)))) for s in self.signals]
        self.cuts = np.cumsum(lengths)[:-1]
        rate = 1 / float(np.median(np.diff(self.signals[0].time[self.signals[0].kept])))
        self.rows_per_independent = max(1.0, LIMITS.row_correlation_time * rate)
        self.whitening = data.whitening or StandstillWhitening.of(self.signals, self.rows_per_independent)
        self.data = replace(data, whitening=self.whitening)
        self._moments = moments or FitMoments(
            self.rows, self.parameter_index, self.cell_of_row, len(self.precision), self.whitening
        )
        self.cells, self.count = self._moments.cells, self._moments.count
        self._made: _Made = {} if made is None else made
        self.chosen = tuple(chosen)
        self._extend()

    def _extend(self) -> None:
        """Moments of the model's columns, those of the effects chosen already, and the residual."""
        base = len(self.precision)
        ends = parameter_ends(base, self.chosen)
        self.spans = tuple(slice(a, b) for a, b in pairwise(ends.tolist()))
        self.size = size = int(ends[-1])
        keep = np.append(np.arange(base), size)
        self.gram = np.zeros((self.cells, size + 1, size + 1))
        self.gram[:, keep[:, None], keep] = self._moments.gram
        self.prior = np.zeros((size, size))
        self.prior[:base, :base] = self.precision
        moments = self._moments.of(self.chosen)
        for number, (candidate, span, (cross, squares)) in enumerate(
            zip(self.chosen, self.spans, moments, strict=True)
        ):
            self.gram[:, keep, span] = cross
            self.gram[:, span, keep] = np.swapaxes(cross, 1, 2)
            self.gram[:, span, span] = squares
            for other, other_span in zip(self.chosen[:number], self.spans[:number], strict=True):
                (between,) = self._moments.between(other, [candidate])
                self.gram[:, other_span, span] = between
                self.gram[:, span, other_span] = np.swapaxes(between, 1, 2)
            self.prior[span, span] = self.ridge(candidate, squares.sum(axis=0).diagonal())
        self._padded_information = np.zeros(size)
        self._padded_information[:base] = self.prior_information
        self._solved: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._held_out: dict[int | None, np.ndarray] = {}
        self._error: float | None = None
        self._fitted: np.ndarray | None = None

    def ridge(self, candidate: Candidate, energy: np.ndarray) -> np.ndarray:
        """(k, k) prior precision of a candidate's parameters, from the energy (k,) of its columns."""
        weak = np.diag(1e-7 * energy / self.rows_per_independent + 1e-12)
        return weak if candidate.prior is None else weak + candidate.prior

    def with_chosen(self, chosen: Sequence[Candidate] = ()) -> Fit:
        """The same data with these effects as part of the model."""
        return Fit(self.data, chosen, self._moments, self._made)

    def with_prior(self, precision: np.ndarray, prior_information: np.ndarray | None = None) -> Fit:
        """The same data without effects, and with another prior precision (p, p) of the model's parameters.

        `prior_information` (p,) is that precision times the mean of the prior; as it was unless it is given.
        """
        information = self.prior_information if prior_information is None else prior_information
        data = replace(self.data, precision=precision, prior_information=information)
        return Fit(data, (), self._moments, self._made)

    def along(self, directions: np.ndarray) -> Fit:
        """The same rows without effects, of a model whose parameters move along `directions` (p, k) alone, by N(0, 1).

        It is as good as a prior covariance of `directions` times their transpose, and takes less time.
        """
        k = directions.shape[1]
        moved = [
            np.column_stack([rows[:, :-1] @ directions[index], rows[:, -1]])
            for rows, index in zip(self.rows, self.parameter_index, strict=True)
        ]
        data = replace(self.data, rows=moved, parameter_index=[np.arange(k)] * len(moved))
        return Fit(replace(data, precision=np.eye(k), prior_information=np.zeros(k)), (), None, self._made)

    def with_residual(self, residual: np.ndarray) -> Fit:
        """The same motions without effects, and with another residual (S', n) over `sigma`; candidates are kept."""
        rows = [np.column_stack([rows[:, :-1], column]) for rows, column in zip(self.rows, residual.T, strict=True)]
        return Fit(replace(self.data, rows=rows), (), self._moments.with_residual(rows), self._made)

    def with_noise(self, moving: np.ndarray) -> Fit:
        """The same rows without effects, of a model that errs by (n,) [N·m] in motion."""
        sigma = noise_level(self.reference, moving, self.signals)
        rows = [rows * (self.sigma / sigma)[:, [joint]] for joint, rows in enumerate(self.rows)]
        return Fit(replace(self.data, rows=rows, sigma=sigma))

    @property
    def usual_error(self) -> np.ndarray:
        """(n,) [N·m, or rad or m] largest error in motion that is the model's own, or that of a right file."""
        return np.asarray(LIMITS.usual_error * self.sigma.min(axis=0))

    def error_ratio(self, error: np.ndarray) -> np.ndarray:
        """(n,) an error (n,) [N·m] over the model's own in motion."""
        return np.asarray(error / self.sigma.min(axis=0))

    def beyond_usual(self, error: np.ndarray) -> np.ndarray:
        """(n,) bool: where an error (n,) [N·m] is more than a healthy arm's usual one."""
        return np.asarray(error >= self.usual_error)

    def beyond_chance(self, error: np.ndarray) -> np.ndarray:
        """(n,) bool: where an error (n,) [N·m] is no chance, whatever explains it."""
        return np.asarray(error >= LIMITS.significant_deviations * self.sigma.min(axis=0))

    def with_reference(self, reference: NominalModel) -> Fit:
        """The same data without effects, whose columns are then made at other numbers of the model."""
        loads = [signals.reference.payload for signals in self.signals]
        references = [reference if load is None else NominalModel(reference.model, load) for load in loads]
        signals = [replace(of_motion, reference=new) for of_motion, new in zip(self.signals, references, strict=True)]
        return Fit(replace(self.data, reference=reference, signals=signals), (), self._moments)

    def rows_of(self, number: int) -> slice:
        """Rows of a log."""
        motions = [k for k, signals in enumerate(self.signals) if signals.log_index == number]
        ends = np.concatenate([[0], self.cuts, [len(self.cell_of_row)]])
        return slice(int(ends[motions[0]]), int(ends[motions[-1] + 1]))

    def of_log(self, number: int, precision: np.ndarray) -> Fit:
        """One log alone, without effects, and with another prior precision (p, p) of the model's parameters."""
        rows = self.rows_of(number)
        one_log = replace(
            self.data,
            signals=[signals for signals in self.signals if signals.log_index == number],
            rows=[block[rows] for block in self.rows],
            sigma=self.sigma[rows],
            precision=precision,
            prior_information=np.zeros(len(precision)),
            cell_of_row=np.zeros(len(self.sigma[rows]), dtype=int),
            segment_of_row=self.segment_of_row[rows],
            folds=(),
            segment_folds=(),
            whitening=None,
        )
        return Fit(one_log)

    @property
    def sigmas(self) -> list[np.ndarray]:
        """Noise level per motion (S', n) [N·m]."""
        return np.split(self.sigma, self.cuts)

    @property
    def keeps_parameters(self) -> bool:
        """Whether the model's parameters are drawn to what they are; of a model of these logs, to its prior.

        So it says whether the model is of other data, as `Dataset.has_reference`, but for a model that is refitted in
        every fold: that one was given, and its parameters are free.
        """
        return not np.any(self.prior_information)

    @property
    def has_own_error(self) -> bool:
        """Whether the model errs by itself, and its friction from day to day: it was fitted to other logs."""
        return self.keeps_parameters and not self.reference.model.of_file

    @property
    def transient(self) -> bool:
        """Whether a chosen effect happens once, so that only `segment_folds` can judge it."""
        return any(c.transient for c in self.chosen)

    @property
    def test_folds(self) -> Sequence[Fold]:
        """Folds that judge the chosen effects: of motions, or of segments where one happens once."""
        return self.segment_folds if self.transient else self.folds

    @property
    def near_rest(self) -> np.ndarray:
        """(S', n) bool: rows so near to a standstill that stiction leaves more open than the model's error."""
        return (self.sigma > np.sqrt(2) * self.sigma.min(axis=0)) | self.whitening.inside(len(self.sigma))

    @property
    def residuals(self) -> list[np.ndarray]:
        """Torque (S', n) [N·m] per motion that remains after a fit of model and chosen effects to all rows."""
        if self._fitted is None:
            self._fitted = self.remaining(self.solve(np.ones(self.cells, dtype=bool))[1])
            self._fitted.flags.writeable = False
        return np.split(self._fitted, self.cuts)

    @property
    def residuals_as_given(self) -> list[np.ndarray]:
        """The same, but a model of other data stays unchanged: a push is not spread over the whole motion."""
        if not self.keeps_parameters:
            return self.residuals
        parameters = self.solve(np.ones(self.cells, dtype=bool))[1].copy()
        parameters[: len(self.precision)] = 0
        return np.split(self.remaining(parameters), self.cuts)

    def remaining(self, parameters: np.ndarray) -> np.ndarray:
        """(S'total, n) [N·m] residual with parameters (size,) of model change and chosen effects."""
        residual = np.empty((len(self.cell_of_row), len(self.rows)))
        for joint, (rows, index) in enumerate(zip(self.rows, self.parameter_index, strict=True)):
            column = rows[:, -1] - rows[:, :-1] @ parameters[index]
            for candidate, span in zip(self.chosen, self.spans, strict=True):
                if joint in candidate.blocks:
                    column = column - candidate.blocks[joint] @ parameters[span]
            residual[:, joint] = column * self.sigma[:, joint]
        return residual

    def solve(self, train: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of H and the parameters for training cells."""
        key = hash(train.tobytes())
        if key not in self._solved:
            total = self.gram[train].sum(axis=0) / self.rows_per_independent
            matrix = total[:-1, :-1] + self.prior
            scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
            inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
            self._solved[key] = inverse, inverse @ (total[:-1, -1] + self._padded_information)
        return self._solved[key]

    def held_out(self, without: int | None = None) -> np.ndarray:
        """(S'total, n) [N·m] residual of every row under the fit that did not see it; NaN on guards.

        `without`: that one of the chosen effects is set to zero after the fit.
        """
        if without not in self._held_out:
            result = np.full((len(self.cell_of_row), len(self.rows)), np.nan)
            for fold in self.test_folds:
                parameters = self.solve(fold.train)[1].copy()
                if without is not None:
                    parameters[self.spans[without]] = 0
                test = np.isin(self.cell_of_row, np.flatnonzero(fold.test))
                result[test] = self.remaining(parameters)[test]
            result.flags.writeable = False
            self._held_out[without] = result
        return self._held_out[without]

    @property
    def error(self) -> float:
        """Held-out Σ e² / σ² of model and chosen effects."""
        if self._error is None:
            self._error = 0.0
            for fold in self.test_folds:
                extended = np.append(self.solve(fold.train)[1], -1.0)
                self._error += float(extended @ self.gram[fold.test].sum(axis=0) @ extended)
        return self._error

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
        parameters = self.solve(train)[1]
        return parameters[: len(self.precision)], [parameters[span] for span in self.spans]

    def candidate(self, effect: Effect, joints: tuple[int, ...], settings: Mapping[str, float]) -> Candidate:
        """Columns of an effect, filtered as the torque is."""
        return self.candidates([(effect, joints, settings)])[0]

    def candidates(self, wanted: Sequence[Wanted], rough: bool = False) -> list[Candidate]:
        """Columns of several effects at once, as `make_candidates`; those asked for before are remembered."""
        keys = [(effect, joints, tuple(settings.items())) for effect, joints, settings in wanted]
        new = {key: entry for key, entry in zip(keys, wanted, strict=True) if key not in self._made}
        if new:
            self._made.update(zip(new, make_candidates(self, list(new.values()), rough), strict=True))
        return [self._made[key] for key in keys]

    def fit(self, effect: Effect, joints: tuple[int, ...], settings: Mapping[str, float]) -> np.ndarray:
        """(k,) parameters fitted to all the data together with the model, under its prior."""
        candidate = self.candidate(effect, joints, settings)
        inverse, without_it = self.solve(np.ones(self.cells, dtype=bool))
        ((cross, squares),) = self._moments.of([candidate])
        others = [self._moments.between(other, [candidate])[0] for other in self.chosen]
        *with_fit, side = (
            np.concatenate([cross[:, :-1], *others, cross[:, -1:]], axis=1).sum(axis=0) / self.rows_per_independent
        )
        square, with_fit = squares.sum(axis=0), np.reshape(with_fit, (self.size, -1))
        schur = (
            square / self.rows_per_independent
            + self.ridge(candidate, square.diagonal())
            - with_fit.T @ inverse @ with_fit
        )
        unit = 1 / np.sqrt(np.maximum(schur.diagonal(), 1e-300))
        candidate.release()
        return np.asarray(unit * np.linalg.solve(schur * np.outer(unit, unit), unit * (side - with_fit.T @ without_it)))

    def energy_taken(self, joint: int, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) Σ e² / σ² that each column (S', K) [N·m] on one joint would take away, and its factor (K,).

        Model and chosen effects adapt; all rows are fitted and none held out, so this only picks what to try.
        """
        inverse, without_it = self.solve(np.ones(self.cells, dtype=bool))
        block = self.whitening.whitened(joint, columns / self.sigma[:, joint, None])
        rows, whitened_twice = self.rows[joint], self.whitening.whitened(joint, block)  # as its transpose whitens alike
        cross = np.zeros((self.size, block.shape[1]))
        cross[self.parameter_index[joint]] = rows[:, :-1].T @ whitened_twice
        for candidate, span in zip(self.chosen, self.spans, strict=True):
            if joint in candidate.blocks:
                cross[span] = candidate.blocks[joint].T @ whitened_twice
        side = (whitened_twice.T @ rows[:, -1] - cross.T @ without_it) / self.rows_per_independent
        energy = np.sum(block**2, axis=0) / self.rows_per_independent
        schur = energy - np.sum(cross * (inverse @ cross), axis=0) / self.rows_per_independent**2
        schur = np.maximum(schur, 1e-6 * energy + 1e-12)
        return side**2 / schur * self.rows_per_independent, side / schur
