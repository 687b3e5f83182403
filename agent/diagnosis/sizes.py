"""How large a cause is: its parameters with unit, and with the interval that leaving motions out gives them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.special import stdtrit

from agent.core import plus_minus
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.model import CATALOGUE

_ROUNDING = 1e-9  # of a parameter: it is the same in every fold
_LEAST_DEGREES = 3  # derived: with fewer degrees of freedom Student's t has no variance
_SCALES = {"s": (1e3, "ms"), "rad": (1e3, "mrad")}  # where the figure is small


def unit_of(effect: str, parameter: str) -> str:
    """Unit of an effect's parameter on a turning joint; empty where it is a ratio or a count, or the effect unknown."""
    return CATALOGUE[effect].unit(parameter) if effect in CATALOGUE else ""


def size_text(
    cause: Mapping[str, Any], parameter: str, value: float, interval: tuple[float, float] | None = None
) -> str:
    """A value of a cause's parameter, its interval and unit.

    Args:
        cause: as in a result.
        parameter: name of one of its parameters.
        value: in SI units.
        interval: its ends; None: it has none.
    """
    unit, slides = unit_of(cause["effect"], parameter), cause.get("slides", False)
    half = float("nan") if interval is None else (interval[1] - interval[0]) / 2
    if unit == "%":
        value, half = 100 * value, 100 * half
    elif unit in _SCALES and not slides and abs(value) < 100 / _SCALES[unit][0]:
        scale, unit = _SCALES[unit]
        value, half = scale * value, scale * half
    if slides:
        unit = unit.replace("N·m", "N").replace("rad", "m")
    sign = "+" if value > 0 and parameter.endswith("_change") else ""
    return f"{sign}{plus_minus(value, half)} {unit}".rstrip()


def amplitude(
    cause: Mapping[str, Any], intervals: Mapping[str, tuple[float, float]]
) -> tuple[str, float, tuple[float, float] | None] | None:
    """Of a cause whose parameters are components of one size (harmonics, a force, a tilt): what that size is called,
    its value, and its interval where all components have one. None of any other."""
    parameters = cause["parameters"]
    components = CATALOGUE[cause["effect"]].components if cause["effect"] in CATALOGUE else None
    if components is None or not all(name in parameters for name in components[1]):
        return None
    label, names = components
    parts = np.array([parameters[name] for name in names])
    size = float(np.linalg.norm(parts))
    if size == 0 or not all(name in intervals for name in names):
        return label, size, None
    halves = np.array([intervals[name][1] - intervals[name][0] for name in names]) / 2
    half = float(np.linalg.norm(parts * halves)) / size
    return label, size, (size - half, size + half)


def reported_parameters(cause: Mapping[str, Any]) -> list[str]:
    """The parameters of a cause that say something to people: not the point about which a form is made linear, nor
    that a friction level is one of those that change."""
    return [name for name in cause["parameters"] if name not in CATALOGUE[cause["effect"]].not_reported]


def leading_parameter(cause: Mapping[str, Any]) -> str | None:
    """The parameter that says how large a cause is: a leading one of its effect, or the first with a unit; None where
    none does."""
    names = {key.rstrip("0123456789") or key: key for key in cause["parameters"]} | {k: k for k in cause["parameters"]}
    with_unit = (name for name in cause["parameters"] if unit_of(cause["effect"], name))
    leading = CATALOGUE[cause["effect"]].leading if cause["effect"] in CATALOGUE else ()
    return next((names[name] for name in leading if name in names), None) or next(with_unit, None)


def intervals(selected: SelectedCauses) -> list[dict[str, tuple[float, float]]]:
    """Of every cause the 95 % intervals of its fitted parameters: the wider of what leaving motions out gives, and
    halves of them, as two motions may agree by chance.

    The delete-a-group jackknife: with θ_k fitted without group k of K, the variance is (K - 1) / K Σ (θ_k - mean)².
    Parameters that are chosen from a grid have none. Of what happens once every fold of motions holds all or nothing:
    it has those of the short segments that it is judged by.
    """
    fit = selected.fit
    motions, halves = ([fit.fitted(fold)[1] for fold in folds] for folds in (fit.folds, fit.segment_folds))
    of_causes = []
    for number, candidate in enumerate(selected.causes):
        settings = {name: float(value) for name, value in candidate.settings.items()}

        def reported(values: np.ndarray, candidate: Any = candidate, settings: Any = settings) -> dict[str, float]:
            named = {name: float(value) for name, value in zip(candidate.names, values, strict=True)}
            return dict(candidate.effect.reported(fit.reference, settings, named))

        groups = (halves,) if candidate.transient else (motions, halves)
        parts = [[reported(values[number]) for values in group] for group in groups]
        entry = {}
        for name, value in reported(fit.values[number]).items():
            half = max(float(jackknife(np.array([part[name] for part in group]))) for group in parts)
            if half > _ROUNDING * abs(value):
                entry[name] = (value - half, value + half)
        of_causes.append(entry)
    return of_causes


def jackknife(values: np.ndarray) -> np.ndarray:
    """Half (…) of the 95 % interval from values (K, …) without one group each: the delete-a-group jackknife.

    Student's t is taken from three degrees of freedom on; fewer say too little for it.
    """
    count = len(values)
    if count < 2:
        return np.zeros(values.shape[1:])
    likely = stdtrit(max(count - 1, _LEAST_DEGREES), (1 + LAW.confidence) / 2)
    return np.asarray(likely * np.sqrt((count - 1) * np.var(values, axis=0)))
