"""How the robot's friction reverses, which no number of a simulator's file says.

A file has a Coulomb level. Whether it changes sign at once or over a travel (Dahl's bristles) is not in the file, and
every simulator regularises it its own way. So it is taken from the logs before anything is called a gap: a model that
predicts the logs predicts them as a file too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.model import REVERSAL_TRAVELS, IdentifiedModel, ModelEffect, Reversal
from agent.simulators import reversal_over


def with_reversals(dataset: Dataset) -> IdentifiedModel:
    """The model of the data with the travel per axle over which friction reverses that leaves least of the residual.

    The level is fitted along, because the file's may be wrong; where it has none, nothing reverses. An axle keeps its
    own reversal unless another one takes as much of the squared error of its joints as a number of the file has to
    (`LIMITS.least_gain`).
    """
    model, signals = dataset.model, dataset.fit.signals
    terms = list(model.terms)
    for k, term in enumerate(terms):
        level = model.values[len(model.independent) + k]
        if term.form != "coulomb" or term.reversal is None or level == 0:
            continue
        ends = [(s.axles.position[:, term.axle].min(), s.axles.position[:, term.axle].max()) for s in signals]
        travelled = max(high for _, high in ends) - min(low for low, _ in ends)
        # effects are looked for with longer ones only: these show on a stationary joint alone, which they hold
        shorter = [REVERSAL_TRAVELS[0] ** 2 / part for part in REVERSAL_TRAVELS[1:]]
        options = [term.reversal, *(Reversal("travel", float(p * travelled)) for p in (*shorter, *REVERSAL_TRAVELS))]
        share = dataset.robot.coupling[term.axle]
        driven = share != 0
        columns = []
        for reversal in options:
            parts = [s.low_pass(np.outer(s.axles.direction(term.axle, reversal), share[driven])) for s in signals]
            columns.append(np.concatenate(parts) / dataset.fit.sigma[:, driven])
        target = (dataset.residual / dataset.fit.sigma)[:, driven] + level * columns[0]
        error = [_remaining_energy(target, column) for column in columns]
        best = int(np.argmin(error))
        if error[best] < (1 - LIMITS.least_gain) * error[0]:
            terms[k] = replace(term, reversal=options[best])
    return replace(model, terms=tuple(terms))


def _remaining_energy(target: np.ndarray, column: np.ndarray) -> float:
    """Squared error of `target` (S', n) that a level times `column` (S', n) leaves; the level is not negative."""
    level = max(float(np.nansum(target * column) / max(np.nansum(column**2), 1e-300)), 0.0)
    return float(np.nansum((target - level * column) ** 2))


def reversals_as_effects(model: IdentifiedModel, change: np.ndarray) -> list[ModelEffect]:
    """These reversals for a simulator that changes the sign at once, at the levels after a `change` (p,)."""
    effects, names = [], model.robot.joint_names
    for k, term in enumerate(model.terms):
        level = float(model.values[len(model.independent) + k] + change[len(model.independent) + k])
        if term.form == "coulomb" and term.reversal is not None and term.reversal.kind == "travel" and level > 0:
            effects.append(reversal_over((names[term.axle],), float(term.reversal.scale), level))
    return effects
