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
parameter is no equal. An effect whose joint has not the travel, speed or reversals that it takes is not tried by a
diagnosis: it is not known where it is true, and no rival where it is not. All this finds motions quickly; what one of
them is expected to tell is rehearsed (`agent.experiment.rehearsal`).

Rows at a standstill of their joint count nothing: there the torque is what stiction makes of it, and no form of an
effect is to be trusted. A motion that is repeated counts once: the model's own error comes back with it. It begins
where the last log ended, as warm as the arm was then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import ndtr

from agent.diagnosis import Candidate, Dataset, Excursions, Fit, complexity, exact_in_both
from agent.experiment.motion import GridMotion, background_on
from agent.experiment.questions import Form, Hypothesis, OpenPair
from agent.model import CATALOGUE, MotionSignals, NominalModel
from agent.robot import Tool

#: s, as in the fit: rows this far apart count as independent.
_INDEPENDENT = 0.1
#: s between rows of a motion that is weighed, where nothing fast is asked about.
_FINE = 0.03
#: Parameters of a hypothesis are drawn so often from what the logs say of them.
_DRAWS = 4
#: Distances that grow by more than this with a load are worth asking what it would tell.
_LOADED = 1.5


@dataclass(frozen=True, eq=False)
class Told:
    """What motions add: moments (m, m) of the columns of the model and of all forms, how many independent rows they
    have, and what all joints went through."""

    moments: np.ndarray
    rows: float
    excursions: Excursions

    def __add__(self, other: Told) -> Told:
        """Of both."""
        return Told(self.moments + other.moments, self.rows + other.rows, self.excursions + other.excursions)


@dataclass(frozen=True, eq=False)
class HypothesisPair:
    """One hypothesis taken for true, with drawn parameters `values` (draws, k), against one form of its rival.

    `beside` are the shared effects, `exact` what both owe to no form of theirs: a constant.
    """

    pair: int
    truth: Form
    rival: Candidate | None
    values: np.ndarray
    beside: tuple[Candidate, ...]
    exact: tuple[Candidate, ...]
    lasting: float


