"""What a diagnosis could have reached: the true structure refitted to the same data, and two controls that are wrong.

All three go through the diagnosis' own fit, fold by fold: the oracle is told which effects sit where and looks for
their parameters only; `wrong` is another effect with as much freedom in the same place; `black box` is as many smooth
random functions of that joint's position, speed, acceleration and load.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from agent.diagnosis.dataset import Dataset
from agent.diagnosis.effects import CATALOGUE, Effect
from agent.diagnosis.effects.effect import Columns
from agent.diagnosis.fit import Candidate, Fit, Score
from agent.diagnosis.signals import Signals

_FACTORS = (1.25, 1.1, 1.05)


class BlackBox(Effect):
    """`freedom` smooth random functions on one joint."""

    name = "black_box"
    formula = "tanh(wᵀ x + b), x of position, speed, acceleration and load, each over its spread"
    source = "random features (Rahimi, Recht, NIPS 2008)"
    signature = look_at = "none"

    def __init__(self, freedom: int, seed: int):
        rng = np.random.default_rng([seed, 41])
        self._weights, self._bias = rng.normal(size=(4, freedom)), rng.uniform(-2, 2, freedom)

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return tuple(f"w{k}" for k in range(len(self._bias)))

    def columns(self, signals: Signals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        (k,) = joints
        limits = signals.reference.robot
        state = np.stack(
            [
                signals.q[:, k],
                3.0 * signals.qd[:, k] / limits.max_velocity[k],
                3.0 * signals.qdd[:, k] / limits.max_acceleration[k],
                3.0 * signals.rigid[:, k] / signals.reference.scale[k],
            ],
            axis=1,
        )
        return {k: np.tanh(state @ self._weights + self._bias)}


def reference_closures(
    dataset: Dataset, effects: Sequence[Mapping[str, Any]], gap: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Closures by the definition of the diagnosis, with its floor: `oracle`, `wrong` (and its name), `black_box`.

    Empty where no true effect shows in torque or has a fitted form.
    """
    robot, fit = dataset.robot, dataset.fit
    chosen: list[Candidate] = []
    for effect in effects:
        kind = CATALOGUE.get(effect["effect"])
        if kind is None or kind.name == "interpolator_mismatch":
            return {}
        joints = {robot.joint_names.index(name) for name in effect["joints"]}
        places = [place for place in kind.places(robot) if set(place) == joints]
        if not places or (found := best_fit(fit.with_chosen(chosen), kind, places[0])) is None:
            return {}
        chosen.append(found.candidate)
    freedom = max(1, sum(c.effect.freedom(c.settings) for c in chosen))
    joint = chosen[0].joints[0] if chosen[0].joints else int(np.argmax(gap["before"]))
    rng = np.random.default_rng([seed, 42])
    wrong = _wrong(fit, {c.effect.name for c in chosen}, joint, freedom, rng)
    black_box = fit.candidate(BlackBox(freedom, seed), (joint,), {})
    return {
        "oracle": closure(dataset, fit.with_chosen(chosen), gap),
        "wrong": closure(dataset, fit.with_chosen([wrong]), gap) if wrong else None,
        "wrong_effect": wrong.effect.name if wrong else None,
        "black_box": closure(dataset, fit.with_chosen([black_box]), gap),
        "freedom": freedom,
    }


def best_fit(fit: Fit, kind: Effect, joints: tuple[int, ...]) -> Score | None:
    """An effect in its place with the parameters that predict best; None where nothing can be tried."""
    scores = fit.score(fit.candidates([(kind, joints, settings) for settings in kind.settings(fit, joints)]))
    if not scores:
        return None
    best = max(scores, key=lambda score: score.gain)
    for factor in _FACTORS:
        now = best.candidate.settings
        wanted = [
            (kind, joints, {**now, name: now[name] * scale})
            for name in kind.refined
            if name in now
            for scale in (1 / factor, factor)
        ]
        best = max([best, *fit.score(fit.candidates(wanted))], key=lambda score: score.gain)
    return best


def _wrong(fit: Fit, true: set[str], joint: int, freedom: int, rng: np.random.Generator) -> Candidate | None:
    """An effect that is not there, on the same joint, with the freedom nearest to the truth's; drawn among equals."""
    names = [n for n, e in CATALOGUE.items() if n not in true and e.scope == "joint" and not e.once]
    distances = {}
    for name in rng.permutation(names):
        kind = CATALOGUE[str(name)]
        if (joint,) in kind.places(fit.reference.robot) and (settings := kind.settings(fit, (joint,))):
            distances[kind] = abs(kind.freedom(settings[0]) - freedom)
    if not distances:
        return None
    found = best_fit(fit, min(distances, key=lambda kind: distances[kind]), (joint,))
    return None if found is None else found.candidate


def closure(dataset: Dataset, fit: Fit, gap: Mapping[str, Any]) -> float | None:
    """(B² − A²) / (B² − F²) with B and F as the diagnosis reports them."""
    robot = dataset.robot
    unit = np.where(np.isfinite(robot.nominal_torque), robot.nominal_torque, 1.0)
    left = fit.out_of_fold(any(c.effect.once for c in fit.chosen)) / unit
    after = float(np.mean(np.nanmean(left**2, axis=0)))
    before = float(np.mean(np.square(gap["before"])))
    floor = 0.0 if gap["floor"] is None else float(np.mean(np.square(gap["floor"])))
    return None if before < 1.1**2 * floor or before <= 0 else (before - after) / (before - floor)
