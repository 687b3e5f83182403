"""How much of every effect an arm has while it is healthy: learned from its baseline, one log left out at a time.

A model of the other logs errs on the one that is left out. What an effect explains of that error is the model's own, or
the arm's: a balancer that no parameter stands for, a drive that is warmer on some days. Judged logs have to show more.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.diagnosis.background import Healthy
from agent.diagnosis.candidate import Candidate, Where
from agent.diagnosis.dataset import assemble
from agent.diagnosis.evidence import Evidence
from agent.diagnosis.fit import Fit
from agent.diagnosis.search import Search
from agent.estimation import EstimationSettings, estimate
from agent.model import CATALOGUE, HealthyEffect, IdentifiedModel
from agent.recording import Log

_LONGEST = 60.0  # s of a log that are looked at


def with_healthy_effects(
    model: IdentifiedModel, baseline: Sequence[Log], held_out: Sequence[Log] = ()
) -> IdentifiedModel:
    """Return the model with what the effects explain of its error on motions that it was not fitted to.

    Each log of the baseline is judged by a model of the others; logs that were `held_out` already by the model itself.
    With one log alone nothing can be learned, and the model is returned as it is.
    """
    power: dict[Where, float] = {}
    best: dict[Where, tuple[float, dict[str, float]]] = {}
    fits = list(_fits(model, [_first_minute(log) for log in baseline], [_first_minute(log) for log in held_out]))
    for fit in fits:
        for place, gain, form, size in _explained(fit):
            power[place] = power.get(place, 0.0) + size**2 / len(fits)
            if gain > best.get(place, (0.0, {}))[0]:
                best[place] = gain, form
    names = model.robot.joint_names
    healthy = tuple(
        HealthyEffect(effect, tuple(names[j] for j in joints), best[effect, joints][1], float(np.sqrt(total)))
        for (effect, joints), total in power.items()
    )
    return replace(model, healthy=healthy)


def _first_minute(log: Log) -> Log:
    start = float(log.t[0])
    return log if log.t[-1] - start <= _LONGEST else log.between(start, start + _LONGEST)


def _fits(model: IdentifiedModel, baseline: Sequence[Log], held_out: Sequence[Log]) -> Iterator[Fit]:
    if held_out:
        yield assemble(model.robot, model, held_out, model.cutoff).fit
    settings = EstimationSettings.create(cutoff=model.cutoff)
    for log in baseline if len(baseline) > 1 else ():
        with suppress(InputError):  # the others are too little for a model
            others = estimate(model.robot, [other for other in baseline if other is not log], settings)
            yield assemble(model.robot, others, [log], model.cutoff).fit


def _explained(fit: Fit) -> list[tuple[Where, float, dict[str, float], float]]:
    """Per place whose evidence grows by an effect: the gain, its nonlinear parameters, and its torque over nominal."""
    forms = Search(fit).forms()
    evidence = Evidence(fit, forms)
    gains, values = evidence.gains(evidence.nothing)
    found: dict[Where, tuple[Where, float, dict[str, float], float]] = {}
    for number in np.argsort(-gains).tolist():
        form, gain = forms[number], float(gains[number])
        if gain > 0 and not form.once and form.place not in found:
            size = max(evidence.torque(number, values[number]).values(), default=0.0)
            found[form.place] = form.place, gain, dict(form.settings), size
    return list(found.values())


def healthy_on(fit: Fit, model: IdentifiedModel, without: Collection[str] = ()) -> Healthy:
    """Return what the model's arm has of the effects, on other logs; those `without` are left out.

    In the form found, and in one of every other kind of form that the effect has.
    """
    names, found = list(model.robot.joint_names), list[tuple[Candidate, float]]()
    for one in model.healthy:
        if one.effect not in CATALOGUE or one.effect in without or not set(one.joints) <= set(names):
            continue
        effect, joints = CATALOGUE[one.effect], tuple(map(names.index, one.joints))
        kinds = {tuple(sorted(settings)): settings for settings in effect.settings(fit, joints)}
        if tuple(sorted(one.settings)) in kinds:
            kinds[tuple(sorted(one.settings))] = one.settings
        found += [(form, one.size) for form in fit.candidates([(effect, joints, kind) for kind in kinds.values()])]
    return found
