"""The effects that can be built into the simulated arm, with the unit of every parameter."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from fake_controller.actuation import EFFECTS, OUTSIDE, SimulatedEffect
from fake_controller.actuation.effect import ArmEffect, JointEffect

#: Units by the name of a parameter, after its effect where the name means several things; empty for ratios and counts.
_UNITS = {
    "mass": "kg", "centre": "m", "dress_pack.centre": "rad", "radius": "m", "link": "from 1", "scale": "",
    "points": "kg, m, m, m", "roll": "rad", "pitch": "rad", "factor": "", "rise": "N·m", "speed": "rad/s", "shape": "",
    "coulomb": "", "viscous_fraction": "", "viscous": "", "coefficient": "N·m/(N·m)", "torque": "N·m",
    "cubic": "N·m/rad³", "viscous_nonlinearity.cubic": "N·m·s³/rad³", "start": "s", "thermal_friction.start": "K",
    "equilibrium": "K", "resistance": "K/W", "time_constant": "s", "coulomb_rate": "1/K", "viscous_rate": "1/K",
    "share": "", "travel": "rad", "stiffness": "N·m/rad", "damping_ratio": "", "gap": "rad", "amplitude": "N·m",
    "order": "1/motor turn", "phase": "rad", "preload": "N", "rate": "N/m", "interpolator_mismatch.rate": "",
    "anchor": "m", "lever": "m", "angle": "rad", "hysteresis": "N·m", "force": "N", "duration": "s", "offset": "N·m",
    "encoder_offset.offset": "rad", "delay": "s", "blend": "s", "patch": "rad", "seed": "", "memory": "s",
    "drag": "N·m", "on": "s", "off": "s",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ListedEffect:
    """One effect for people; `parameters` are (name, unit, default or "required")."""

    name: str
    joints: str
    words: str
    parameters: tuple[tuple[str, str, str], ...]


def listed_effects() -> Iterator[ListedEffect]:
    """Those of the vocabulary, then those that the vocabulary has no name for."""
    for name, form in (EFFECTS | OUTSIDE).items():
        joints = "none" if issubclass(form, ArmEffect) else "one or more" if issubclass(form, JointEffect) else "two"
        words = " ".join((form.__doc__ or "").split())
        yield ListedEffect(name, joints, words, tuple(_parameters(name, form)))


def _parameters(effect: str, form: type[SimulatedEffect]) -> Iterator[tuple[str, str, str]]:
    for field in dataclasses.fields(form):
        if field.name == "joints":
            continue
        key, default = f"{effect}.{field.name}", field.default
        shown = "required" if default is dataclasses.MISSING else str(default).replace("(", "[").replace(")", "]")
        yield field.name, _UNITS[key if key in _UNITS else field.name], shown


def effects_text() -> str:
    """The list as a terminal shows it, with an entry to copy."""
    lines = [
        "An entry of a scenario's `effects`, or of the JSON list of --effects:",
        '  {"effect": "dress_pack", "joints": ["joint_4"], "parameters": {"stiffness": 30.0, "centre": 0.5}}',
        "",
    ]
    for effect in listed_effects():
        lines.append(f"{effect.name} (joints: {effect.joints})")
        lines.append(f"    {effect.words}")
        for name, unit, default in effect.parameters:
            lines.append(f"    {name:16}{f'[{unit}]' if unit else '':16}{default}")
    return "\n".join(lines)
