"""How much of every effect an arm has while it is healthy: learned from its baseline, one log left out at a time.

A model of the other logs errs on the one that is left out. What an effect explains of that error is the model's own, or
the arm's: a balancer that no parameter stands for, a drive that is warmer on some days. Judged logs have to show more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.diagnosis.candidate import Where
from agent.diagnosis.dataset import assemble
from agent.diagnosis.fit import Fit
from agent.estimation import EstimationSettings, estimate
from agent.model import CATALOGUE
from agent.recording import Log
from agent.robot import RobotDescription
from benchmarks.evidence_law.background import Healthy
from benchmarks.evidence_law.evidence import Evidence
from benchmarks.evidence_law.search import Search


@dataclass(frozen=True)
class UsualEffect:
    """An effect at a place, its nonlinear parameters, and its torque over nominal, root mean square over the logs."""

    place: Where
    settings: dict[str, float]
    size: float


def usual_effects(robot: RobotDescription, baseline: Sequence[Log], cutoff: float) -> list[UsualEffect]:
    """Return what the effects explain of a baseline, each log judged by a model of the others.

    Raises:
        InputError: fewer than two logs, or logs that no model can be fitted to.
    """
    power: dict[Where, float] = {}
    best: dict[Where, tuple[float, dict[str, float]]] = {}
    for log in baseline:
        model = estimate(
            robot, [other for other in baseline if other is not log], EstimationSettings.create(cutoff=cutoff)
        )
        search = Search(assemble(robot, model, [log], cutoff).fit)
        forms = search.forms()
        evidence = Evidence(search.fit, forms)
        gains, values = evidence.gains(evidence.nothing)
        order = np.argsort(-gains).tolist()
        seen: set[Where] = set()
        for number in order:
            form = forms[number]
            if gains[number] <= 0 or form.once or form.place in seen:
                continue
            seen.add(form.place)
            size = max(evidence.torque(number, values[number]).values(), default=0.0)
            power[form.place] = power.get(form.place, 0.0) + size**2 / len(baseline)
            if gains[number] > best.get(form.place, (0.0, {}))[0]:
                best[form.place] = gains[number], dict(form.settings)
    return [UsualEffect(place, best[place][1], float(np.sqrt(total))) for place, total in power.items()]


def on(fit: Fit, usual: Sequence[UsualEffect]) -> Healthy:
    """Return the same effects on other logs of the arm, in the form found and in every other kind of form."""
    found = []
    for one in usual:
        effect, joints = CATALOGUE[one.place[0]], one.place[1]
        kinds = {tuple(sorted(one.settings)): one.settings}
        for settings in effect.settings(fit, joints):
            kinds.setdefault(tuple(sorted(settings)), settings)
        found += [(form, one.size) for form in fit.candidates([(effect, joints, kind) for kind in kinds.values()])]
    return found
