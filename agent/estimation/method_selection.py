"""Which estimator, when nobody asked for one: the one that predicts held-out data best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.estimation.problem import Estimate
from agent.estimation.solving import clear_gain

_LEAST_GAIN = 0.01
_NOT_PHYSICAL = 3.0  # times the error of the first estimator, from which on a consistent fit is a sign of wrong data


def choose(found: dict[str, Estimate]) -> tuple[str, Estimate]:
    """Name and estimate of the best of several estimators by name, with the reason in its note.

    The first is the yardstick: another takes its place only if its weighted squared error on the folds held out is
    lower by 1 % and by more than that gain scatters between folds. How much worse `consistent`, one of them, is tells
    data that no arm can have.
    """
    first = next(iter(found))
    weights = found[first].weights
    errors = {name: np.sum(weights * estimate.held_out, axis=(1, 2)) for name, estimate in found.items()}
    gains = {name: errors[first] - error for name, error in errors.items()}
    better = {
        name: gain.sum()
        for name, gain in gains.items()
        if gain.sum() > _LEAST_GAIN * errors[first].sum() and clear_gain(gain)
    }
    best = max(better, key=lambda name: better[name]) if better else first
    table = ", ".join(f"{name} {np.sqrt(error.sum() / errors[first].sum()):.3f}" for name, error in errors.items())
    reason = (
        f"{best} predicts held-out segments better than {first}, by more than the scatter between them"
        if better
        else f"no other is better than {first} by more than the scatter between held-out segments"
    )
    notes = [f"Method: {best}; {reason} (held-out error over that of {first}: {table}).", found[best].note]
    if errors["consistent"].sum() > _NOT_PHYSICAL**2 * errors[first].sum():
        notes.append(
            "No bodies with mass and no friction that brakes explain these torques nearly as well: are signs and units "
            "of torques, gear ratios and gravity right?"
        )
    return best, replace(found[best], note=" ".join(part for part in notes if part))
