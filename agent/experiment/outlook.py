"""What a motion would tell: the distance between rivals after it, and the probability of the right answer.

Let a be true with parameters β. After the motion, the best that its rival b can do together with a change δ of the
model leaves

    D² = min over δ, γ of |Z_a β − X δ − Z_b γ|² / (T σ²) + δᵀ Λ δ + γᵀ R γ,

over the rows of all earlier logs and of the motion, counted as independent ones (T samples of 0.1 s each), against the
same background σ as the verdict's. This is the criterion of T-optimality (Atkinson and Fedorov, Biometrika 62, 1975)
with the parameters of model and rival projected out. The held-out advantage of a is then about normal with mean
D² and standard deviation 2 D, so it passes the margin m of the verdict with probability Φ((D² − m) / (2 D)), averaged
over the posterior of β, and over which of the two is true. m grows with the rows, as what a leaves over the background
does, and is at least a share of what a explains by itself: forms of effects are not trusted further. Where a closes
less than the verdict calls a good fit, b stays its equal all the same if it explains half of what a does; a will close
what the present cause closes, give or take.

Rows at a standstill of their joint count nothing: there the torque is what stiction makes of it, and no form of an
effect is to be trusted. A motion that is repeated counts once: the model's own error comes back with it. It begins
where the last log ended, as warm as the arm was then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from agent.diagnosis import Candidate, Dataset, Fit, background_of
from agent.experiment.questions import Form, Hypothesis, OpenPair
from agent.model import MotionSignals, NominalModel
from agent.robot import Tool

#: s, as in the fit: rows this far apart count as independent.
_INDEPENDENT = 0.1
#: Parameters of a hypothesis are drawn so often from what the logs say of them.
_DRAWS = 4


@dataclass(frozen=True, eq=False)
class GridMotion:
    """A motion on an even grid: time (S,) [s], q, qd, qdd (S, n)."""

    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


@dataclass(frozen=True, eq=False)
class Told:
    """What motions add: per comparison moments (m, m), and how many independent rows they have."""

    moments: tuple[np.ndarray, ...]
    rows: float

    def __add__(self, other: Told) -> Told:
        """Of both."""
        return Told(tuple(a + b for a, b in zip(self.moments, other.moments, strict=True)), self.rows + other.rows)


@dataclass(frozen=True, eq=False)
class HypothesisPair:
    """One hypothesis taken for true against one form of its rival, and the moments of what is seen of both so far.

    `gram` (m, m) over [model and shared effects, rival, truth], `prior` (m', m') over the first two, of which the first
    `own` are the model's and the shared effects'.
    """

    pair: int
    truth: Form
    rival: Candidate | None
    shared: tuple[Candidate, ...]
    gram: np.ndarray
    prior: np.ndarray
    values: np.ndarray
    own: int


class Outlook:
    """What is open after a diagnosis, ready to weigh motions, with a known `load` at the flange or none."""

    def __init__(self, dataset: Dataset, pairs: Sequence[OpenPair], load: Tool | None = None):
        self.dataset, self.pairs = dataset, list(pairs)
        bare = dataset.fit.reference
        self._reference = bare if load is None else NominalModel(dataset.model, load)
        self.comparisons = [
            comparison
            for number, pair in enumerate(pairs)
            for truth, rival in ((pair.first, pair.second), (pair.second, pair.first))
            if truth.forms
            for comparison in _comparisons(number, pair.fit, truth, rival)
        ]

    def information(self, motion: GridMotion) -> np.ndarray:
        """(p, p) that a motion adds to what is known of the model's own parameters."""
        model = self._model_columns(motion)[2]
        flat = model.reshape(-1, model.shape[2])
        return flat.T @ flat

    def _model_columns(self, motion: GridMotion) -> tuple[MotionSignals, np.ndarray, np.ndarray]:
        """Signals, what a row's error is divided by (S, n) [N·m], and so divided the model's columns (S, n, p)."""
        dataset, reference = self.dataset, self._reference
        log, after = len(dataset.logs), max(s.started + float(s.time[-1]) for s in dataset.fit.signals)
        signals = MotionSignals(reference, motion.time, motion.q, motion.qd, motion.qdd, log, started=after)
        moving = dataset.fit.sigma.min(axis=0)
        sigma = background_of(reference, moving, [signals], dataset.limits)
        rate = 1 / float(np.median(np.diff(motion.time)))
        weight = np.where(sigma > 1.01 * moving, np.inf, np.sqrt(max(1.0, _INDEPENDENT * rate)))
        unit = sigma * weight
        return signals, unit, reference.model.columns(motion.q, motion.qd, motion.qdd) / unit[:, :, None]

    @property
    def nothing(self) -> Told:
        """No further motion."""
        return Told(tuple(np.zeros_like(comparison.gram) for comparison in self.comparisons), 0.0)

    def told(self, motion: GridMotion) -> Told:
        """What a motion adds."""
        signals, unit, model = self._model_columns(motion)
        low_pass = _low_pass(1 / float(np.median(np.diff(motion.time))), self.dataset)
        made: dict[Candidate, np.ndarray] = {}

        def columns(candidate: Candidate) -> np.ndarray:
            if candidate not in made:
                effect, joints, settings = candidate.effect, candidate.joints, candidate.settings
                block = np.zeros((*motion.q.shape, len(candidate.names)))
                if not effect.fast_torque:  # that remembers no earlier motion
                    effect.prepare([*self.dataset.fit.signals, signals], [(joints, settings)])
                for joint, values in effect.columns(signals, joints, settings).items():
                    seen = low_pass(values) if effect.fast_torque else values
                    block[:, joint] = seen / unit[:, joint, None]
                made[candidate] = np.nan_to_num(block)
            return made[candidate]

        result = []
        for comparison in self.comparisons:
            blocks = [model, *(columns(c) for c in comparison.shared)]
            blocks += [columns(comparison.rival)] if comparison.rival is not None else []
            together = np.concatenate([*blocks, columns(comparison.truth.candidate)], axis=2)
            flat = together.reshape(-1, together.shape[2])
            result.append(flat.T @ flat)
        seconds = float(motion.time[-1] - motion.time[0])
        return Told(tuple(result), seconds / _INDEPENDENT * motion.q.shape[1])

    def _rows(self, added: Told) -> float:
        """Independent rows of all motions."""
        return float(self.dataset.fit.count.sum()) / self.dataset.fit.repeat + added.rows

    def distances(self, added: Told) -> np.ndarray:
        """(comparisons,) D² on average over the draws, after all earlier logs and the motions added."""
        pairs = zip(self.comparisons, added.moments, strict=True)
        return np.array([np.mean(_distances(c, c.gram + more, len(c.prior))) for c, more in pairs])

    def probabilities(self, added: Told) -> np.ndarray:
        """(pairs,) probability of the right answer after all earlier logs and the motions added."""
        of_pair: list[dict[int, float]] = [{} for _ in self.pairs]
        for number, comparison in enumerate(self.comparisons):
            gram = comparison.gram + added.moments[number]
            alone = _distances(comparison, gram, comparison.own)
            pair, limits = self.pairs[comparison.pair], self.dataset.limits
            chances = []
            for distance, whole in zip(_distances(comparison, gram, len(comparison.prior)), alone, strict=True):
                chance = _passes(distance, max(pair.margin * self._rows(added), limits.indistinguishable_gain * whole))
                half = comparison.rival is not None and distance < (1 - limits.runner_up_gain) * whole
                chances.append(chance * (pair.fits_well if half else 1.0))
            chance = float(np.mean(chances))
            key = id(comparison.truth)
            of_pair[comparison.pair][key] = min(of_pair[comparison.pair].get(key, 1.0), chance)
        return np.array([np.mean(list(found.values())) if found else 0.0 for found in of_pair])

    def minimum_detectable_sizes(self, added: Told) -> list[float | None]:
        """Per pair with nothing as its rival: the size that four of five draws show, over the one asked about."""
        found: list[float | None] = [None] * len(self.pairs)
        for comparison, more in zip(self.comparisons, added.moments, strict=True):
            if comparison.rival is not None:
                continue
            distance = float(np.mean(_distances(comparison, comparison.gram + more, comparison.own)))
            margin = self.pairs[comparison.pair].margin * self._rows(added)
            if distance > 0:
                size = (1.6832 + np.sqrt(1.6832**2 + 4 * margin)) / 2 / np.sqrt(distance)
                found[comparison.pair] = max(size, found[comparison.pair] or 0.0)
        return found


