"""Structure that an arm has beyond bodies and friction, as part of an estimated model.

Counterbalances, springs and hoses are effects of the catalogue. An effect is added under two conditions. The diagnosis
of the same logs, without an external reference, calls it `explained`, or `ambiguous` only with another law of the same
joint's position. And it clearly improves the prediction of held-out motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.extension import extended_model
from agent.diagnosis.workflow import diagnose
from agent.model import IdentifiedModel
from agent.recording import Log
from agent.robot import RobotDescription

_LEAST_GAIN = 0.05  # of the squared error held out, each joint over its own without effects


def with_structure(
    robot: RobotDescription, logs: Sequence[Log], model: IdentifiedModel, progress: Callable[[str], None]
) -> IdentifiedModel:
    """A model of these logs with the effects that they show, or as it was; a note says which and why.

    Raises:
        InputError: logs too short for parts of them to be held out.
    """
    found = diagnose(robot, logs, None, model.cutoff, progress=progress)
    if found.verdict != "explained" and not _by_any_name(found):
        reason = f"the diagnosis of these logs without a given model says {found.verdict}, not explained"
        return _noted(model, f"no effect of the catalogue is added: {reason}.")
    extended = extended_model(found)
    if not extended.effects:
        return _noted(model, "no effect of the catalogue is added: what was found happens once, or in the set-points.")
    held_out = np.asarray(found.gap.after) * found.gap.unit
    error = float(np.mean((held_out / model.held_out_rmse) ** 2))
    names = " and ".join(f"{e.effect} on {', '.join(e.joints) or 'the whole arm'}" for e in extended.effects)
    figure = f"{np.sqrt(error):.3f} of the held-out error without"
    if error > 1 - _LEAST_GAIN:
        return _noted(model, f"{names} would explain a gap, but leaves {figure}, so nothing is added.")
    changed = replace(
        extended,
        held_out_rmse=held_out,
        group_rmse=None if model.group_rmse is None else model.group_rmse * (held_out / model.held_out_rmse),
    )
    return _noted(
        changed,
        f"{names} is part of the model: found by the diagnosis, {figure} (root mean square over joints). Standard "
        "deviations are those of the bodies and friction, fitted before.",
    )


def _by_any_name(found: Diagnosis) -> bool:
    """Whether what equals the causes predicts as they do: a straight line over position is a spring or a hose."""
    if found.verdict != "ambiguous":
        return False
    causes = zip(found.selected.causes, found.selected.rivals, strict=True)
    return all(
        "position" in cause.effect.shapes and joints == cause.joints and name in cause.effect.structurally_equivalent
        for cause, rivals in causes
        for name, joints in rivals
    )


def _noted(model: IdentifiedModel, text: str) -> IdentifiedModel:
    return replace(model, notes=(*model.notes, f"Structure: {text}"))
