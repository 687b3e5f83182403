"""What a diagnosis could have reached: the true structure refitted to the same data, and two controls that are wrong.

All three go through the diagnosis' own fit, fold by fold (`agent.diagnosis.Trial`): the oracle is given which effects
sit where and looks for their parameters only; `wrong` is another effect with as many parameters in the same place;
`black box` is as many smooth random functions of that joint's position, speed, acceleration and load.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.diagnosis import Diagnosis, Trial
from agent.model import CATALOGUE, Effect

if TYPE_CHECKING:
    from agent.model import Columns, MotionSignals


class BlackBox(Effect):
    """`n_parameters` smooth random functions on one joint."""

    name = "black_box"
    formula = "tanh(wᵀ x + b), x of position, speed, acceleration and load, each over its spread"
    source = "random features (Rahimi, Recht, NIPS 2007)"
    signature = look_at = "none"

    def __init__(self, n_parameters: int, seed: int):
        rng = np.random.default_rng([seed, 41])
        self._weights, self._bias = rng.normal(size=(4, n_parameters)), rng.uniform(-2, 2, n_parameters)

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return tuple(f"w{k}" for k in range(len(self._bias)))

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
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


def reference_closures(diagnosis: Diagnosis, effects: Sequence[Mapping[str, Any]], seed: int) -> dict[str, Any]:
    """Closures by the definition of the diagnosis: `oracle`, `wrong` (and its name), `black_box`.

    Empty where a true effect shows in no torque or has no fitted form.
    """
    trial = Trial(diagnosis)
    chosen: list[Any] = []
    for effect in effects:
        if effect["effect"] not in CATALOGUE or CATALOGUE[effect["effect"]].shows_in == "path":
            return {}
        found = trial.best(effect["effect"], effect["joints"], chosen)
        if found is None:
            return {}
        chosen.append(found)
    n_parameters = max(1, trial.n_parameters(chosen))
    joint = next((effect["joints"][0] for effect in effects if effect["joints"]), trial.worst_joint)
    name = _wrong(trial.parameter_counts(joint), {effect["effect"] for effect in effects}, n_parameters, seed)
    wrong = trial.best(name, [joint]) if name else None
    black_box = trial.best(BlackBox(n_parameters, seed), [joint])
    return {
        "oracle": trial.closure(chosen),
        "wrong": trial.closure([wrong]) if wrong else None,
        "wrong_effect": wrong.effect.name if wrong else None,
        "black_box": trial.closure([black_box]) if black_box else None,
        "n_parameters": n_parameters,
    }


def _wrong(parameter_counts: Mapping[str, int], true: set[str], n_parameters: int, seed: int) -> str | None:
    """An effect that is not there, with the number of parameters nearest to the truth's; drawn among equals."""
    names = [name for name in parameter_counts if name not in true]
    drawn = [str(name) for name in np.random.default_rng([seed, 42]).permutation(names)]
    return min(drawn, key=lambda name: abs(parameter_counts[name] - n_parameters), default=None)
