"""What the logs say of candidates beyond a hypothesis: which are worth a score, and what would be seen of others.

The information of the logs on parameters β is S = ZᵀZ − ZᵀA (AᵀA + R)⁻¹ AᵀZ, with A the columns of the model, of the
hypothesis' effects and of the noise model (`score`), and R their prior. With the scales of the hypothesis it gives the
gain in log evidence that a candidate would be worth, the smallest size that would be named, and what further rows add.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from agent.diagnosis.hypotheses.joint_moments import solved_lower
from agent.diagnosis.hypotheses.noise_model import scaled_cholesky
from agent.diagnosis.hypotheses.pool import CandidateBlock
from agent.diagnosis.hypotheses.score import LEAST_SCALE, EvaluatedHypothesis, Score
from agent.diagnosis.rows.candidate import Candidate, parameter_ends
from agent.diagnosis.rows.fit import Fit


class Evidence(Score):
    """Scores of hypotheses, and the information of the logs on what they do not contain.

    It is a score with further questions: each is put to the columns, scales and moments of one, and whoever compares
    hypotheses asks both.
    """

    def shortlist_gains(self, base: EvaluatedHypothesis) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return about what each candidate of the pool adds to the log evidence of a hypothesis, and its parameters.

        The scales of the hypothesis stay, so this picks what to `evaluate`, whose log evidence is the score.
        """
        parts = base.shortlist  # per block; what was added since is worked out
        parts += [self._shortlist_gains(base, block) for block in self.pool.blocks[len(parts) :]]
        if not parts:
            return np.empty(0), []
        return np.concatenate([gain for gain, _ in parts]), [value for _, values in parts for value in values]

    def _shortlist_gains(self, base: EvaluatedHypothesis, block: CandidateBlock) -> tuple[np.ndarray, list[np.ndarray]]:
        schur, side = self._schur(base, block)
        gains, values = np.empty(len(block.candidates)), [np.empty(0)] * len(block.candidates)
        for width, which in block.by_width.items():
            columns = block.first_column[which][:, None] + np.arange(width)
            gain, fitted = self._at_best_size(schur[width], side[columns], block.rms[columns], block.priors[width])
            for row, number in enumerate(which.tolist()):
                gains[number] = gain[row] - self.cost(block.candidates[number])
                values[number] = fitted[row]
        return gains, values

    def _schur(self, base: EvaluatedHypothesis, block: CandidateBlock) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """Per number of parameters k the information (N, k, k) on candidates beyond a hypothesis; (K,) their side."""
        size = int(block.first_column[-1])
        cross, side = np.zeros((len(base.precision), size)), np.zeros(size)
        information = {width: np.zeros((len(which), width, width)) for width, which in block.by_width.items()}
        for j, joint in enumerate(base.joint_moments):
            columns = block.parameters[j]
            if not len(columns):
                continue
            (of_model, of_noise), scale, moments = self.noise.column_counts(j), base.scales[j], block.moments[j]
            reach = joint.root.solved(moments[of_model : of_model + of_noise]) / scale
            products = np.vstack([moments[:of_model], *(self.pool.products_with(k, block, j) for k in joint.effects)])
            cross[np.ix_(joint.parameter_index, columns)] += products / scale - joint.half[:, :-1].T @ reach
            side[columns] += moments[-1] / scale - joint.half[:, -1] @ reach
            for width, which in block.by_width.items():
                place = block.column_index[j, block.first_column[which]]
                here = np.flatnonzero(place >= 0)
                part = reach[:, place[here][:, None] + np.arange(width)].transpose(1, 0, 2)
                information[width][here] += block.own_moments[width][here, j] / scale - part.transpose(0, 2, 1) @ part
        unit = 1 / np.sqrt(np.diag(base.precision))
        half = solved_lower(scaled_cholesky(base.precision, unit), unit[:, None] * cross)
        for width, which in block.by_width.items():
            part = half[:, block.first_column[which][:, None] + np.arange(width)].transpose(1, 0, 2)
            information[width] -= part.transpose(0, 2, 1) @ part
        return information, side - cross.T @ base.mean

    def smallest_sizes(self) -> list[float]:
        """Return per candidate the smallest torque over nominal, root mean square, that would be named.

        Its log Bayes factor against nothing has to outweigh the prior with a probability of 80 %. Signs of its
        parameters as they are usual: each contributes as much torque.
        """
        smallest, expected = [], self.as_expected(self.null_hypothesis)
        for block in self.pool.blocks:
            schur, _ = self._schur(expected, block)
            sizes = np.empty(len(block.candidates))
            for width, which in block.by_width.items():
                columns = block.first_column[which][:, None] + np.arange(width)
                unit = 1 / (block.rms[columns] * np.sqrt(width))
                information = np.maximum(np.einsum("nk,nkl,nl->n", unit, schur[width], unit), 1e-12)
                cost = np.array([self.cost(block.candidates[k]) + self.naming_threshold(True) for k in which])
                usual = self.law.sizes[1] ** 2 * width * unit[:, :, None] * schur[width] * unit[:, None, :]
                log_det = 0.5 * np.linalg.slogdet(np.eye(width) + usual)[1]
                sizes[which] = (self.law.margin + np.sqrt(2 * (cost + log_det))) / np.sqrt(information)
            smallest += sizes.tolist()
        return smallest

    def information(self, candidates: Sequence[Candidate]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the information (m, m) of the logs on parameters of model and candidates, given the noise model.

        Also return the prior precision (m, m), with candidates of the largest usual size, and where the parameters of
        each begin and end. The scales are those without effects.
        """
        numbers = self.pool.numbers(candidates)
        ends = parameter_ends(len(self.prior), candidates)
        prior = block_diag(self.prior, *(self.pool.ridge(number, self.law.sizes[-1]) for number in numbers))
        return self._information(candidates, np.minimum(self.null_hypothesis.scales, 1.0)), prior, ends

    def covariance(self, fit: Fit) -> np.ndarray:
        """Return the covariance (m, m) of the parameters of a fit of these logs, given the noise model.

        Its scales are those of what the fit leaves of held-out motion.
        """
        scales = np.nanmean((fit.held_out() / fit.sigma) ** 2, axis=0)
        matrix = self._information(fit.chosen, np.maximum(scales, LEAST_SCALE)) + fit.prior
        unit = 1 / np.sqrt(np.diag(matrix))
        half = solved_lower(scaled_cholesky(matrix, unit), np.diag(unit))
        return np.asarray(half.T @ half)

    def _information(self, candidates: Sequence[Candidate], scales: np.ndarray) -> np.ndarray:
        numbers = self.pool.numbers(candidates)
        ends = parameter_ends(len(self.prior), candidates)
        total = np.zeros((int(ends[-1]),) * 2)
        for j in range(self.dof):
            on_joint = [number for number, candidate in enumerate(candidates) if j in candidate.blocks]
            index = np.concatenate(
                [self.parameter_index[j], *(np.arange(ends[k], ends[k + 1]) for k in on_joint)]
            ).astype(int)
            variance = self.noise.variance(j, float(scales[j]), 0.0, {})
            joint = self.moments_of_joint(j, float(scales[j]), variance, tuple(numbers[k] for k in on_joint), index)
            total[np.ix_(index, index)] += joint.reduced[:-1, :-1]
        return total

    def information_of_rows(self, joint: int, rows: np.ndarray, noise: np.ndarray, step: float) -> np.ndarray:
        """Information (k, k) of further rows (S, k) of a joint, given the noise model.

        Rows are divided by σ and `step` [s] apart; `noise` (S, m) are the noise model's columns on them, divided by σ.
        """
        scale, weight = min(float(self.null_hypothesis.scales[joint]), 1.0), step / self.law.error_correlation_time
        products = noise.T @ noise * weight
        lower = np.linalg.cholesky(
            np.eye(len(products)) / self.noise.variance(joint, scale, 0.0, {}) + products / scale
        )
        half = solved_lower(lower, noise.T @ rows * weight) / scale
        return np.asarray(rows.T @ rows * weight / scale - half.T @ half)

    def _at_best_size(
        self, schur: np.ndarray, side: np.ndarray, rms: np.ndarray, prior: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N,) gain and (N, k) parameters of candidates, each with its likeliest size, from (N, k, k) and (N, k)."""
        best, values = np.full(len(side), -np.inf), np.zeros(side.shape)
        eye = np.eye(side.shape[1])
        for size in self.sizes:
            ridge = prior + (rms**2 / size**2)[:, :, None] * eye
            matrix = schur + ridge
            unit = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1e-300))
            unit_products = unit[:, :, None] * unit[:, None, :]
            matrix = matrix * unit_products + 1e-10 * eye
            fitted = unit * np.linalg.solve(matrix, (unit * side)[..., None])[..., 0]
            gain = 0.5 * (np.sum(side * fitted, axis=1) - np.linalg.slogdet(matrix)[1])
            gain += 0.5 * np.linalg.slogdet(ridge * unit_products)[1]
            better = gain > best
            best[better], values[better] = gain[better], fitted[better]
        return best, values
