"""A model with the effects that a diagnosis found."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from agent.diagnosis.sizes import intervals
from agent.model import IdentifiedModel

if TYPE_CHECKING:
    from agent.diagnosis.diagnosis import Diagnosis


def extended_model(diagnosis: Diagnosis, without: int | None = None, transient: bool = False) -> IdentifiedModel:
    """The model with the effects found, its parameters moved as far as the fit with them moved them.

    Args:
        without: fitted to all logs but this one; to all of them if None.
        transient: with what happened once (a contact), which another motion knows nothing of.
    """
    fit, model = diagnosis.selected.fit, diagnosis.dataset.model
    names = model.robot.joint_names
    change, fitted = fit.fitted(None if without is None else fit.folds[without])
    ranges = intervals(diagnosis.selected) if without is None else [{} for _ in fitted]
    effects = tuple(
        replace(candidate.part_of_model(values, names), intervals=ends)
        for candidate, values, ends in zip(fit.chosen, fitted, ranges, strict=True)
        if transient or not candidate.effect.transient
    )
    return replace(model, values=model.values + change, effects=(*model.effects, *effects))
