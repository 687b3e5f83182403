"""How much of every effect an arm has while it is healthy: learned from its baseline, one log left out at a time.

A model of the other logs errs on the one that is left out. What an effect explains of that error is the model's own, or
the arm's: a balancer that no parameter stands for, a drive that is warmer on some days. Judged logs have to show more.
What an arm has is kept as parameters, not as torque: a delay is the same on a faster motion, and its torque is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import median_low

import numpy as np

from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.noise_model import Healthy, HealthyForm
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate, EffectKey
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE, HealthyEffect, IdentifiedModel
from agent.recording import Log

_LONGEST = 30.0  # s of a log that are looked at
_TRANSIENT = [effect.name for effect in CATALOGUE.values() if effect.transient]
_INVISIBLE = 1e-9  # torque over nominal of a unit of a parameter, up to which it shows nothing


def with_healthy_effects(
    model: IdentifiedModel, baseline: Sequence[Log], held_out: Sequence[Log] = ()
) -> IdentifiedModel:
    """Return the model with its error in motion, and what the effects explain of that while the arm is healthy.

    Each log of the baseline is judged by parameters fitted to the others, and logs that were `held_out` by the model
    itself, all together. One log alone is judged by halves: they show, for one, a torque that its recorder delays.

    Args:
        model: identified from the baseline.
        baseline: logs of the healthy arm.
        held_out: healthy logs that the model was not fitted to.
    """
    baseline, held_out = ([_beginning(log) for log in logs] for logs in (baseline, held_out))
    if alone := len(baseline) == 1 and not held_out:
        baseline = _halves(baseline[0])
    learned = [_judged(model, held_out)] if held_out else []
    learned += [_left_out(model, baseline)] if len(baseline) > 1 else []
    largest: dict[EffectKey, tuple[float, list[HealthyEffect]]] = {}
    for _, candidates, shown in learned:
        for key, (size, entries) in _effects(candidates, shown, model.robot.joint_names).items():
            if size >= largest.get(key, (0.0, []))[0]:
                largest[key] = size, entries
    healthy = [entry for _, entries in largest.values() for entry in entries]
    healthy = [replace(entry, value={}) if alone else entry for entry in healthy]
    if not learned:
        return replace(model, healthy=tuple(healthy))
    sliding = np.max([error for error, *_ in learned], axis=0)
    share = np.max([np.mean([of_log.noise_share for of_log in shown], axis=0) for *_, shown in learned], axis=0)
    return replace(model, sliding_rmse=sliding, noise_share=share, healthy=tuple(healthy))


def _beginning(log: Log) -> Log:
    start = float(log.t[0])
    return log if log.t[-1] - start <= _LONGEST else log.between(start, start + _LONGEST)


def _halves(log: Log) -> list[Log]:
    """Both halves of a log, or the log if it has gaps or they would be too short to be judged."""
    start, middle, end = float(log.t[0]), float(log.t[0] + log.t[-1]) / 2, float(log.t[-1])
    if len(log.segments) > 1 or middle - start < LIMITS.shortest:
        return [log]
    return [log.between(start, middle), log.between(middle, end)]


@dataclass(frozen=True, eq=False)
class LogEvidence:
    """What one log, or some together, show of each candidate: gain (N,), parameters (k,), torque (N,) over nominal, and
    root mean square (k,) of the torque over nominal of a unit of each parameter."""

    evidence: Evidence
    gains: np.ndarray
    values: list[np.ndarray]
    torque: np.ndarray
    rms: list[np.ndarray]

    @classmethod
    def of(cls, evidence: Evidence) -> LogEvidence:
        pool = evidence.pool
        gains, values = evidence.shortlist_gains(evidence.null_hypothesis)
        torque = [max(pool.torque(k, parameters).values(), default=0.0) for k, parameters in enumerate(values)]
        return cls(evidence, gains, values, np.array(torque), [pool.rms(k) for k in range(pool.size)])

    @property
    def noise_share(self) -> np.ndarray:
        """(n,) part of σ² that differs from row to row."""
        return np.minimum(self.evidence.null_hypothesis.scales, 1.0)

    @cached_property
    def detection_limit(self) -> np.ndarray:
        """(N,) torque over nominal up to which each candidate may be there unnoticed."""
        return np.array(self.evidence.smallest_sizes())


#: Error (n,) [N·m] of the model while joints slide, all candidates, and what logs show of them.
LearnedErrors = tuple[np.ndarray, Sequence[Candidate], list[LogEvidence]]


def _judged(model: IdentifiedModel, logs: Sequence[Log]) -> LearnedErrors:
    """Logs that the model has not seen, all together."""
    dataset = assemble(model.robot, model, logs, model.cutoff)
    sliding = _sliding_rmse(dataset.fit, dataset.residual)
    fit = dataset.fit.with_noise(sliding)
    return sliding, *_shown(fit, [(fit, slice(None))])


def _left_out(model: IdentifiedModel, logs: Sequence[Log]) -> LearnedErrors:
    """Each log under parameters that were fitted to the others."""
    fit = assemble(model.robot, model, logs, model.cutoff, refitted=True).fit
    sliding = _sliding_rmse(fit, _of_others(fit, len(logs))[0])
    fit = fit.with_noise(sliding)
    residual, precision = _of_others(fit, len(logs))
    unseen = fit.with_residual(residual / fit.sigma)  # as of a model of other logs
    fit = unseen.with_prior(np.mean(precision, axis=0), np.zeros(len(precision[0])))
    parts = [(fit.of_log(number, precision[number]), fit.rows_of(number)) for number in range(len(logs))]
    return sliding, *_shown(fit, parts)


def _of_others(fit: Fit, logs: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """(S', n) [N·m] residual of each log under parameters that were fitted to the others, and their covariances."""
    residual, precision = np.empty(fit.sigma.shape), list[np.ndarray]()
    for number in range(logs):
        rows = fit.rows_of(number)
        cells = np.unique(fit.cell_of_row[rows][fit.cell_of_row[rows] >= 0])
        folds = [fold for fold in fit.folds if fold.test[cells].any()]
        for fold in reversed(folds):  # a guard between parts of one log goes with the first
            judged = np.isin(fit.cell_of_row[rows], np.flatnonzero(fold.test)) | (fold is folds[0]) & (
                fit.cell_of_row[rows] < 0
            )
            residual[rows][judged] = fit.remaining(fit.solve(fold.train)[1])[rows][judged]
        precision.append(np.linalg.inv(fit.solve(folds[0].train)[0]))
    return residual, precision


def _sliding_rmse(fit: Fit, error: np.ndarray) -> np.ndarray:
    """(n,) [N·m] error (S', n) on motion that the model has not seen, away from standstills; at most σ.

    The error of the model's fit counts what the filter reaches from a standstill as motion. There stiction leaves the
    torque open, which a diagnosis knows, so the model would look worse than it is.
    """
    slides, most = ~fit.near_rest, fit.sigma.min(axis=0)
    count = slides.sum(axis=0)
    sliding = np.sqrt(np.sum(np.where(slides, error, 0.0) ** 2, axis=0) / np.maximum(count, 1))
    least = LIMITS.least_background * fit.reference.scale
    return np.where(count < LIMITS.min_samples, most, np.clip(sliding, np.minimum(least, most), most))


def _shown(fit: Fit, parts: Sequence[tuple[Fit, slice]]) -> tuple[Sequence[Candidate], list[LogEvidence]]:
    """All candidates, and what each part of the rows shows of them: a part has its fit, and some of the rows."""
    candidates, evidence = list[Candidate](), [Evidence(of_part, (), healthy=()) for of_part, _ in parts]
    for batch in Search(fit, _TRANSIENT).candidates():
        for of_part, (_, rows) in zip(evidence, parts, strict=True):
            of_part.pool.add([candidate.of_rows(rows) for candidate in batch])
        for candidate in batch:
            candidate.release()
        candidates += batch
    return candidates, [LogEvidence.of(of_part) for of_part in evidence]


def _effects(
    candidates: Sequence[Candidate], shown: Sequence[LogEvidence], names: Sequence[str]
) -> dict[EffectKey, tuple[float, list[HealthyEffect]]]:
    """Per hypothesis the explained torque over nominal, and one entry for the best candidate of each kind.

    The torque is the mean square over n - 2 of n logs, each explained by its best candidate: the variance of Student's
    predictive distribution with n degrees of freedom, as few logs say little about how large an effect can become.
    Drives of an arm follow one law, so a joint that shows nothing may have what the arm has (`_of_the_arm`), up to what
    its logs would have shown.
    """
    total = np.sum([of_log.gains for of_log in shown], axis=0)
    numbers_of: dict[EffectKey, list[int]] = {}
    for number in np.argsort(-total).tolist():
        if not candidates[number].transient:
            numbers_of.setdefault(candidates[number].key, []).append(number)
    sizes, shown_by_all = dict[EffectKey, float](), set[int]()
    for key, numbers in numbers_of.items():
        best = [(of_log, max(numbers, key=lambda k: of_log.gains[k])) for of_log in shown]
        squares = [of_log.torque[k] ** 2 for of_log, k in best if of_log.gains[k] > 0]
        sizes[key] = float(np.sqrt(sum(squares) / max(len(shown) - 2, 1)))
        shown_by_all.update(numbers[:1] if squares and total[numbers[0]] > 0 else [])

    def detection_limit(key: EffectKey) -> float:
        return min(float(of_log.detection_limit[numbers_of[key]].min()) for of_log in shown)

    effects = {}
    for key, numbers in numbers_of.items():
        size = sizes[key]
        if not size and (size := _of_the_arm(key[0], sizes, detection_limit)):
            size = min(size, detection_limit(key))
        kinds = {tuple(sorted(candidates[k].settings)): k for k in reversed(numbers)}.values()
        if size > 0:
            effects[key] = size, [_entry(candidates[k], k, shown, size, names, k in shown_by_all) for k in kinds]
    return effects


def _of_the_arm(name: str, sizes: Mapping[EffectKey, float], detection_limit: Callable[[EffectKey], float]) -> float:
    """The median size of an effect over the joints.

    Of an effect that every arm has a little of, a joint that shows nothing counts only if its logs would have shown the
    largest: what it has is not known otherwise.
    """
    of_effect = {key: size for key, size in sizes.items() if key[0] == name}
    largest, usual = max(of_effect.values()), CATALOGUE[name].usual
    informative = [size for key, size in of_effect.items() if size or not usual or detection_limit(key) < largest]
    return median_low(informative) if largest else 0.0


def _entry(
    candidate: Candidate, number: int, shown: Sequence[LogEvidence], size: float, names: Sequence[str], with_value: bool
) -> HealthyEffect:
    """An effect of a size over nominal, shared alike by its parameters; `with_value`: with what all logs show."""
    rms = np.sqrt(np.mean([of_log.rms[number] ** 2 for of_log in shown], axis=0))
    some = rms > _INVISIBLE
    amount = np.where(some, size / np.sqrt(max(int(some.sum()), 1)) / np.maximum(rms, _INVISIBLE), 0.0)
    value: dict[str, tuple[float, float]] = {}
    if with_value and len(shown) > 1:
        each = np.array([of_log.values[number] for of_log in shown])
        deviation = np.sqrt(1 + 1 / len(shown)) * each.std(axis=0, ddof=1)
        value = dict(
            zip(candidate.names, zip(each.mean(axis=0).tolist(), deviation.tolist(), strict=True), strict=True)
        )
    joints = tuple(names[j] for j in candidate.joints)
    amounts = dict(zip(candidate.names, map(float, amount), strict=True))
    return HealthyEffect(candidate.effect.name, joints, dict(candidate.settings), amounts, value)


def healthy_on(fit: Fit, model: IdentifiedModel, without: Collection[str] = ()) -> Healthy | None:
    """Return what the model's arm has of the effects, on other logs; those `without` are left out.

    None where nothing was learned.
    """
    if not model.healthy:
        return None
    names = list(model.robot.joint_names)
    learned = [
        e for e in model.healthy if e.effect in CATALOGUE and e.effect not in without and {*e.joints} <= {*names}
    ]
    candidates = fit.candidates(
        [(CATALOGUE[e.effect], tuple(map(names.index, e.joints)), e.settings) for e in learned], rough=True
    )
    healthy = []
    for entry, candidate in zip(learned, candidates, strict=True):
        if candidate.stable and set(candidate.names) == set(entry.amount):
            value = np.array([entry.value[name] for name in candidate.names]) if entry.value else None
            mean, deviation = (None, None) if value is None else value.T
            healthy.append(
                HealthyForm(candidate, np.array([entry.amount[name] for name in candidate.names]), mean, deviation)
            )
    return healthy
