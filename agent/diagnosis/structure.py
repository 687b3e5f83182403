"""Structure that an arm has beyond bodies and friction, as part of an estimated model.

Counterbalances, springs and hoses are effects of the catalogue. An effect is added under two conditions. The diagnosis
of the same logs, without an external reference, calls it `explained`, or `ambiguous` only with another law of the same
joint's position. And the model with it, all parameters fitted again, clearly predicts held-out motion better than the
same model without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.extension import extended_model
from agent.diagnosis.gap.torque_gap import rms
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.workflow import diagnose
from agent.model import IdentifiedModel
from agent.recording import Log
from agent.robot import RobotDescription


def with_structure(
    robot: RobotDescription, logs: Sequence[Log], model: IdentifiedModel, progress: Callable[[str], None]
) -> IdentifiedModel:
    """A model of these logs with the effects that they show, or as it was; a note says which and why.

    Args:
        robot: description of the arm.
        logs: that the model was fitted to.
        model: of bodies and friction.
        progress: called with what is being done.

    Raises:
        InputError: logs too short for parts of them to be held out.
    """
    diagnosis = diagnose(robot, logs, None, model.cutoff, progress=progress)
    if diagnosis.verdict != "explained" and not _by_any_name(diagnosis):
        reason = f"the diagnosis of these logs without a given model says {diagnosis.verdict}, not explained"
        return _noted(model, f"no effect of the catalogue is added: {reason}.")
    lasting = [cause for cause in diagnosis.selected.causes if not cause.transient]
    if not lasting:
        return _noted(model, "no effect of the catalogue is added: what was found happens once, or in the set-points.")
    fit = assemble(robot, model, logs, model.cutoff, refitted=True).fit
    forms = fit.candidates([(cause.effect, cause.joints, cause.settings) for cause in lasting])
    extended = fit.with_chosen(forms)
    before, after = (rms(of_model.held_out()) for of_model in (fit, extended))
    error = float(np.sum((after / model.held_out_rmse) ** 2) / np.sum((before / model.held_out_rmse) ** 2))
    places = [", ".join(robot.joint_names[j] for j in form.joints) or "the whole arm" for form in forms]
    names = " and ".join(f"{form.effect.name} on {where}" for form, where in zip(forms, places, strict=True))
    figure = f"{np.sqrt(error):.3f} of the held-out error without"
    if error > 1 - LIMITS.negligible:
        return _noted(model, f"{names} would explain a gap, but leaves {figure}, so nothing is added.")
    selected = replace(diagnosis.selected, fit=extended, causes=tuple(forms))
    changed = extended_model(replace(diagnosis, dataset=replace(diagnosis.dataset, model=model), selected=selected))
    changed = replace(
        changed,
        held_out_rmse=model.held_out_rmse * (after / before),
        group_rmse=None if model.group_rmse is None else model.group_rmse * (after / before),
        sliding_rmse=None if model.sliding_rmse is None else model.sliding_rmse * (after / before),
    )
    return _noted(
        changed,
        f"{names} is part of the model: found by the diagnosis, {figure} (root mean square over joints). Standard "
        "deviations are those of the bodies and friction, fitted before.",
    )


def _by_any_name(diagnosis: Diagnosis) -> bool:
    """Whether what equals the causes predicts as they do: a straight line over position is a spring or a hose."""
    if diagnosis.verdict != "ambiguous":
        return False
    causes = zip(diagnosis.selected.causes, diagnosis.selected.rivals, strict=True)
    return all(
        "position" in cause.effect.shapes and joints == cause.joints and name in cause.effect.structurally_equivalent
        for cause, rivals in causes
        for name, joints in rivals
    )


def _noted(model: IdentifiedModel, text: str) -> IdentifiedModel:
    return replace(model, notes=(*model.notes, f"Structure: {text}"))
