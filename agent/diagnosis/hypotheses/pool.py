"""Candidates by number, with the second moments of their columns that hypotheses are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.hypotheses.noise_model import NoiseModel
from agent.diagnosis.rows.candidate import Candidate, EffectKey, parameter_ends

_AT_ONCE = 64  # numerical: candidates whose own moments are worked out together


class CandidateBlock:
    """Candidates next to each other: their columns per joint, and moments with [X, U, r] and with themselves."""

    def __init__(self, noise: NoiseModel, candidates: Sequence[Candidate]):
        self.candidates = tuple(candidates)
        widths = np.array([len(c.names) for c in candidates])
        self.first_column = np.concatenate([[0], np.cumsum(widths)])
        self.columns: list[np.ndarray] = []
        self.parameters: list[np.ndarray] = []
        self.moments: list[np.ndarray] = []
        self.column_index = np.full((noise.dof, int(self.first_column[-1])), -1)
        power = np.zeros(self.column_index.shape)
        for j in range(noise.dof):
            here = [k for k, c in enumerate(candidates) if j in c.blocks]
            columns = np.zeros((noise.rows, int(widths[here].sum())), dtype=np.float32)
            which = np.concatenate(
                [np.arange(self.first_column[k], self.first_column[k + 1]) for k in here] or [np.empty(0, int)]
            )
            self.column_index[j, which] = np.arange(len(which))
            for k in here:
                columns[:, self.column_slice(k, j)] = noise.thinned(candidates[k], j)
            weight = (noise.sigma[:, j] / noise.nominal[j]).astype(np.float32) ** 2
            power[j, which] = np.einsum("sk,sk,s->k", columns, columns, weight) / noise.rows
            self.columns.append(columns)
            self.parameters.append(which)
            self.moments.append(noise.products_with_columns(j, columns).astype(float) * noise.weight)
        self.rms = np.sqrt(np.maximum(power.max(axis=0), 1e-24))
        self.by_width = {int(width): np.flatnonzero(widths == width) for width in np.unique(widths)}
        self.own_moments = {width: self._own(noise, width, which) for width, which in self.by_width.items()}
        self.row_in_width = np.empty(len(candidates), dtype=int)
        self.priors: dict[int, np.ndarray] = {}
        for width, which in self.by_width.items():
            self.row_in_width[which] = np.arange(len(which))
            self.priors[width] = np.stack([_prior(candidates[k]) for k in which.tolist()])

    def _own(self, noise: NoiseModel, width: int, which: np.ndarray) -> np.ndarray:
        """(N, n, k, k) products of the columns of candidates with as many parameters, joint by joint."""
        moments = np.zeros((len(which), noise.dof, width, width))
        for j in range(noise.dof):
            place = self.column_index[j, self.first_column[which]]
            here = np.flatnonzero(place >= 0)
            for start in range(0, len(here), _AT_ONCE):
                some = here[start : start + _AT_ONCE]
                columns = self.columns[j][:, place[some][:, None] + np.arange(width)].transpose(1, 2, 0)
                moments[some, j] = (columns @ columns.transpose(0, 2, 1)) * noise.weight
        return moments

    def column_slice(self, number: int, joint: int) -> slice:
        """Columns of a candidate on a joint that it acts on."""
        start = int(self.column_index[joint, self.first_column[number]])
        return slice(start, start + len(self.candidates[number].names))


class CandidatePool:
    """Candidates that hypotheses are made of, each known by its number, next to a noise model's columns."""

    def __init__(self, noise: NoiseModel):
        self.noise = noise
        self.blocks: list[CandidateBlock] = []
        self._where: list[tuple[int, int]] = []
        self._products: dict[tuple[int, int, int], np.ndarray] = {}

    @property
    def size(self) -> int:
        """How many candidates there are."""
        return len(self._where)

    def add(self, candidates: Sequence[Candidate]) -> None:
        """Add candidates; they get the next numbers."""
        if candidates:
            self._where += [(len(self.blocks), k) for k in range(len(candidates))]
            self.blocks.append(CandidateBlock(self.noise, candidates))
            for candidate in candidates:
                candidate.release()

    def candidate(self, number: int) -> Candidate:
        """One of them."""
        block, k = self._where[number]
        return self.blocks[block].candidates[k]

    def numbers(self, candidates: Sequence[Candidate]) -> list[int]:
        """Numbers of candidates; those that are not in the pool are added."""
        present = {id(self.candidate(k)): k for k in range(self.size)}
        self.add([candidate for candidate in candidates if id(candidate) not in present])
        present = {id(self.candidate(k)): k for k in range(self.size)}
        return [present[id(candidate)] for candidate in candidates]

    def count_parameterisations(self, key: EffectKey) -> int:
        """How many parameterisations there are of an effect on its joints, apart from values of their settings."""
        return len({tuple(sorted(c.settings)) for block in self.blocks for c in block.candidates if c.key == key})

    def rms(self, number: int) -> np.ndarray:
        """(k,) torque of each column of a candidate over nominal, root mean square, on the joint with most."""
        block, k = self._where[number]
        return self.blocks[block].rms[self.blocks[block].first_column[k] : self.blocks[block].first_column[k + 1]]

    def ridge(self, number: int, size: float) -> np.ndarray:
        """(k, k) prior precision of a candidate's parameters, of a size over nominal torque."""
        return np.diag(self.rms(number) ** 2 / size**2) + _prior(self.candidate(number))

    def columns(self, number: int, joint: int) -> np.ndarray:
        """(S, k) columns of a candidate on a joint that it acts on, over σ."""
        block, k = self._where[number]
        return self.blocks[block].columns[joint][:, self.blocks[block].column_slice(k, joint)]

    def products_with(self, number: int, block: CandidateBlock, joint: int) -> np.ndarray:
        """(k, K) products of a candidate's columns on a joint with those of a block."""
        return np.asarray((self.columns(number, joint).T @ block.columns[joint]).astype(float) * self.noise.weight)

    def moments(self, joint: int, effects: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """B of [X, Z, r], V of U with these, and Q of U."""
        (model_columns, noise_columns), without = self.noise.column_counts(joint), self.noise.moments[joint]
        keep = np.r_[0:model_columns, model_columns + noise_columns]
        of_noise = slice(model_columns, model_columns + noise_columns)
        ends = parameter_ends(model_columns, map(self.candidate, effects))
        size = int(ends[-1]) + 1
        square, cross = np.zeros((size, size)), np.zeros((noise_columns, size))
        index = np.r_[0:model_columns, size - 1]
        square[np.ix_(index, index)], cross[:, index] = without[np.ix_(keep, keep)], without[of_noise][:, keep]
        for position, k in enumerate(effects):
            block, number = self._where[k]
            span, moments = slice(ends[position], ends[position + 1]), self.blocks[block].moments[joint]
            moments = moments[:, self.blocks[block].column_slice(number, joint)]
            square[index, span], square[span, index], cross[:, span] = moments[keep], moments[keep].T, moments[of_noise]
            square[span, span] = self._own(k, joint)
            for earlier, other in enumerate(effects[:position]):
                earlier_span, product = slice(ends[earlier], ends[earlier + 1]), self._product(other, k, joint)
                square[earlier_span, span], square[span, earlier_span] = product, product.T
        return square, cross, without[of_noise, of_noise]

    def torque(self, number: int, values: np.ndarray) -> dict[int, float]:
        """Per joint the torque of an effect over nominal, root mean square."""
        return {
            j: float(
                np.sqrt(max(values @ self._own(number, j) @ values, 0.0) / self.noise.count)
                / self.noise.nominal_over_sigma[j]
            )
            for j in self.candidate(number).blocks
        }

    def difference(self, first: int, values: np.ndarray, second: int, second_values: np.ndarray, joint: int) -> float:
        """Torque over nominal, root mean square, between two effects, the first with `values`."""
        product = self._product(first, second, joint)
        power = values @ self._own(first, joint) @ values + second_values @ self._own(second, joint) @ second_values
        energy = max(power - 2 * values @ product @ second_values, 0.0) / self.noise.count
        return float(np.sqrt(energy) / self.noise.nominal_over_sigma[joint])

    def variance(self, number: int, covariance: np.ndarray, joint: int) -> float:
        """Mean square of the torque over nominal by which parameters of a covariance (k, k) change an effect's."""
        power = float(np.sum(covariance * self._own(number, joint))) / self.noise.count
        return power / float(self.noise.nominal_over_sigma[joint]) ** 2

    def lasting_torque(self, number: int, values: np.ndarray) -> dict[int, float]:
        """Per joint the torque of an effect over nominal, root mean square: in the log with most, while it lasts."""
        noise, lasting = self.noise, {}
        for j in self.candidate(number).blocks:
            torque = self.columns(number, j) @ values
            torque = (torque * noise.sigma[:, j] / noise.nominal[j]) ** 2
            acts = torque > 0 if self.candidate(number).transient else np.ones(len(torque), dtype=bool)
            power = np.bincount(noise.log[acts], torque[acts]) / np.maximum(np.bincount(noise.log[acts]), 1)
            lasting[j] = float(np.sqrt(power.max(initial=0.0)))
        return lasting

    def unit_torque(self, candidate: Candidate) -> np.ndarray:
        """Parameters (k,) at which a candidate has nominal torque, with equal contributions."""
        rms = self.rms(*self.numbers([candidate]))
        return np.asarray(1 / (np.maximum(rms, 1e-9) * np.sqrt(len(rms))))

    def _own(self, number: int, joint: int) -> np.ndarray:
        block, k = self._where[number]
        candidate = self.blocks[block].candidates[k]
        return np.asarray(
            self.blocks[block].own_moments[len(candidate.names)][self.blocks[block].row_in_width[k], joint]
        )

    def _product(self, first: int, second: int, joint: int) -> np.ndarray:
        """(k, l) products of the columns of two candidates on a joint."""
        if (first, second, joint) not in self._products:
            product = self.columns(first, joint).T @ self.columns(second, joint)
            self._products[first, second, joint] = product.astype(float) * self.noise.weight
        return self._products[first, second, joint]


def _prior(candidate: Candidate) -> np.ndarray:
    return np.zeros((len(candidate.names),) * 2) if candidate.prior is None else candidate.prior
