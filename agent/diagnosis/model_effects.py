"""Effects as part of a model: what a diagnosis found predicts torque wherever the model does."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.diagnosis.effects import CATALOGUE
from agent.diagnosis.signals import Reference, Signals
from agent.errors import InputError
from agent.estimation.model import EFFECTS, IdentifiedModel, ModelEffect

if TYPE_CHECKING:
    from agent.diagnosis.result import Diagnosis


def effect_torque(model: IdentifiedModel, entry: ModelEffect, motion: dict[str, Any], torque: np.ndarray) -> np.ndarray:
    """(S, n) joint torque [N·m] of one effect on a motion (time, q, qd, qdd as arrays; `log` counts the logs of a fit).

    Raises:
        InputError: parameters or joints that the effect does not have, or a motion without times.
    """
    effect = CATALOGUE[entry.effect]
    names_of = model.robot.joint_names
    try:
        joints = tuple(names_of.index(name) for name in entry.joints)
        names = effect.names(entry.parameters)
        values = np.array([entry.parameters[name] for name in names], dtype=float)
    except (KeyError, ValueError) as error:
        raise InputError(f"the model's effect {entry.effect}: {error} is missing or unknown") from None
    if motion["time"] is None:
        raise InputError(f"the model's effect {entry.effect} needs the times of the samples")
    settings = {key: value for key, value in entry.parameters.items() if key not in names}
    signals = Signals(Reference(model), motion["time"], motion["q"], motion["qd"], motion["qdd"], motion.get("log", -1))
    total = np.zeros_like(torque)
    for joint, columns in effect.columns(signals, joints, settings).items():
        total[:, joint] += columns @ values
    return total


def extended_model(diagnosis: Diagnosis, without: int | None = None, once: bool = False) -> IdentifiedModel:
    """The model with the effects found, its parameters moved as far as the fit with them moved them.

    Args:
        without: fitted to all logs but this one; to all of them if None.
        once: with what happened once (a contact), which another motion knows nothing of.
    """
    fit, model = diagnosis.finding.fit, diagnosis.dataset.model
    names = model.robot.joint_names
    change, fitted = fit.fitted(None if without is None else fit.folds[without])
    effects = tuple(
        ModelEffect(
            candidate.effect.name,
            tuple(names[j] for j in candidate.joints),
            {**candidate.settings, **dict(zip(candidate.names, map(float, values), strict=True))},
        )
        for candidate, values in zip(fit.chosen, fitted, strict=True)
        if once or not candidate.effect.once
    )
    return replace(model, values=model.values + change, effects=(*model.effects, *effects))


EFFECTS.update({name: effect_torque for name in CATALOGUE})
