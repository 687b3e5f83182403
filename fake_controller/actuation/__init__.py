"""What acts in the drives of the simulated robot: friction, gears, and the simulated form of every effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.core.errors import InputError
from fake_controller.actuation.bodies import BaseTilt, InertialMismatch, Payload, WristCoupling
from fake_controller.actuation.effect import Effect
from fake_controller.actuation.friction_effects import (
    AsymmetricFriction,
    FrictionChange,
    LoadDependentFriction,
    Stribeck,
    ViscousNonlinearity,
)
from fake_controller.actuation.friction_states import Presliding, ThermalFriction
from fake_controller.actuation.gears import Backlash, JointElasticity
from fake_controller.actuation.loads import ContactForce, DressPack, GravitySpring, TorqueRipple
from fake_controller.actuation.measurement import (
    EncoderOffset,
    InterpolatorMismatch,
    TimeDelay,
    TorqueConstant,
    TorqueOffset,
)
from fake_controller.actuation.outside import RoughBearing, RubbingBrake, WanderingTorque

_FORMS: tuple[type[Effect], ...] = (
    Stribeck,
    AsymmetricFriction,
    LoadDependentFriction,
    ViscousNonlinearity,
    ThermalFriction,
    Presliding,
    FrictionChange,
    JointElasticity,
    Backlash,
    TorqueRipple,
    WristCoupling,
    Payload,
    GravitySpring,
    DressPack,
    BaseTilt,
    InertialMismatch,
    ContactForce,
    TorqueConstant,
    TorqueOffset,
    TimeDelay,
    EncoderOffset,
    InterpolatorMismatch,
)

#: Simulated forms by the name of the effect.
EFFECTS: dict[str, type[Effect]] = {form.name: form for form in _FORMS}

#: Those that the vocabulary has no name for: what a diagnosis must call unknown.
OUTSIDE: dict[str, type[Effect]] = {form.name: form for form in (RoughBearing, WanderingTorque, RubbingBrake)}


def load_effect(data: Mapping[str, Any]) -> Effect:
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


__all__ = ["EFFECTS", "OUTSIDE", "Effect", "load_effect"]
