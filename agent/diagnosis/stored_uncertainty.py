"""How far a model may move: no further than the uncertainty stored in it, however many rows would have it move."""

from __future__ import annotations

import numpy as np

from agent.diagnosis.fit import Fit

_CHANCE = 1e-3  # that parameters as uncertain as the model says are further away
_STEPS = 60  # of a factor two


def held_to_uncertainty(fit: Fit) -> Fit | None:
    """The same fit with a prior that keeps the model's parameters where they may be; None where they are there.

    As many rows as a log has outweigh any prior: what the model's columns nearly span moves them by dozens of their
    standard deviations. The squared distance δᵀ Λ δ of parameters that are as uncertain as the model says follows a χ²
    distribution; where it is further out than one of a thousand, Λ is multiplied until it is not.
    """
    from scipy.special import chdtri

    everything = np.ones(fit.cells, dtype=bool)
    most = float(chdtri(len(fit.precision), _CHANCE))

    def distance(moved: Fit) -> float:
        shift = moved.solve(everything)[1]
        return float(shift @ fit.precision @ shift)

    held = fit
    for step in range(_STEPS):
        if distance(held) <= most:
            return None if held is fit else held
        held = fit.with_prior(2.0 ** (step + 1) * fit.precision)
    return held
