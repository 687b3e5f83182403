"""The simulator's file that a diagnosis asks for: its numbers moved as far as the fit moved them, and the effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.diagnosis.result import Diagnosis
from agent.model import Correction, Released, Simulator, correct


def corrected(diagnosis: Diagnosis, simulator: Simulator, without: int | None = None) -> Correction:
    """What the simulator's numbers should be, by all logs or by all but one (`without`)."""
    fit, names = diagnosis.finding.fit, simulator.arm.joint_names
    change, fitted = fit.fitted(None if without is None else fit.folds[without])
    b = len(simulator.model.independent)
    weight = fit.gram[:, :b, :b].sum(axis=0) / fit.repeat
    closes = {step.step: step.closes for step in diagnosis.answer.waterfall}

    def reason(step: str) -> str:
        return f"{step}: closes {100 * closes[step]:.1f} % of the held-out gap" if step in closes else step

    released = Released()
    for group in diagnosis.calibrated.groups if diagnosis.calibrated else ():
        into = {"friction": released.friction, "rotor inertia": released.rotors, "link inertia": released.links}
        into[group.kind][group.joint] = reason(group.text(names))
    effects, reasons = [], {}
    for candidate, values in zip(fit.chosen, fitted, strict=True):
        reasons[candidate.effect.name, tuple(names[j] for j in candidate.joints)] = reason(candidate.text(names))
        effects.append(candidate.part_of_model(values, names))
    inertia = np.mean([np.diagonal(s.mass, axis1=1, axis2=2).mean(axis=0) for s in fit.signals], axis=0)
    unexplained = fit.error(fit.once) / fit.repeat
    found = correct(simulator, change, weight, unexplained, inertia, effects, released, reasons)
    given, gap = diagnosis.dataset.model, diagnosis.gap
    model = replace(
        found.model,
        cutoff=given.cutoff,
        order=given.order,
        residual_rmse=gap.after * gap.unit,
        held_out_rmse=gap.after * gap.unit,
        weights=1 / np.stack([np.maximum(gap.after * gap.unit, 1e-9) ** 2] * 2),
    )
    return replace(found, model=model)
