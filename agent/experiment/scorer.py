"""Information from a planned motion: the expected log Bayes factor between two open hypotheses after it.

Let a be true with parameters β. On all rows of the logs and of the motion, b together with a change δ of the model
leaves

    E = ½ (βᵀ S_aa β − βᵀ S_aF (S_FF + R)⁻¹ S_Fa β),    F = δ, shared effects and b,

where S is the information on all columns, given the noise model of the verdict (`agent.diagnosis.hypotheses.evidence`),
and R the prior. E is the expected log Bayes factor of a against b (the T-optimality criterion of Atkinson and Fedorov,
Biometrika 62, 1975). The factor itself is about normal with mean E and variance 2 E. The answer is right if the factor
exceeds the threshold of a class. A form is wrong by a share of its own torque; b may follow it, so that share is lost.

The matrix of all E is the isolability of the open hypotheses on these motions. The information of motions adds up, so
each piece is weighed alone. Rows with a stationary joint do not count: stiction decides the torque there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import ndtr

from agent.diagnosis import (
    LIMITS,
    ROW_SPACING,
    Candidate,
    Dataset,
    Evidence,
    MotionCoverage,
    noise_level,
    smooth_columns,
)
from agent.experiment.pieces import GridMotion
from agent.experiment.questions import Alternative, OpenPair
from agent.model import MotionSignals, NominalModel
from agent.robot import Tool


@dataclass(frozen=True, eq=False)
class InformationGain:
    """Gain from motions: information (m, m) on the parameters of model and forms, and the coverage of all joints."""

    information: np.ndarray
    coverage: MotionCoverage

    def __add__(self, other: InformationGain) -> InformationGain:
        """The sum of both."""
        return InformationGain(self.information + other.information, self.coverage + other.coverage)


class ExperimentScorer:
    """The open hypotheses after a diagnosis, ready to weigh motions, with a known `load` at the flange or none."""

    def __init__(self, dataset: Dataset, evidence: Evidence, pairs: Sequence[OpenPair], load: Tool | None = None):
        self.dataset, self.pairs, self._evidence = dataset, list(pairs), evidence
        bare = dataset.fit.reference
        self._reference = bare if load is None else NominalModel(dataset.model, load)
        sides = [(*pair.shared, pair.first.form, pair.second.form) for pair in pairs]
        self._forms = [form for form in dict.fromkeys(form for side in sides for form in side) if form is not None]
        self._known, self._prior, ends = evidence.information(self._forms)
        self._columns_of_form = {
            form: np.arange(a, b) for form, (a, b) in zip(self._forms, pairwise(ends), strict=True)
        }
        self._reached = MotionCoverage.of(dataset.fit.signals)

    @property
    def nothing(self) -> InformationGain:
        """No further motion."""
        none = replace(self._reached, reversals=np.zeros_like(self._reached.reversals))
        return InformationGain(np.zeros_like(self._known), none)

    def model_information(self, motion: GridMotion) -> np.ndarray:
        """Information (p, p) that a motion adds on the model's own parameters."""
        model = len(self.dataset.fit.precision)
        return self.information_of(motion).information[:model, :model]

    def information_of(self, motion: GridMotion) -> InformationGain:
        """Information that a motion adds."""
        dataset, evidence = self.dataset, self._evidence
        fast = any(form.effect.fast_torque for form in self._forms)
        motion = motion if fast else _thinned(motion)
        log, after = len(dataset.logs), max(s.started + float(s.time[-1]) for s in dataset.fit.signals)
        signals = MotionSignals(self._reference, motion.time, motion.q, motion.qd, motion.qdd, log, started=after)
        sigma = noise_level_on(dataset, self._reference, signals)
        moving = dataset.fit.sigma.min(axis=0)
        sigma = np.where(sigma > (1 + 1e-6) * moving, np.inf, sigma)
        step = float(np.median(np.diff(motion.time)))
        model = self._reference.model.columns(motion.q, motion.qd, motion.qdd)
        columns = self._columns(signals, motion, 1 / step)
        total = np.zeros_like(self._known)
        number = np.zeros(len(motion.time), dtype=int)
        for j in range(motion.q.shape[1]):
            free = smooth_columns(motion.q[:, j], motion.qd[:, j], motion.qdd[:, j], motion.time, number)
            rows = np.hstack([model[:, j], columns[:, j]]) / sigma[:, j, None]
            used = np.flatnonzero(np.any(rows != 0, axis=0))
            free = free * (moving[j] / sigma[:, j])[:, None]
            total[np.ix_(used, used)] += evidence.information_of_rows(j, rows[:, used], free, step)
        return InformationGain(total, MotionCoverage.of([signals]))

    def _columns(self, signals: MotionSignals, motion: GridMotion, rate: float) -> np.ndarray:
        """(S, n, k) torque [N·m] per unit of every parameter of the forms."""
        dataset = self.dataset
        low_pass = _low_pass(rate, dataset)
        blocks = []
        for form in self._forms:
            effect, joints, settings = form.effect, form.joints, form.settings
            block = np.zeros((*motion.q.shape, len(form.names)))
            if not effect.fast_torque:  # that remembers no earlier motion
                effect.prepare([*dataset.fit.signals, signals], [(joints, settings)])
            for joint, values in effect.columns(signals, joints, settings).items():
                block[:, joint] = low_pass(values) if effect.fast_torque else values
            blocks.append(np.nan_to_num(block))
        return np.concatenate(blocks, axis=2) if blocks else np.zeros((*motion.q.shape, 0))

    def energy(self, gain: InformationGain, side: Alternative) -> float:
        """Information that motions have of a side's own size."""
        assert side.form is not None
        columns = self._columns_of_form[side.form]
        return float(side.values @ gain.information[np.ix_(columns, columns)] @ side.values)

    def evidence(self, added: InformationGain) -> np.ndarray:
        """(pairs, 2) expected log Bayes factor of the first side where it is true, and of the second.

        After all logs and the motions added; not a number for a side that is no effect.
        """
        return np.array(
            [
                [
                    self._expected(added, pair, pair.first, pair.second),
                    self._expected(added, pair, pair.second, pair.first),
                ]
                for pair in self.pairs
            ]
        )

    def _expected(self, added: InformationGain, pair: OpenPair, true: Alternative, rival: Alternative) -> float:
        if true.form is None:
            return float("nan")
        whole, model = self._known + added.information, len(self.dataset.fit.precision)
        reached = self._reached + added.coverage
        if reached.lacking(true.form.effect, true.form.joints):
            return 0.0
        free = [np.arange(model), *(self._columns_of_form[form] for form in pair.shared)]
        if rival.form is not None and not reached.lacking(rival.form.effect, rival.form.joints):
            free.append(self._columns_of_form[rival.form])
        indices, columns = np.concatenate(free), self._columns_of_form[true.form]
        values = true.values if len(true.values) else self._practical(true.form)
        side = whole[np.ix_(indices, columns)] @ values
        matrix = whole[np.ix_(indices, indices)] + self._prior[np.ix_(indices, indices)]
        unit = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        lower = np.linalg.cholesky(matrix * np.outer(unit, unit) + 1e-9 * np.eye(len(indices)))
        follows = float(np.sum(solve_triangular(lower, unit * side, lower=True) ** 2))
        energy = float(values @ whole[np.ix_(columns, columns)] @ values)
        lost = 0.0 if rival.form is None else self._evidence.law.form_error**2 * energy
        return 0.5 * max(energy - follows - lost, 0.0)

    def _practical(self, form: Candidate) -> np.ndarray:
        """(k,) parameters at which an effect has its practical size, each of them as large."""
        return form.effect.practical * self._evidence.pool.unit_torque(form)

    def chances(self, added: InformationGain) -> np.ndarray:
        """(pairs, 2) probability of the right answer where the first or the second side is true, after all motions."""
        expected = self.evidence(added)
        least = np.array([[self._evidence.naming_threshold(pair.second.form is None)] for pair in self.pairs])
        deviation = np.sqrt(2 * np.maximum(expected, 1e-12))
        return np.asarray(ndtr((expected - least) / deviation))

    def minimum_detectable_sizes(self, added: InformationGain) -> list[float | None]:
        """Per pair with nothing as its rival the smallest size that four of five draws show, over the practical one."""
        root, least = np.sqrt(2) * self._evidence.law.margin, self._evidence.naming_threshold(True)
        needed = root / 2 + np.sqrt((root / 2) ** 2 + least)
        return [
            float(needed / np.sqrt(first)) if pair.second.form is None and first > 0 else None
            for pair, (first, _) in zip(self.pairs, self.evidence(added), strict=True)
        ]


