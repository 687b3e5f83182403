"""Drives of the simulated robot: friction, gears, and the simulated form of every effect."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from agent.core import InputError

# Each module enters its forms.
from fake_controller.actuation import bodies, friction_effects, gears, loads, measurement, outside  # noqa: F401
from fake_controller.actuation.effect import EFFECTS, OUTSIDE, ArmEffect, JointEffect, SimulatedEffect


def load_effect(data: Mapping[str, Any]) -> SimulatedEffect:
    """An effect from {"effect": name, "joints": [names], "parameters": {…}}; the last two may be absent.

    Raises:
        InputError: unknown effect, key or parameter.
    """
    unknown = set(data) - {"effect", "joints", "parameters"}
    if unknown:
        raise InputError(f"effect: unknown key {min(unknown)!r}; allowed are effect, joints, parameters")
    name = data.get("effect")
    known = EFFECTS | OUTSIDE
    if name not in known:
        raise InputError(f"effect: {name!r} is not simulated; known are {', '.join(sorted(known))}")
    return known[name].from_parameters(tuple(data.get("joints", ())), data.get("parameters", {}))


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
        defaults = {field.name: field.default for field in dataclasses.fields(form)}
        for parameter, unit in form.units().items():
            missing = defaults[parameter] is dataclasses.MISSING
            default_text = "required" if missing else str(defaults[parameter]).replace("(", "[").replace(")", "]")
            lines.append(f"    {parameter:16}{f'[{unit}]' if unit else '':16}{default_text}")
    return "\n".join(lines)


__all__ = ["EFFECTS", "OUTSIDE", "SimulatedEffect", "effects_text", "load_effect"]
