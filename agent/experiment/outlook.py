"""What a motion would tell: the distance between rivals after it, and the probability of the right answer.

Let a be true with parameters β. After the motion, the best that its rival b can do together with a change δ of the
model leaves

    D² = min over δ, γ of |Z_a β − X δ − Z_b γ|² / (T σ²) + δᵀ Λ δ + γᵀ R γ,

over the rows of all earlier logs and of the motion, counted as independent ones (T samples of 0.1 s each), against the
same background σ as the verdict's. This is the criterion of T-optimality (Atkinson and Fedorov, Biometrika 62, 1975)
with the parameters of model and rival projected out. The held-out advantage of a is then about normal with mean
D² and standard deviation 2 √λ D, with λ the variance of the model's error summed over segments of motion over that of
independent rows of the background. So it passes the margin m of the verdict with probability Φ((D² − m) / (2 √λ D)),
averaged over the posterior of β, over the forms of a that do as well, and over which of the two is true. m grows with
the rows, as what a leaves over the background does, and is at least a share of what a explains by its form, beyond a
constant that both can be: forms of effects are not trusted further. A form of b that is richer than a's by more than a
parameter is no equal. Where a closes less than the verdict calls a good fit, b stays its equal all the same if it
explains half of what a does; a will close what the present cause closes, give or take.

Rows at a standstill of their joint count nothing: there the torque is what stiction makes of it, and no form of an
effect is to be trusted. A motion that is repeated counts once: the model's own error comes back with it. It begins
where the last log ended, as warm as the arm was then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from agent.diagnosis import Candidate, Dataset, Fit, background_of, complexity, exact_in_both
from agent.experiment.questions import Form, Hypothesis, OpenPair
from agent.model import CATALOGUE, MotionSignals, NominalModel
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

    `gram` (m, m) over [model and shared effects, rival, what is exact in both, truth], `prior` over all but the last.
    Of these, `own` are the places of the model and the shared effects, `with_rival` with the rival, and `exact` with
    what both owe to no form of theirs: a constant.
    """

    pair: int
    truth: Form
    rival: Candidate | None
    gram: np.ndarray
    prior: np.ndarray
    values: np.ndarray
    own: np.ndarray
    with_rival: np.ndarray
    exact: np.ndarray
    beside: tuple[Candidate, ...]
    lasting: float


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
            for form in truth.truths
            for comparison in _comparisons(number, pair, form, rival)
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
            blocks = [model, *(columns(c) for c in comparison.beside)]
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
        return np.array([np.mean(_distances(c, c.gram + more, c.with_rival)) for c, more in pairs])

    def probabilities(self, added: Told) -> np.ndarray:
        """(pairs,) probability of the right answer after all earlier logs and the motions added: whichever is true."""
        chances = self.chances(added)
        known = np.isfinite(chances)
        return np.where(known, chances, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)

    def chances(self, added: Told) -> np.ndarray:
        """(pairs, 2) the same where the first or the second of a pair is true; not a number for none."""
        of_pair: list[tuple[dict[int, float], ...]] = [({}, {}) for _ in self.pairs]
        for number, comparison in enumerate(self.comparisons):
            gram = comparison.gram + added.moments[number]
            pair, limits = self.pairs[comparison.pair], self.dataset.limits
            free = (comparison.with_rival, comparison.own, comparison.exact)
            chances = []
            for distance, whole, by_form in zip(*(_distances(comparison, gram, one) for one in free), strict=True):
                margin = max(pair.margin * self._rows(added), limits.indistinguishable_gain * by_form)
                half = comparison.rival is not None and distance < (1 - limits.runner_up_gain) * whole
                chance = _passes(distance, margin, comparison.lasting)
                chances.append(chance * (pair.fits_well if half else 1.0))
            found = of_pair[comparison.pair][int(all(comparison.truth is not form for form in pair.first.truths))]
            key = id(comparison.truth)
            found[key] = min(found.get(key, 1.0), float(np.mean(chances)))
        return np.array([[np.mean(list(one.values())) if one else np.nan for one in found] for found in of_pair])

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


def _passes(distance: float, margin: float, lasting: float) -> float:
    return float(ndtr((distance - margin) / (2 * np.sqrt(max(lasting * distance, 1e-12)))))


def lasting(fit: Fit, joints: Sequence[int]) -> float:
    """Variance of the model's error summed over segments of motion, over that of independent rows of the background.

    The error follows the motion: it lasts for longer than a row counts as independent, and comes back with a cycle.
    """
    error = np.nan_to_num(fit.out_of_fold(fit.once) / fit.sigma)[:, joints]
    sums = np.zeros((int(fit.block.max()) + 1, error.shape[1]))
    np.add.at(sums, fit.block, error)
    return float(np.sum(sums**2) / (error.size * fit.repeat))


def _distances(comparison: HypothesisPair, gram: np.ndarray, free: np.ndarray) -> list[float]:
    """D² for every drawn truth, where the parameters at the places `free` can follow."""
    truth = len(comparison.prior)
    matrix = (gram[:truth, :truth] + comparison.prior)[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * np.outer(scale, scale) + 1e-9 * np.eye(len(free))
    cross = scale[:, None] * gram[free, truth:]
    schur = gram[truth:, truth:] - cross.T @ np.linalg.solve(scaled, cross)
    return [max(float(values @ schur @ values), 0.0) for values in comparison.values]


def _comparisons(number: int, pair: OpenPair, form: Form, rival: Hypothesis) -> list[HypothesisPair]:
    rng = np.random.default_rng(0)
    spread = np.linalg.cholesky(form.covariance + 1e-18 * np.eye(len(form.values)) * np.trace(form.covariance + 1))
    draws = np.vstack([form.values, form.values + rng.standard_normal((_DRAWS, len(form.values))) @ spread.T])
    others = sorted((other.candidate for other in rival.forms), key=complexity)
    # one that is richer by more than a parameter is no equal, unless it is better
    equal = [other for other in others if complexity(other) <= complexity(form.candidate) + 1] or others[:1]
    simple: list[Candidate | None] = [*equal] or [None]
    explained = pair.fit.with_chosen((*pair.fit.chosen, pair.first.truths[0].candidate)) if rival.forms else pair.fit
    lasts = lasting(explained, list(form.candidate.blocks))
    return [_comparison(number, pair.fit, form, other, draws, lasts) for other in simple]


def _comparison(
    number: int, fit: Fit, form: Form, rival: Candidate | None, draws: np.ndarray, error_lasts: float
) -> HypothesisPair:
    exact: list[Candidate] = []
    if rival is not None and (both := exact_in_both(form.candidate.place, rival.place)) is not None:
        exact = fit.candidates([(CATALOGUE[both[0]], both[1], {})])
    beside = fit.with_chosen((*fit.chosen, *([] if rival is None else [rival]), *exact))
    (_, (cross, own)), *_ = beside.moments([form.candidate])
    size = beside.size
    gram = np.zeros((size + len(form.values),) * 2)
    gram[:size, :size] = beside.gram.sum(axis=0)[:-1, :-1]
    gram[:size, size:] = cross.sum(axis=0)[:-1]
    gram[size:, :size] = gram[:size, size:].T
    gram[size:, size:] = own.sum(axis=0)
    last = size - sum(len(candidate.names) for candidate in exact)
    return HypothesisPair(
        number,
        form,
        rival,
        gram / fit.repeat,
        beside.prior,
        draws,
        np.arange(fit.size),
        np.arange(last),
        np.array([*range(fit.size), *range(last, size)]),
        beside.chosen,
        error_lasts,
    )