@dataclass(frozen=True, eq=False)
class _Projected:
    """Moments of all forms beyond what the model can follow; `place` are the columns of a candidate."""

    moments: np.ndarray
    ridge: np.ndarray
    place: Mapping[Candidate, np.ndarray]

    def distances(self, comparison: HypothesisPair, free: Sequence[Candidate]) -> list[float]:
        """D² for every drawn truth, where the parameters of the model and of `free` can follow."""
        truth = self.place[comparison.truth.candidate]
        schur = self.moments[np.ix_(truth, truth)]
        if free:
            at = np.concatenate([self.place[one] for one in free])
            matrix = self.moments[np.ix_(at, at)] + self.ridge[np.ix_(at, at)]
            scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
            scaled = matrix * np.outer(scale, scale) + 1e-9 * np.eye(len(at))
            cross = scale[:, None] * self.moments[np.ix_(at, truth)]
            schur = schur - cross.T @ np.linalg.solve(scaled, cross)
        return np.maximum(np.einsum("ij,jk,ik->i", comparison.values, schur, comparison.values), 0.0).tolist()


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
        sides = [(*c.beside, *c.exact, c.rival, c.truth.candidate) for c in self.comparisons]
        self._candidates = [one for one in dict.fromkeys(one for side in sides for one in side) if one is not None]
        fit = dataset.fit
        ends = len(fit.precision) + np.cumsum([0, *(len(one.names) for one in self._candidates)])
        spans = [np.arange(a, b) for a, b in pairwise(ends)]
        self._place = dict(zip(self._candidates, spans, strict=True))
        self._known = _moments(fit, self._candidates)
        self._prior = np.zeros_like(self._known)
        self._prior[: len(fit.precision), : len(fit.precision)] = fit.precision
        for one, span in self._place.items():
            energy = fit.repeat * self._known[span, span]
            self._prior[np.ix_(span, span)] = fit.ridge(one, energy)
        self._reached = Excursions.of(dataset.fit.signals, dataset.limits)

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
        sigma = background_on(dataset, reference, signals)
        rate = 1 / float(np.median(np.diff(motion.time)))
        weight = np.where(sigma > 1.01 * moving, np.inf, np.sqrt(max(1.0, _INDEPENDENT * rate)))
        unit = sigma * weight
        return signals, unit, reference.model.columns(motion.q, motion.qd, motion.qdd) / unit[:, :, None]

    @property
    def nothing(self) -> Told:
        """No further motion."""
        return Told(
            np.zeros_like(self._known), 0.0, replace(self._reached, reversals=np.zeros_like(self._reached.reversals))
        )

    def told(self, motion: GridMotion) -> Told:
        """What a motion adds."""
        motion = motion if any(one.effect.fast_torque for one in self._candidates) else _thinned(motion)
        signals, unit, model = self._model_columns(motion)
        low_pass = _low_pass(1 / float(np.median(np.diff(motion.time))), self.dataset)

        def columns(candidate: Candidate) -> np.ndarray:
            effect, joints, settings = candidate.effect, candidate.joints, candidate.settings
            block = np.zeros((*motion.q.shape, len(candidate.names)))
            if not effect.fast_torque:  # that remembers no earlier motion
                effect.prepare([*self.dataset.fit.signals, signals], [(joints, settings)])
            for joint, values in effect.columns(signals, joints, settings).items():
                seen = low_pass(values) if effect.fast_torque else values
                block[:, joint] = seen / unit[:, joint, None]
            return np.nan_to_num(block)

        together = np.concatenate([model, *map(columns, self._candidates)], axis=2)
        flat = together.reshape(-1, together.shape[2])
        seconds = float(motion.time[-1] - motion.time[0])
        return Told(
            flat.T @ flat,
            seconds / _INDEPENDENT * motion.q.shape[1],
            Excursions.of([signals], self.dataset.limits),
        )

    def energy(self, told: Told, form: Form) -> float:
        """Of the torque of a form that is true, over the background, for each row of motions."""
        own = told.moments[np.ix_(self._place[form.candidate], self._place[form.candidate])]
        return float(form.values @ own @ form.values) / max(told.rows, 1.0)

    def _tried(self, added: Told, candidate: Candidate | None) -> bool:
        """Whether a diagnosis of all motions tries an effect there: it takes travel, speed, reversals."""
        reached = self._reached + added.excursions
        return candidate is None or not reached.lacking(candidate.effect, candidate.joints)

    def _rows(self, added: Told) -> float:
        """Independent rows of all motions."""
        return float(self.dataset.fit.count.sum()) / self.dataset.fit.repeat + added.rows

    def distances(self, added: Told) -> np.ndarray:
        """(comparisons,) D² on average over the draws, after all earlier logs and the motions added."""
        left = self._projected(added)
        return np.array([np.mean(left.distances(c, _free(c))) for c in self.comparisons])

    def _projected(self, added: Told) -> _Projected:
        """All forms beyond what the model can follow, after all earlier logs and the motions added."""
        model = len(self.dataset.fit.precision)
        gram = self._known + added.moments
        matrix = gram[:model, :model] + self._prior[:model, :model]
        scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        cross = scale[:, None] * gram[:model, model:]
        solved = np.linalg.solve(matrix * np.outer(scale, scale) + 1e-9 * np.eye(model), cross)
        place = {one: span - model for one, span in self._place.items()}
        return _Projected(gram[model:, model:] - cross.T @ solved, self._prior[model:, model:], place)

    def probabilities(self, added: Told) -> np.ndarray:
        """(pairs,) probability of the right answer after all earlier logs and the motions added: whichever is true."""
        chances = self.chances(added)
        known = np.isfinite(chances)
        return np.where(known, chances, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)

    def chances(self, added: Told) -> np.ndarray:
        """(pairs, 2) the same where the first or the second of a pair is true; not a number for none."""
        of_pair: list[tuple[dict[int, float], ...]] = [({}, {}) for _ in self.pairs]
        left = self._projected(added)
        for comparison in self.comparisons:
            pair, limits = self.pairs[comparison.pair], self.dataset.limits
            tried = self._tried(added, comparison.rival)
            free = _free(comparison) if tried else comparison.beside, (*comparison.beside, *comparison.exact)
            chances = []
            for distance, by_form in zip(*(left.distances(comparison, one) for one in free), strict=True):
                margin = max(pair.margin * self._rows(added), limits.indistinguishable_gain * by_form)
                chances.append(_passes(distance, margin, comparison.lasting))
            found = of_pair[comparison.pair][int(all(comparison.truth is not form for form in pair.first.truths))]
            key = id(comparison.truth)
            known = float(np.mean(chances)) if self._tried(added, comparison.truth.candidate) else 0.0
            found[key] = min(found.get(key, 1.0), known)
        return np.array([[np.mean(list(one.values())) if one else np.nan for one in found] for found in of_pair])

    def minimum_detectable_sizes(self, added: Told) -> list[float | None]:
        """Per pair with nothing as its rival: the size that four of five draws show, over the one asked about."""
        found: list[float | None] = [None] * len(self.pairs)
        left = self._projected(added)
        for comparison in self.comparisons:
            if comparison.rival is not None or not self._tried(added, comparison.truth.candidate):
                continue
            distance = float(np.mean(left.distances(comparison, comparison.beside)))
            margin = self.pairs[comparison.pair].margin * self._rows(added)
            if distance > 0:
                size = (1.6832 + np.sqrt(1.6832**2 + 4 * margin)) / 2 / np.sqrt(distance)
                found[comparison.pair] = max(size, found[comparison.pair] or 0.0)
        return found


