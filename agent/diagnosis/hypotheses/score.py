"""Log evidence of hypotheses: which effects, on which joints, explain the torque that a model leaves.

All rows of joint j, divided by its noise level σ_j, follow one linear Gaussian model:

    r_j = X_j δ + Z_jh β_h + U_j γ_j + e_j,    e_j ~ N(0, s_j²),    δ ~ N(δ₀, Λ⁻¹),    β_h ~ N(0, size² / rms²),
    γ_j ~ N(0, max(s_j², s₀_j²) g² + drift² + form² τ_jh² + u_j²),   s_j² ~ inverse gamma (ν / 2, ν / 2)

X_j are the model's columns, whose parameters move within the covariance stored with them. Z_jh are the columns of the
hypothesis' effects, and U_j those of the noise model. Some of these all logs share (`noise_model`), with a variance of
four parts: the model's own systematic error (g, with the s₀_j² of other motion where it is known), changes of the arm
over time (drift), errors in the parameterisation of any effect (a share of its own torque τ), and "something else on
this joint" (u_j). Of others, with γ ~ N(0, 1), each log has its own: what the healthy arm has of the effects
(`healthy`), and changes of δ. δ, β and γ are integrated out in closed form. The scales s_j and the effects' sizes are
fitted (Laplace, empirical Bayes). Parameters that the data do not need therefore cost evidence (Kass and Raftery,
J. Am. Statist. Assoc. 90, 1995). Each nonlinear parameter that was chosen on the data costs ½ log N.

Only second moments of the rows enter, so a hypothesis costs a few small factorisations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np

from agent.diagnosis.hypotheses.joint_moments import JointMoments, NoiseRoot, remaining_energy, solved, solved_lower
from agent.diagnosis.hypotheses.law import LAW, EvidenceLaw
from agent.diagnosis.hypotheses.noise_model import Healthy, NoiseModel, scaled_cholesky
from agent.diagnosis.hypotheses.pool import CandidatePool
from agent.diagnosis.rows.candidate import Candidate, EffectKey, parameter_ends
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE

LEAST_SCALE = 0.2  # of σ²: no smaller noise level is known
_ROUNDS = 3  # numerical: of scales and sizes, one more where nothing is known


@dataclass(frozen=True, eq=False)
class EvaluatedHypothesis:
    """A hypothesis with its `log_evidence`.

    `effects` are numbers of the pool. `uncatalogued_sizes` maps joints with "something else" to its size. `values[k]`
    is the posterior mean of effect k. `torque_per_joint[k]` is its torque over nominal, fitted without the noise model:
    the root mean square while it lasts, in the log with most. `unexplained` (n,) is the squared torque over nominal
    that neither the effects nor the noise model explain.
    """

    effects: tuple[int, ...]
    uncatalogued_sizes: Mapping[int, float]
    log_evidence: float
    scales: np.ndarray
    values: tuple[np.ndarray, ...]
    torque_per_joint: tuple[dict[int, float], ...]
    unexplained: np.ndarray
    joint_moments: tuple[JointMoments, ...] = field(repr=False)
    precision: np.ndarray = field(repr=False)
    mean: np.ndarray = field(repr=False)
    shortlist: list[tuple[np.ndarray, list[np.ndarray]]] = field(default_factory=list, repr=False)

    @property
    def largest_torque(self) -> tuple[float, ...]:
        """Per effect its torque on the joint where it has most, over nominal."""
        return tuple(max(of_effect.values(), default=0.0) for of_effect in self.torque_per_joint)


class Score:
    """Log evidence of sets of candidates on one data set. Candidates are added to a pool and known by number.

    Parameters
    ----------
    fit : Fit
        Residual and columns of the model on the logs.
    candidates : sequence of Candidate
        The pool to begin with.
    healthy : sequence of HealthyForm, optional
        Effects that the healthy arm has: part of the noise model. If None, nothing is known about this arm, and the
        noise model includes small amounts of the pool's effects that every arm has.
    law : EvidenceLaw, optional
        The numbers of the decision.
    """

    def __init__(
        self, fit: Fit, candidates: Sequence[Candidate], healthy: Healthy | None = None, law: EvidenceLaw = LAW
    ):
        self.law, self.dof, self.reference = law, len(fit.rows), fit.reference
        self.noise = noise = NoiseModel(fit, candidates, healthy, law)
        self.usual: dict[EffectKey, float] = {}
        for effect in healthy or ():
            key = effect.candidate.key
            self.usual[key] = float(np.hypot(noise.usual_torque(effect), self.usual.get(key, 0.0)))
            effect.candidate.release()
        self._baseline = {effect.candidate.key: effect for effect in healthy or () if effect.mean is not None}
        self.pool = CandidatePool(noise)
        rounds = _ROUNDS + 1  # in which the scales are fitted
        self._moments = lru_cache(maxsize=rounds * self.dof)(self.pool.moments)
        self.parameter_index, self._prior_information = list(fit.parameter_index), fit.prior_information
        self._friction = _varying_friction(fit)
        self._friction_columns = [np.flatnonzero(np.isin(index, self._friction)) for index in self.parameter_index]
        self.prior = _prior_with_daily_friction(fit, self._friction, law.daily)
        self._log_prior = float(np.linalg.slogdet(self.prior)[1])
        residual = np.stack([columns[:, -1] for columns in noise.columns], axis=1) * noise.sigma / noise.nominal
        largest = float(np.sqrt(np.mean(residual**2, axis=0)).max())
        self.sizes = (*law.sizes, *([largest] if largest > law.sizes[-1] else []))
        self._null_hypothesis: EvaluatedHypothesis | None = None
        self.pool.add(candidates)
        self._null_hypothesis = self.evaluate(())

    @property
    def null_hypothesis(self) -> EvaluatedHypothesis:
        """The hypothesis without effects."""
        assert self._null_hypothesis is not None
        return self._null_hypothesis

    def possible(self, number: int, values: np.ndarray) -> bool:
        """Whether parameters (k,) of a candidate can be true."""
        candidate = self.pool.candidate(number)
        named = dict(zip(candidate.names, map(float, values), strict=True))
        effect, settings = candidate.effect, candidate.settings
        return effect.plausible(settings, named) and effect.possible(self.reference, candidate.joints, settings, named)

    def as_expected(self, base: EvaluatedHypothesis) -> EvaluatedHypothesis:
        """The same hypothesis with no joint's error scale above that of the noise model.

        The remainder of a large effect raises the scales, and then the noise model explains anything smooth.
        """
        if base.scales.max() <= 1:
            return base
        return self.evaluate(base.effects, base.uncatalogued_sizes, np.minimum(base.scales, 1.0), refit=False)

    def evaluate(
        self,
        effects: Sequence[int],
        uncatalogued_sizes: Mapping[int, float] | None = None,
        scales: np.ndarray | None = None,
        refit: bool = True,
    ) -> EvaluatedHypothesis:
        """Integrate a hypothesis.

        Parameters
        ----------
        effects : sequence of int
            Numbers of candidates in the pool.
        uncatalogued_sizes : mapping of int to float, optional
            Joints with "something else", and its size over nominal torque.
        scales : ndarray, shape (n,), optional
            Squared scales s_j² to begin with, those without effects if None; joints that nothing acts on keep them.
        refit : bool, optional
            Fit the scales; else all joints keep them.
        """
        law, uncatalogued_sizes = self.law, dict(uncatalogued_sizes or {})
        if scales is None:
            scales = np.ones(self.dof) if self._null_hypothesis is None else self._null_hypothesis.scales
        scales = scales.copy()
        form_energy, sizes = np.zeros(self.dof), [law.sizes[1]] * len(effects)
        touched = {j for k in effects for j in self.pool.candidate(k).blocks} | set(uncatalogued_sizes)
        # a large effect raises the scales, and the noise model would then explain it
        if refit and self._null_hypothesis:
            scales[list(touched)] = np.minimum(scales[list(touched)], 1.0)
        rounds = _ROUNDS + (self._null_hypothesis is None)
        for last in [False] * rounds + [True]:
            precision, side, joints, ends = self._joint_system(effects, uncatalogued_sizes, scales, form_energy, sizes)
            mean, log_det = solved(precision, side)
            values = [mean[a:b] for a, b in pairwise(ends)]
            torque = [self.pool.torque(k, v) for k, v in zip(effects, values, strict=True)]
            if last:
                break
            form_energy = np.array([sum(of_effect.get(j, 0.0) ** 2 for of_effect in torque) for j in range(self.dof)])
            form_energy = form_energy * self.noise.nominal_over_sigma**2
            if self._friction.size:
                form_energy += [self._friction_change(j, joint, mean) for j, joint in enumerate(joints)]
            sizes = [_nearest(self.sizes, max(of_effect.values(), default=0.0)) for of_effect in torque]
            for j in (touched if self._null_hypothesis else range(self.dof)) if refit else ():
                energy = remaining_energy(joints[j], mean[joints[j].parameter_index])
                scales[j] = max((law.nu + energy) / (law.nu + self.noise.count), LEAST_SCALE)
        log = -0.5 * (sum(joint.reduced[-1, -1] + joint.log_det for joint in joints) - float(side @ mean) + log_det)
        ridges = [self.pool.ridge(k, size) for k, size in zip(effects, sizes, strict=True)]
        log += 0.5 * (self._log_prior + sum(float(np.linalg.slogdet(ridge)[1]) for ridge in ridges))
        log -= 0.5 * float(np.sum((law.nu + 2) * np.log(scales) + law.nu / scales))
        log -= sum(self.cost(self.pool.candidate(k)) for k in effects) + float(np.log(len(law.sizes) - 1)) * len(
            uncatalogued_sizes
        )
        alone = self._without_noise_model(joints, scales, ridges, ends)
        return EvaluatedHypothesis(
            effects=tuple(effects),
            uncatalogued_sizes=uncatalogued_sizes,
            log_evidence=log,
            scales=scales,
            values=tuple(values),
            torque_per_joint=tuple(self.pool.lasting_torque(k, v) for k, v in zip(effects, alone, strict=True)),
            unexplained=np.array(
                [self._unexplained(j, joint, mean[joint.parameter_index]) for j, joint in enumerate(joints)]
            ),
            joint_moments=tuple(joints),
            precision=precision,
            mean=mean,
        )

    def distance_from_baseline(self, evaluated: EvaluatedHypothesis, which: int) -> tuple[float, float] | None:
        """Torque over nominal, root mean square, by which an effect of a hypothesis differs from the baseline's.

        Returns
        -------
        tuple of float, or None
            The difference on the joint where it is largest, and its standard deviation: that of both parameters. None
            where the baseline does not show the effect.
        """
        number, values = evaluated.effects[which], evaluated.values[which]
        healthy = self._baseline.get(self.pool.candidate(number).key)
        if healthy is None or healthy.mean is None or healthy.deviation is None:
            return None
        (other,), end = self.pool.numbers([healthy.candidate]), len(evaluated.mean)
        first = end - sum(map(len, evaluated.values[which:]))
        unit = 1 / np.sqrt(np.diag(evaluated.precision))
        lower = scaled_cholesky(evaluated.precision, unit)
        half = solved_lower(lower, np.diag(unit)[:, first : first + len(values)])
        covariance = half.T @ half
        per_joint = [
            (self.pool.difference(number, values, other, healthy.mean, j), j)
            for j in self.pool.candidate(number).blocks
        ]
        torque, j = max(per_joint)
        variance = self.pool.variance(number, covariance, j)
        variance += self.pool.variance(other, np.diag(healthy.deviation**2), j)
        return torque, float(np.sqrt(variance))

    def irreplaceable(self, effects: Sequence[int], which: int) -> bool:
        """Whether one effect of a hypothesis, on one joint, is needed next to something else there.

        That is any smooth function of the joint's state and time, as large as it likes. The log Bayes factor of the
        effect next to it has to be that of a name.
        """
        (joint,), others = self.pool.candidate(effects[which]).joints, [*effects[:which], *effects[which + 1 :]]
        complete, without = (
            max(self.evaluate(some, {joint: size}).log_evidence for size in self.sizes) for some in (effects, others)
        )
        return complete - without >= self.naming_threshold(True)

    def _friction_change(self, j: int, joint: JointMoments, mean: np.ndarray) -> float:
        """Squared torque over σ by which the model's friction changed: its form is no better than an effect's."""
        friction = self._friction_columns[j]
        change = mean[joint.parameter_index[friction]]
        return max(float(change @ joint.own[np.ix_(friction, friction)] @ change) / self.noise.count, 0.0)

    def _without_noise_model(
        self, joints: Sequence[JointMoments], scales: np.ndarray, ridges: Sequence[np.ndarray], ends: np.ndarray
    ) -> list[np.ndarray]:
        """Parameters (k,) of each effect, fitted without the noise model, which would absorb part of any effect."""
        base = len(self.prior)
        matrix, side = np.zeros((int(ends[-1]),) * 2), np.zeros(int(ends[-1]))
        matrix[:base, :base], side[:base] = self.prior, self._prior_information
        for scale, joint in zip(scales, joints, strict=True):
            index, moments = joint.parameter_index, joint.own / scale
            matrix[np.ix_(index, index)] += moments[:-1, :-1]
            side[index] += moments[:-1, -1]
        for ridge, (a, b) in zip(ridges, pairwise(ends), strict=True):
            matrix[a:b, a:b] += ridge
        values, _ = solved(matrix, side)
        return [values[a:b] for a, b in pairwise(ends)]

    def naming_threshold(self, against_nothing: bool) -> float:
        """Log Bayes factor from which on a name stands alone: over a rival, or over nothing."""
        law, sure = self.law, self.law.sure / self.law.confidence
        if not against_nothing:
            return float(-np.log(law.unlikely))
        prior = (1 - law.unlikely) / len(CATALOGUE) / self.dof
        return float(np.log(sure / (1 - sure) / prior))

    def moments_of_joint(
        self, j: int, scale: float, variance: float, effects: tuple[int, ...], index: np.ndarray
    ) -> JointMoments:
        """Joint j with some effects, whose parameters are at `index`, and with the noise model integrated out."""
        square, cross, noise = self._moments(j, effects)
        root = NoiseRoot.of(noise, self.noise.shared_count(j), scale, variance)
        half = root.solved(cross) / scale
        log_det = self.noise.count * np.log(scale) + root.log_det + self.noise.shared_count(j) * np.log(variance)
        return JointMoments(
            square / scale - half.T @ half, float(log_det), root, half, square, cross, noise, index, effects
        )

    def _joint_system(
        self,
        effects: Sequence[int],
        uncatalogued_sizes: dict[int, float],
        scales: np.ndarray,
        form_energy: np.ndarray,
        sizes: list[float],
    ) -> tuple[np.ndarray, np.ndarray, list[JointMoments], np.ndarray]:
        """Precision and side of δ and β over all joints, the joints, and where each effect's parameters end."""
        base = len(self.prior)
        ends = parameter_ends(base, map(self.pool.candidate, effects))
        precision, side = np.zeros((int(ends[-1]),) * 2), np.zeros(int(ends[-1]))
        precision[:base, :base], side[:base] = self.prior, self._prior_information
        joints = []
        for j in range(self.dof):
            here = [place for place, k in enumerate(effects) if j in self.pool.candidate(k).blocks]
            null = self._null_hypothesis
            if null is not None and not here and j not in uncatalogued_sizes and scales[j] == null.scales[j]:
                joint = null.joint_moments[j]
            else:
                spans = [np.arange(ends[place], ends[place + 1]) for place in here]
                index = np.concatenate([self.parameter_index[j], *spans]).astype(int)
                variance = self.noise.variance(j, float(scales[j]), float(form_energy[j]), uncatalogued_sizes)
                joint = self.moments_of_joint(
                    j, float(scales[j]), variance, tuple(effects[place] for place in here), index
                )
            precision[np.ix_(joint.parameter_index, joint.parameter_index)] += joint.reduced[:-1, :-1]
            side[joint.parameter_index] += joint.reduced[:-1, -1]
            joints.append(joint)
        for k, size, (a, b) in zip(effects, sizes, pairwise(ends), strict=True):
            precision[a:b, a:b] += self.pool.ridge(k, size)
        return precision, side, joints, ends

    def cost(self, candidate: Candidate) -> float:
        """Log evidence penalty of nonlinear parameters chosen on the data (Schwarz, Ann. Statist. 6, 1978)."""
        chosen = candidate.effect.counted(candidate.settings)
        return 0.5 * float(np.log(self.noise.count)) * chosen

    def _unexplained(self, j: int, joint: JointMoments, mean: np.ndarray) -> float:
        """Squared torque over nominal that remains beyond the noise model's usual energy."""
        weights, energy, shared = np.append(mean, -1.0), np.diag(joint.noise), self.noise.shared_count(j)
        usual = self.noise.variance(j, 1.0, 0.0, {}) * energy[:shared].sum() + energy[shared:].sum()
        usual = 1 + float(usual) / self.noise.count
        excess = max(float(weights @ joint.own @ weights) / self.noise.count - usual, 0.0)
        return excess / float(self.noise.nominal_over_sigma[j]) ** 2


def _varying_friction(fit: Fit) -> np.ndarray:
    """Parameters that differ from day to day: friction of a model that was estimated before on the machine."""
    if not fit.has_own_error:
        return np.empty(0, dtype=int)
    model = fit.reference.model
    friction = [k for k, term in enumerate(model.terms, len(model.independent)) if term.form != "offset"]
    return np.array([k for k in friction if model.values[k] != 0], dtype=int)


def _prior_with_daily_friction(fit: Fit, friction: np.ndarray, daily: float) -> np.ndarray:
    """(p, p) prior precision of the model's parameters, whose friction differs from day to day by a share of itself."""
    spread = np.diag((daily * fit.reference.model.values[friction]) ** -2.0)
    gain = np.linalg.solve(fit.precision[np.ix_(friction, friction)] + spread, fit.precision[friction])
    return np.asarray(fit.precision - fit.precision[:, friction] @ gain)


def _nearest(sizes: Sequence[float], size: float) -> float:
    return min(sizes, key=lambda s: abs(np.log(s / max(size, 1e-6))))
