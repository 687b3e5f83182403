"""Drives of the simulated robot: friction, gears, and the simulated form of every effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.core import InputError

# Each module enters its forms.
from fake_controller.actuation import bodies, friction_effects, gears, loads, measurement, outside  # noqa: F401
from fake_controller.actuation.effect import EFFECTS, OUTSIDE, SimulatedEffect


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


__all__ = ["EFFECTS", "OUTSIDE", "SimulatedEffect", "load_effect"]