def noise_level_on(dataset: Dataset, reference: NominalModel, motion: MotionSignals) -> np.ndarray:
    """The verdict's noise level (S, n) [N·m] on a motion that is not in the logs.

    The speed threshold of a stationary joint depends on all motions that are diagnosed together. On the motion's coarse
    grid, a joint that reverses is stationary between two samples, and its friction does not follow its direction there.
    """
    fit = dataset.fit
    moving = fit.sigma.min(axis=0)
    sigma = noise_level(reference, moving, [motion], fit.signals)
    turns = np.zeros(sigma.shape, dtype=bool)
    turns[1:] = motion.qd[1:] * motion.qd[:-1] < 0
    turns[:-1] |= turns[1:]
    around_turns = turns.copy()
    for shift in range(1, int(0.5 * LIMITS.row_correlation_time / float(np.median(np.diff(motion.time)))) + 1):
        around_turns[shift:] |= turns[:-shift]
        around_turns[:-shift] |= turns[shift:]
    return np.where(around_turns, np.maximum(fit.sigma.max(axis=0), 2 * moving), sigma)


def _thinned(motion: GridMotion) -> GridMotion:
    """The rows that a diagnosis keeps of it."""
    step = max(1, round(ROW_SPACING * (len(motion.time) - 1) / float(motion.time[-1] - motion.time[0])))
    return GridMotion(motion.time[::step], motion.q[::step], motion.qd[::step], motion.qdd[::step])


def _low_pass(rate: float, dataset: Dataset) -> Callable[[np.ndarray], np.ndarray]:
    """Columns (S, k) at a rate [Hz] as the diagnosis sees them."""
    from scipy.signal import butter, sosfiltfilt

    if not 2 * dataset.cutoff < rate:
        return np.asarray
    sections = butter(dataset.model.order, dataset.cutoff, fs=rate, output="sos")
    return lambda columns: sosfiltfilt(sections, np.nan_to_num(columns), axis=0)


def load_distinguishes(
    dataset: Dataset, evidence: Evidence, pairs: Sequence[OpenPair], motions: Sequence[GridMotion], load: Tool
) -> bool:
    """Return whether a known load at the flange improves what the same motions distinguish.

    Args:
        dataset: logs of the diagnosis.
        evidence: of its hypotheses.
        pairs: that are open.
        motions: the same without and with the load.
        load: known mass at the flange.
    """
    bare, loaded = (ExperimentScorer(dataset, evidence, pairs, mass) for mass in (None, load))
    first, second = (
        np.nan_to_num(scorer.evidence(sum((scorer.information_of(motion) for motion in motions), scorer.nothing)))
        for scorer in (bare, loaded)
    )
    return bool(np.any((1 - LIMITS.least_share) * second > first))
