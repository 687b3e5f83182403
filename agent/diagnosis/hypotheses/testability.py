"""Detection limits of these motions: the smallest size at which each effect would be found."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.diagnosis.document import EffectPower, NotTestable
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.rows.candidate import EffectKey
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.needs import MotionCoverage
from agent.model import CATALOGUE, Effect

_NO_TORQUE = "no torque was recorded: what happens once is not tried on a simulated motion"


def smallest_sizes(dataset: Dataset, evidence: Evidence) -> dict[EffectKey, float]:
    """Return the smallest detectable size of every effect on every joint, over its practical size.

    Four of five draws of that size would be named. It is infinite where the motions lack what the effect needs; what
    happens once has none.
    """
    coverage = MotionCoverage.of(dataset.fit.signals)
    smallest: dict[EffectKey, float] = {}
    for number, size in enumerate(evidence.smallest_sizes()):
        candidate = evidence.pool.candidate(number)
        if not candidate.transient:
            key = candidate.key
            smallest[key] = min(smallest.get(key, np.inf), size / candidate.effect.practical)
    for effect in CATALOGUE.values():
        for joints in () if effect.transient or effect.shows_in == "path" else effect.possible_joints(dataset.robot):
            if (effect.name, joints) not in smallest and coverage.lacking(effect, joints):
                smallest[effect.name, joints] = np.inf
    return smallest


def power(dataset: Dataset, search: Search, sizes: Mapping[EffectKey, float]) -> list[EffectPower]:
    """Return the smallest size of every allowed effect that would be found; `sizes` as of `smallest_sizes`.

    A joint that never moved has an entry only for effects that would have shown without motion.
    """
    robot, scale, entries = dataset.robot, dataset.fit.reference.scale, []
    moved = search.coverage.moved
    for (name, joints), size in sizes.items():
        if name not in search.allowed or not (np.isfinite(size) or moved[list(joints)].all()):
            continue
        joint_index = list(joints) if joints else slice(None)
        unit = 1.0 if np.isfinite(robot.nominal_torque[joint_index]).all() else float(scale[joint_index].max())
        practical = CATALOGUE[name].practical * unit
        where = ", ".join(robot.joint_names[j] for j in joints) or None
        smallest = float(f"{size * practical:.3g}") if np.isfinite(size) else None  # no more digits mean anything
        entries.append(EffectPower(name, where, smallest, practical))
    return entries


def not_testable(dataset: Dataset, search: Search, sizes: Mapping[EffectKey, float]) -> list[NotTestable]:
    """Return the effects whose practical size would not be found on these motions, and why; `sizes` as above."""
    robot = dataset.robot
    result = []
    for name, effect in CATALOGUE.items():
        if name not in search.allowed or effect.shows_in == "path":
            continue
        for joints in effect.possible_joints(robot):
            where = ", ".join(robot.joint_names[j] for j in joints) or None
            why = search.coverage.lacking(effect, joints)
            if not why and (name, joints) not in sizes:
                why = "" if effect.transient else effect.why_absent
            elif not why and sizes[name, joints] > 1:
                nominal = robot.nominal_torque[list(joints) if joints else slice(None)]
                unit = "% of nominal torque" if np.isfinite(nominal).all() else "times the model's held-out error"
                why = _why_small(effect, sizes[name, joints], dataset.has_reference, unit)
            if why:
                result.append(NotTestable(name, where, why))
    if dataset.servos is not None:
        result += [NotTestable(name, None, _NO_TORQUE) for name, effect in CATALOGUE.items() if effect.transient]
    return result + [NotTestable(name, None, why) for why in _lacking_paths(dataset) for name in effects_of_path()]


def _lacking_paths(dataset: Dataset) -> list[str]:
    names = {"planned": "planned_position", "executed": "reference_position"}
    there = {name: [getattr(log, key) is not None for log in dataset.logs] for name, key in names.items()}
    if any(map(all, zip(*there.values(), strict=True))):
        return []
    lacking = [name for name, some in there.items() if not any(some)]
    return [f"the logs lack {' and '.join(lacking) or 'planned and executed'} set-points"]


def effects_of_path() -> list[str]:
    """Return the effects that show in the set-points alone."""
    return [name for name, effect in CATALOGUE.items() if effect.shows_in == "path"]


def _why_small(effect: Effect, size: float, has_reference: bool, unit: str) -> str:
    """`size` in practical sizes: the smallest that would be found."""
    if not has_reference:
        return "no model was given: the fit to these logs absorbs it"
    text = f"it would be found from {100 * size * effect.practical:.1f} {unit} on"
    if not size * effect.practical < 1:  # of nominal torque
        text = "no size would be found"
    return f"on these motions {text}, and it matters from {100 * effect.practical:.1f} {unit.split()[0]} on"