def _low_pass(rate: float, dataset: Dataset) -> Callable[[np.ndarray], np.ndarray]:
    """Columns (S, k) at a rate [Hz] as the diagnosis sees them."""
    from scipy.signal import butter, sosfiltfilt

    if not dataset.cutoff < 0.45 * rate:
        return np.asarray
    sections = butter(dataset.model.order, dataset.cutoff, fs=rate, output="sos")
    return lambda columns: sosfiltfilt(sections, np.nan_to_num(columns), axis=0)


def _passes(distance: float, margin: float) -> float:
    return float(ndtr((distance - margin) / (2 * np.sqrt(max(distance, 1e-12)))))


def _distances(comparison: HypothesisPair, gram: np.ndarray, free: int) -> list[float]:
    """D² for every drawn truth, where the first `free` parameters of model and rival can follow."""
    truth = len(comparison.prior)
    matrix = gram[:free, :free] + comparison.prior[:free, :free]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * np.outer(scale, scale) + 1e-9 * np.eye(free)
    cross = scale[:, None] * gram[:free, truth:]
    schur = gram[truth:, truth:] - cross.T @ np.linalg.solve(scaled, cross)
    return [max(float(values @ schur @ values), 0.0) for values in comparison.values]


def _comparisons(number: int, fit: Fit, truth: Hypothesis, rival: Hypothesis) -> list[HypothesisPair]:
    form = truth.forms[0]
    rng = np.random.default_rng(0)
    spread = np.linalg.cholesky(form.covariance + 1e-18 * np.eye(len(form.values)) * np.trace(form.covariance + 1))
    draws = np.vstack([form.values, form.values + rng.standard_normal((_DRAWS, len(form.values))) @ spread.T])
    rivals: list[Candidate | None] = [other.candidate for other in rival.forms] or [None]
    return [_comparison(number, fit, form, other, draws) for other in rivals]


def _comparison(number: int, fit: Fit, truth: Form, rival: Candidate | None, draws: np.ndarray) -> HypothesisPair:
    beside = fit if rival is None else fit.with_chosen((*fit.chosen, rival))
    (_, (cross, own)), *_ = beside.moments([truth.candidate])
    size = beside.size
    gram = np.zeros((size + len(truth.values),) * 2)
    gram[:size, :size] = beside.gram.sum(axis=0)[:-1, :-1]
    gram[:size, size:] = cross.sum(axis=0)[:-1]
    gram[size:, :size] = gram[:size, size:].T
    gram[size:, size:] = own.sum(axis=0)
    return HypothesisPair(number, truth, rival, fit.chosen, gram / fit.repeat, beside.prior, draws, fit.size)
