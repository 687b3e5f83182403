"""Viscous friction that bends with speed."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import BENDING_SPEEDS, POWERS, FitContext, Joints, Numbers, highest_speed
from agent.model.effects.friction_level import FrictionLevel
from agent.model.passive_forces import Bristles, PassiveForces, damping_near


class ViscousNonlinearity(FrictionLevel):
    """τ = a f(w) + b w with f(w) = v asinh(w / v) (shear thinning, Eyring), or a power of the speed."""

    name = "viscous_nonlinearity"
    family = "friction"
    stepped = "joint_viscous_nonlinearity"
    formula = "a · v · asinh(w / v) + b · w, or a · sign(w) · |w|^p + b · w"
    linear = ("bend", "viscous_change")
    source = "Waiboer, Aarts, Jonker, ECCOMAS (2005); Eyring, J. Chem. Phys. 4 (1936)"
    signature = "residual with the sign of the speed, bent at high speed"
    confused_with = ("friction_change", "stribeck")
    phrase = "viscous friction is not proportional to speed"
    look_at = "the grease: viscosity, fill level, churning at high speed"
    units = MappingProxyType({"bend": "N·m", "speed": "rad/s", "viscous": "N·m·s/rad"})
    leading = ("bend",)
    needs_reversals = 1  # derived: friction shows where its sign changes
    shapes = ("speed",)
    refined = ("speed", "power", "reversal_travel")
    nonlinear = ("speed", "power", "reversal_travel")

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        fastest = highest_speed(context, joints[0])
        return [
            *({"speed": fastest * fraction} for fraction in BENDING_SPEEDS),
            *({"power": power} for power in POWERS),
        ]

    def level_columns(self, signals: MotionSignals, axle: int, settings: Numbers) -> tuple[np.ndarray, ...]:
        speed = signals.axles.speed[:, axle]
        return _bent(speed, settings), speed

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces:
        """The cubic next to it up to the highest speed."""
        bend, viscous = values["bend"], values["viscous_change"]
        damping = damping_near(lambda speed: bend * _bent(speed, values) + viscous * speed, fastest)
        level, travel = values.get("reversal_level", 0.0), values.get("reversal_travel", 0.0)
        return PassiveForces(damping=damping, bristles=Bristles(level, travel=travel) if travel else None)


def _bent(speed: np.ndarray, settings: Numbers) -> np.ndarray:
    """(S,) f at speeds (S,) [rad/s]."""
    if "power" in settings:
        return np.sign(speed) * np.abs(speed) ** settings["power"]
    return settings["speed"] * np.arcsinh(speed / settings["speed"])
