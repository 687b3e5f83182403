"""How much of every effect an arm has while it is healthy: learned from its baseline, one log left out at a time.

A model of the other logs errs on the one that is left out. What an effect explains of that error is the model's own, or
the arm's: a balancer that no parameter stands for, a drive that is warmer on some days. Judged logs have to show more.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.noise_model import Healthy
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.rows.candidate import Candidate, Place
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.fit import Fit
from agent.estimation import EstimationSettings, estimate
from agent.model import CATALOGUE, HealthyEffect, IdentifiedModel
from agent.recording import Log

_LONGEST = 60.0  # s of a log that are looked at


def with_healthy_effects(
    model: IdentifiedModel, baseline: Sequence[Log], held_out: Sequence[Log] = ()
) -> IdentifiedModel:
    """Return the model with what the effects explain of its error while the arm is healthy.

    Each log of the baseline is judged by a model of the others, and all of them by the model itself, whose choice of
    terms may differ; logs that were `held_out` by the model itself. With one log alone nothing can be learned, and the
    model is returned as it is.
    """
    baseline, held_out = ([_first_minute(log) for log in logs] for logs in (baseline, held_out))
    found = _Learned()
    if judged := held_out or (baseline if len(baseline) > 1 else []):
        found.add([assemble(model.robot, model, judged, model.cutoff).fit])
    found.add(_left_out(model, baseline))
    return replace(model, healthy=found.effects(model.robot.joint_names))


class _Learned:
    """Per hypothesis: the explained torque over nominal, and the nonlinear parameters with the largest gain."""

    def __init__(self) -> None:
        self.size: dict[Place, float] = {}
        self._best: dict[Place, tuple[float, dict[str, float]]] = {}

    def add(self, fits: Iterable[Fit]) -> None:
        """Take what n fits have, where it is larger than what was found before.

        The mean square over n - 2: the variance of Student's predictive distribution with n degrees of freedom, as
        few logs say little about how large an effect can become on a healthy arm.
        """
        power: dict[Place, list[float]] = {}
        count = 0
        for fit in fits:
            count += 1
            for place, gain, form, size in _explained(fit):
                power.setdefault(place, []).append(size**2)
                if gain > self._best.get(place, (0.0, {}))[0]:
                    self._best[place] = gain, form
        for place, squares in power.items():
            self.size[place] = max(self.size.get(place, 0.0), float(np.sqrt(sum(squares) / max(count - 2, 1))))

    def effects(self, names: Sequence[str]) -> tuple[HealthyEffect, ...]:
        """As the model keeps them."""
        return tuple(
            HealthyEffect(effect, tuple(names[j] for j in joints), self._best[effect, joints][1], size)
            for (effect, joints), size in self.size.items()
        )


def _first_minute(log: Log) -> Log:
    start = float(log.t[0])
    return log if log.t[-1] - start <= _LONGEST else log.between(start, start + _LONGEST)


def _left_out(model: IdentifiedModel, baseline: Sequence[Log]) -> Iterator[Fit]:
    settings = EstimationSettings.create(cutoff=model.cutoff)
    for log in baseline if len(baseline) > 1 else ():
        with suppress(InputError):  # the others are too little for a model
            others = estimate(model.robot, [other for other in baseline if other is not log], settings)
            yield assemble(model.robot, others, [log], model.cutoff).fit


def _explained(fit: Fit) -> list[tuple[Place, float, dict[str, float], float]]:
    """Hypotheses with a positive gain: log-likelihood gain, nonlinear parameters and torque over nominal of each."""
    forms = Search(fit).forms()
    evidence = Evidence(fit, forms, healthy=())
    gains, values = evidence.shortlist_gains(evidence.nothing)
    found: dict[Place, tuple[Place, float, dict[str, float], float]] = {}
    for number in np.argsort(-gains).tolist():
        form, gain = forms[number], float(gains[number])
        if gain > 0 and not form.once and form.place not in found:
            size = max(evidence.pool.torque(number, values[number]).values(), default=0.0)
            found[form.place] = form.place, gain, dict(form.settings), size
    return list(found.values())


def healthy_on(fit: Fit, model: IdentifiedModel, without: Collection[str] = ()) -> Healthy | None:
    """Return what the model's arm has of the effects, on other logs; those `without` are left out.

    In the form found, and in one of every other kind of form that the effect has. None where nothing was learned.
    """
    if not model.healthy:
        return None
    names, found = list(model.robot.joint_names), list[tuple[Candidate, float]]()
    for one in model.healthy:
        if one.effect not in CATALOGUE or one.effect in without or not set(one.joints) <= set(names):
            continue
        effect, joints = CATALOGUE[one.effect], tuple(map(names.index, one.joints))
        kinds = {tuple(sorted(settings)): settings for settings in effect.settings(fit, joints)}
        if tuple(sorted(one.settings)) in kinds:
            kinds[tuple(sorted(one.settings))] = one.settings
        forms = fit.candidates([(effect, joints, kind) for kind in kinds.values()])
        found += [(form, one.size) for form in forms if form.stable]
    return found
