"""The effects that can be built into the simulated arm, with the unit of every parameter."""

from __future__ import annotations

import dataclasses

from fake_controller.actuation import EFFECTS, OUTSIDE
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


def effects_text() -> str:
    """The list as a terminal shows it: effects of the vocabulary, then those without a name in it."""
    lines = [
        "An entry of a scenario's `effects`, or of the JSON list of --effects:",
        '  {"effect": "dress_pack", "joints": ["joint_4"], "parameters": {"stiffness": 30.0, "centre": 0.5}}',
        "",
    ]
    for name, form in (EFFECTS | OUTSIDE).items():
        joints = "none" if issubclass(form, ArmEffect) else "one or more" if issubclass(form, JointEffect) else "two"
        lines += [f"{name} (joints: {joints})", f"    {' '.join((form.__doc__ or '').split())}"]
        for field in dataclasses.fields(form):
            if field.name != "joints":
                key = f"{name}.{field.name}"
                unit = _UNITS[key if key in _UNITS else field.name]
                missing = field.default is dataclasses.MISSING
                shown = "required" if missing else str(field.default).replace("(", "[").replace(")", "]")
                lines.append(f"    {field.name:16}{f'[{unit}]' if unit else '':16}{shown}")
    return "\n".join(lines)