def _thinned(motion: GridMotion) -> GridMotion:
    step = max(1, round(_FINE * (len(motion.time) - 1) / float(motion.time[-1] - motion.time[0])))
    return GridMotion(motion.time[::step], motion.q[::step], motion.qd[::step], motion.qdd[::step])


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
    error = fit.rests.whitened_all(np.nan_to_num(fit.out_of_fold(fit.once) / fit.sigma))[:, joints]
    sums = np.zeros((int(fit.block.max()) + 1, error.shape[1]))
    np.add.at(sums, fit.block, error)
    return float(np.sum(sums**2) / (error.size * fit.repeat))


def _free(comparison: HypothesisPair) -> tuple[Candidate, ...]:
    """What can follow the truth beside the model: the shared effects and the rival."""
    return comparison.beside if comparison.rival is None else (*comparison.beside, comparison.rival)


def _moments(fit: Fit, candidates: Sequence[Candidate]) -> np.ndarray:
    """(m, m) of the columns of the model and of candidates on the logs of a fit, on independent rows."""
    base = len(fit.precision)
    ends = base + np.cumsum([0, *(len(one.names) for one in candidates)])
    total = np.zeros((int(ends[-1]),) * 2)
    kept = fit.cell >= 0
    for joint, (rows, index) in enumerate(zip(fit.rows, fit.index, strict=True)):
        here = [k for k, one in enumerate(candidates) if joint in one.blocks]
        columns = np.hstack([rows[:, :-1], *(candidates[k].blocks[joint] for k in here)])
        columns = fit.rests.whitened(joint, columns)[kept]
        place = np.concatenate([index, *(np.arange(ends[k], ends[k + 1]) for k in here)])
        total[np.ix_(place, place)] += columns.T @ columns
    return total / fit.repeat


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
    return [
        HypothesisPair(number, form, other, draws, pair.fit.chosen, _exact(pair.fit, form, other), lasts)
        for other in simple
    ]


def _exact(fit: Fit, form: Form, rival: Candidate | None) -> tuple[Candidate, ...]:
    both = None if rival is None else exact_in_both(form.candidate.place, rival.place)
    return () if both is None else tuple(fit.candidates([(CATALOGUE[both[0]], both[1], {})]))


def tells_apart_by_load(dataset: Dataset, pairs: Sequence[OpenPair], motions: Sequence[GridMotion], load: Tool) -> bool:
    """Whether the distance between rivals after the same motions is clearly larger with a known load at the flange."""
    bare, loaded = (Outlook(dataset, pairs, one) for one in (None, load))
    first, second = (
        one.distances(sum((one.told(motion) for motion in motions), one.nothing)) for one in (bare, loaded)
    )
    return bool(np.any(second > _LOADED * first))
