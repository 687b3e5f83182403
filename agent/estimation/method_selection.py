"""Which estimator, when nobody asked for one: the one that predicts held-out data best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.estimation.problem import Estimate
from agent.estimation.solving import clearly_better

_LEAST_GAIN = 0.02  # of the squared error held out
_NOT_PHYSICAL = 3.0  # times the error of the first estimator, from which on a consistent fit is a sign of wrong data


def choose(found: dict[str, Estimate]) -> tuple[str, Estimate]:
    """Name and estimate of the best of several estimators by name, with the reason in its note.

    The first is the yardstick: another takes its place only if its weighted squared error on the folds held out is
    lower by 2 % and by two standard errors of that gain. How much worse `consistent`, one of them, is tells data that
    no arm can have.
    """
    first = next(iter(found))
    weights = found[first].weights
    errors = {name: np.sum(weights * estimate.held_out, axis=(1, 2)) for name, estimate in found.items()}
    better = [name for name, error in errors.items() if clearly_better(errors[first], error, _LEAST_GAIN)]
    best = min(better, key=lambda name: errors[name].sum(), default=first)
    table = ", ".join(f"{name} {np.sqrt(error.sum() / errors[first].sum()):.3f}" for name, error in errors.items())
    reason = (
        f"{best} predicts held-out segments clearly better than {first}"
        if better
        else f"no other predicts held-out segments clearly better than {first}"
    )
    notes = [f"Method: {best}; {reason} (held-out error over that of {first}: {table}).", found[best].note]
    if errors["consistent"].sum() > _NOT_PHYSICAL**2 * errors[first].sum():
        notes.append(
            "No bodies with mass and no friction that brakes explain these torques nearly as well: are signs and units "
            "of torques, gear ratios and gravity right?"
        )
    return best, replace(found[best], note=" ".join(part for part in notes if part))
