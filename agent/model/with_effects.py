"""Effects as part of a model: what a diagnosis found predicts torque wherever the model does."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.core import InputError
from agent.model.data import ModelEffect
from agent.model.effects import CATALOGUE
from agent.model.identified import EFFECTS, IdentifiedModel
from agent.model.signals import MotionSignals, NominalModel


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
    signals = MotionSignals(
        NominalModel(model), motion["time"], motion["q"], motion["qd"], motion["qdd"], motion.get("log", -1)
    )
    total = np.zeros_like(torque)
    for joint, columns in effect.columns(signals, joints, settings).items():
        total[:, joint] += columns @ values
    return total


def register() -> None:
    """Let models evaluate every effect of the catalogue."""
    EFFECTS.update(dict.fromkeys(CATALOGUE, effect_torque))
