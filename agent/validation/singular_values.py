"""Observability of parameters: singular values of a motion's observation matrix, and unobservable parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.core import NORMAL_95, symmetric_eigen
from agent.estimation import FilterSettings, motions
from agent.model import IdentifiedModel
from agent.recording import Log
from agent.validation.torque import filtered_columns

#: Directions of parameter space that are named, and parameters in each.
_WEAKEST, _NAMED = 3, 4


@dataclass(frozen=True, eq=False)
class Observability:
    """Of p parameters along one cycle of a motion.

    `singular_values` (p,), largest first, of the observation matrix with rows weighted by the model's residuals and
    columns scaled to unit length; `weakest` holds the directions that belong to the smallest of them, each as
    (singular value over the largest, {parameter: its part of the unit vector}), the least visible first.
    `never_acting` are standard parameters that no motion of this arm shows, `combined` is the number of those that act
    in combinations only; `within_noise` are parameters whose 95 % interval takes in zero.
    """

    parameters: int
    singular_values: np.ndarray
    weakest: tuple[tuple[float, dict[str, float]], ...]
    never_acting: tuple[str, ...]
    combined: int
    within_noise: tuple[str, ...]


def observability(model: IdentifiedModel, log: Log) -> Observability:
    """Look at a model along one cycle of the motion that it was estimated from."""
    total = np.zeros((len(model.values), len(model.values)))
    for m in motions(log.middle_part(), FilterSettings(model.cutoff, model.order)):
        rows = filtered_columns(model, m) / model.residual_rmse[:, None]
        total += np.einsum("snp,snq->pq", rows, rows, optimize=True)
    length = np.sqrt(np.diag(total))
    nonzero = length > 1e-12 * length.max()
    scale = np.where(nonzero, length, 1.0)
    energy, vectors = symmetric_eigen(total / np.outer(scale, scale))
    values = np.sqrt(np.maximum(energy[::-1], 0.0))
    weakest = tuple(
        (float(values[-1 - k] / values[0]), _largest_parts(vectors[:, k], model.names)) for k in range(_WEAKEST)
    )
    acting = np.abs(model.projection).max(axis=0) > 1e-12
    named = dict(zip(model.names, zip(model.values, model.standard_deviations, strict=True), strict=True))
    return Observability(
        parameters=len(values),
        singular_values=values,
        weakest=weakest,
        never_acting=tuple(name for name, acts in zip(model.standard_names, acting, strict=True) if not acts),
        combined=int(acting.sum()) - len(model.independent),
        within_noise=tuple(name for name, (value, sigma) in named.items() if abs(value) <= NORMAL_95 * sigma),
    )


def _largest_parts(vector: np.ndarray, names: tuple[str, ...]) -> dict[str, float]:
    order = np.argsort(-np.abs(vector))[:_NAMED]
    sign = np.sign(vector[order[0]])
    return {names[k]: float(sign * vector[k]) for k in order if abs(vector[k]) > 0.1}
