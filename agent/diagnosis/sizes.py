"""How large a cause is: its parameters with unit, and with the interval that leaving motions out gives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from agent.core import plus_minus
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.model import CATALOGUE

#: What a cause is called large by, in the order of preference.
_LEADING = (
    "mass", "rise", "coulomb_drift", "coulomb_change", "viscous_change", "coulomb_asymmetry", "viscous_asymmetry",
    "coefficient", "bend", "level", "gap", "stiffness", "delay", "scale_error", "offset", "ratio", "tilt_1", "tilt_2",
    "force_x", "force_y", "force_z", "shift", "m", "cosine_1", "sine_1", "constant", "hysteresis",
)  # fmt: skip
#: Units by name, or by what stands before the first underscore, where the effect itself does not say them.
_UNITS = {
    "mass": "kg", "moment": "kg·m", "inertia": "kg·m²", "rotor": "kg·m²",
    "m": "kg", "mx": "kg·m", "my": "kg·m", "mz": "kg·m",
    "Ixx": "kg·m²", "Ixy": "kg·m²", "Iyy": "kg·m²", "Ixz": "kg·m²", "Iyz": "kg·m²", "Izz": "kg·m²",
    "rise": "N·m", "level": "N·m", "coulomb": "N·m", "viscous": "N·m·s/rad", "bend": "N·m",
    "cosine": "N·m", "sine": "N·m", "constant": "N·m", "torque": "N·m", "hysteresis": "N·m",
    "stiffness": "N·m/rad", "quadratic": "N·m/rad²", "cubic": "N·m/rad³",
    "speed": "rad/s", "force": "N", "tilt": "rad",
    "gap": "rad", "travel": "rad", "way": "rad", "low": "rad", "high": "rad", "middle": "rad", "reach": "rad",
    "reversal_travel": "rad", "reversal_level": "N·m",
    "order": "1/rad",
    "at": "m",
    "delay": "s", "shift": "s", "blend": "s", "start": "s", "end": "s", "duration": "s", "time": "s",
}  # fmt: skip
_PARTS = (("cosine_1", "sine_1"), ("force_x", "force_y", "force_z"), ("tilt_1", "tilt_2"))
_ROUNDING = 1e-9  # of a parameter: it is the same in every fold
_SCALES = {"s": (1e3, "ms"), "rad": (1e3, "mrad")}  # where the figure is small


def unit_of(effect: str, parameter: str) -> str:
    """Unit of an effect's parameter on a turning joint; empty where it is a ratio or a count."""
    if effect in CATALOGUE and parameter in CATALOGUE[effect].units:
        return CATALOGUE[effect].units[parameter]
    stem = parameter.rstrip("0123456789") if parameter not in _UNITS else parameter
    return _UNITS.get(stem) or _UNITS.get(stem.split("_")[0], "")


def size_text(
    cause: Mapping[str, Any], parameter: str, value: float, interval: tuple[float, float] | None = None
) -> str:
    """A value of a cause's parameter, its interval and unit."""
    unit, slides = unit_of(cause["effect"], parameter), cause.get("slides", False)
    half = float("nan") if interval is None else (interval[1] - interval[0]) / 2
    if unit == "%":
        value, half = 100 * value, 100 * half
    elif unit in _SCALES and not slides and abs(value) < 0.1:
        scale, unit = _SCALES[unit]
        value, half = scale * value, scale * half
    if slides:
        unit = unit.replace("N·m", "N").replace("rad", "m")
    sign = "+" if value > 0 and parameter.endswith("_change") else ""
    return f"{sign}{plus_minus(value, half)} {unit}".rstrip()


def amplitude(
    parameters: Mapping[str, float], intervals: Mapping[str, tuple[float, float]]
) -> tuple[float, tuple[float, float] | None] | None:
    """Of a cause that is a sum of harmonics, the amplitude of the first; of a force or a tilt its size, whatever its
    direction; with its interval where all parts have one. None of any other."""
    names = next((names for names in _PARTS if all(name in parameters for name in names)), None)
    if names is None:
        return None
    parts = np.array([parameters[name] for name in names])
    size = float(np.linalg.norm(parts))
    if size == 0 or not all(name in intervals for name in names):
        return size, None
    halves = np.array([intervals[name][1] - intervals[name][0] for name in names]) / 2
    half = float(np.linalg.norm(parts * halves)) / size
    return size, (size - half, size + half)


def reported_parameters(cause: Mapping[str, Any]) -> list[str]:
    """The parameters of a cause that say something to people: not the point about which a form is made linear, nor
    that a friction level is one of those that change."""
    return [name for name in cause["parameters"] if name not in CATALOGUE[cause["effect"]].not_reported]


def leading_parameter(cause: Mapping[str, Any]) -> str | None:
    """The parameter that says how large a cause is: a usual one, or the first with a unit; None where none does."""
    names = {key.rstrip("0123456789") or key: key for key in cause["parameters"]} | {k: k for k in cause["parameters"]}
    with_unit = (name for name in cause["parameters"] if unit_of(cause["effect"], name))
    return next((names[name] for name in _LEADING if name in names), None) or next(with_unit, None)


def intervals(selected: SelectedCauses) -> list[dict[str, tuple[float, float]]]:
    """Of every cause the 95 % intervals of its fitted parameters: the wider of what leaving motions out gives, and
    halves of them, as two motions may agree by chance.

    The delete-a-group jackknife: with θ_k fitted without group k of K, the variance is (K - 1) / K Σ (θ_k - mean)².
    Parameters that are chosen from a grid have none. Of what happens once every fold of motions holds all or nothing:
    it has those of the short segments that it is judged by.
    """
    fit = selected.fit
    motions, halves = ([fit.fitted(fold)[1] for fold in folds] for folds in (fit.folds, fit.single))
    found = []
    for number, candidate in enumerate(selected.causes):
        settings = {name: float(value) for name, value in candidate.settings.items()}

        def reported(values: np.ndarray, candidate: Any = candidate, settings: Any = settings) -> dict[str, float]:
            named = {name: float(value) for name, value in zip(candidate.names, values, strict=True)}
            return dict(candidate.effect.reported(fit.reference, settings, named))

        groups = (halves,) if candidate.transient else (motions, halves)
        parts = [[reported(values[number]) for values in group] for group in groups]
        entry = {}
        for name, value in reported(fit.values[number]).items():
            half = max(_jackknife([part[name] for part in group]) for group in parts)
            if half > _ROUNDING * abs(value):
                entry[name] = (value - half, value + half)
        found.append(entry)
    return found


def _jackknife(values: Sequence[float]) -> float:
    """Half of the interval; Student's t is taken from three degrees of freedom on, fewer say too little for it."""
    count = len(values)
    return float(stdtrit(max(count - 1, 3), 0.975) * np.sqrt((count - 1) * np.var(values))) if count > 1 else 0.0
