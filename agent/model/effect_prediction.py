"""Effects as part of a model: what a diagnosis found predicts torque wherever the model does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from agent.core import InputError
from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects import CATALOGUE
from agent.model.rigid_friction import ModelEffect, RigidFrictionModel


def effect_torque(
    model: RigidFrictionModel, entry: ModelEffect, motion: Mapping[str, Any], reference: NominalModel | None = None
) -> np.ndarray:
    """(S, n) joint torque [N·m] of one effect on a motion (time, q, qd, qdd as arrays; `log` counts the logs of a fit).

    Args:
        model: whose robot and friction the effect acts on.
        entry: the effect, with its joints and parameters.
        motion: `time` (S,) [s], `q`, `qd` and `qdd` (S, n); `log` counts the logs of a fit.
        reference: the model in parts, if they are known.

    Raises:
        InputError: an effect that is neither built in nor installed, parameters or joints that it does not have, or
            that give no finite torque, or a motion without times.
    """
    if entry.effect not in CATALOGUE:
        raise InputError(f"the model has an effect {entry.effect!r} that this version cannot evaluate")
    effect = CATALOGUE[entry.effect]
    joint_names = model.robot.joint_names
    try:
        joints = tuple(joint_names.index(name) for name in entry.joints)
        names = effect.names(entry.parameters)
        values = np.array([entry.parameters[name] for name in names], dtype=float)
    except (KeyError, ValueError) as error:
        raise InputError(f"the model's effect {entry.effect}: {error} is missing or unknown") from None
    if motion["time"] is None:
        raise InputError(f"the model's effect {entry.effect} needs the times of the samples")
    settings = {key: value for key, value in entry.parameters.items() if key not in names}
    reference = reference or NominalModel(model)
    signals = MotionSignals(reference, motion["time"], motion["q"], motion["qd"], motion["qdd"], motion.get("log", -1))
    total = np.zeros(signals.q.shape)
    with np.errstate(all="ignore"):
        for joint, columns in effect.columns(signals, joints, settings).items():
            total[:, joint] += columns @ values
    if not np.all(np.isfinite(total)):
        parameters = ", ".join(f"{name} {value:g}" for name, value in entry.parameters.items())
        raise InputError(
            f"the model's effect {entry.effect} gives no finite torque with {parameters}: estimate it again"
        )
    return total


def known_effects(model: RigidFrictionModel, signals: MotionSignals) -> np.ndarray:
    """Filtered torque (S', n) of the effects that the model has already."""
    total = np.zeros(signals.q.shape)
    motion = {"time": signals.time, "q": signals.q, "qd": signals.qd, "qdd": signals.qdd}
    for entry in model.effects:
        total = total + effect_torque(model, entry, motion)
    return signals.low_pass(total)
