"""What acts in the drives of the simulated robot: friction, gears, and the simulated form of every effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.core import InputError
from fake_controller.actuation.bodies import (
    SimulatedBaseTilt,
    SimulatedInertialMismatch,
    SimulatedPayload,
    SimulatedWristCoupling,
)
from fake_controller.actuation.effect import SimulatedEffect
from fake_controller.actuation.friction_effects import (
    SimulatedAsymmetricFriction,
    SimulatedFrictionChange,
    SimulatedLoadDependentFriction,
    SimulatedStribeck,
    SimulatedViscousNonlinearity,
)
from fake_controller.actuation.friction_states import SimulatedPresliding, SimulatedThermalFriction
from fake_controller.actuation.gears import SimulatedBacklash, SimulatedJointElasticity
from fake_controller.actuation.loads import (
    ContactForce,
    SimulatedDressPack,
    SimulatedGravitySpring,
    SimulatedTorqueRipple,
)
from fake_controller.actuation.measurement import (
    SimulatedEncoderOffset,
    SimulatedInterpolatorMismatch,
    SimulatedTimeDelay,
    SimulatedTorqueConstant,
    SimulatedTorqueOffset,
)
from fake_controller.actuation.outside import RoughBearing, RubbingBrake, WanderingTorque

_FORMS: tuple[type[SimulatedEffect], ...] = (
    SimulatedStribeck,
    SimulatedAsymmetricFriction,
    SimulatedLoadDependentFriction,
    SimulatedViscousNonlinearity,
    SimulatedThermalFriction,
    SimulatedPresliding,
    SimulatedFrictionChange,
    SimulatedJointElasticity,
    SimulatedBacklash,
    SimulatedTorqueRipple,
    SimulatedWristCoupling,
    SimulatedPayload,
    SimulatedGravitySpring,
    SimulatedDressPack,
    SimulatedBaseTilt,
    SimulatedInertialMismatch,
    ContactForce,
    SimulatedTorqueConstant,
    SimulatedTorqueOffset,
    SimulatedTimeDelay,
    SimulatedEncoderOffset,
    SimulatedInterpolatorMismatch,
)

#: Simulated forms by the name of the effect.
EFFECTS: dict[str, type[SimulatedEffect]] = {form.name: form for form in _FORMS}

#: Those that the vocabulary has no name for: what a diagnosis must call unknown.
OUTSIDE: dict[str, type[SimulatedEffect]] = {form.name: form for form in (RoughBearing, WanderingTorque, RubbingBrake)}


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
