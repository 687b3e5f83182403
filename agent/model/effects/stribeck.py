"""Friction that rises as the sliding slows down."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import BENDING_SPEEDS, FitContext, Joints, Numbers, highest_speed, rubs
from agent.model.effects.experiments import SLOW_REVERSALS
from agent.model.effects.friction_level import FrictionLevel
from agent.model.passive_forces import Bristles, PassiveForces, bell_near


class Stribeck(FrictionLevel):
    """τ = a s exp(−(|w| / v)^δ): v the speed over which it fades, δ 1 or 2."""

    name = "stribeck"
    family = "friction"
    stepped = "joint_stribeck"
    usual = True
    formula = "a · s · exp(−(|w| / v)^δ)"
    linear = ("rise",)
    source = "Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
    signature = "residual with the sign of the speed, at low speed only"
    confused_with = ("friction_change", "presliding", "viscous_nonlinearity")
    phrase = "friction rises as the joint slows down"
    look_at = "lubrication and seals of the gear: starved or cold grease lets friction rise at low speed"
    units = MappingProxyType({"rise": "N·m", "speed": "rad/s"})
    leading = ("rise",)
    needs_reversals = 1  # derived: friction shows where its sign changes
    shapes = ("speed",)
    sizes = ("rise",)
    experiment = SLOW_REVERSALS
    refined = ("speed", "reversal_travel")
    nonlinear = ("speed", "shape", "reversal_travel")

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        fastest = highest_speed(context, joints[0])
        return [{"speed": fastest * fraction, "shape": shape} for fraction in BENDING_SPEEDS for shape in (1.0, 2.0)]

    def level_columns(self, signals: MotionSignals, axle: int, settings: Numbers) -> tuple[np.ndarray, ...]:
        fading = (signals.axles.magnitude[:, axle] / settings["speed"]) ** settings["shape"]
        return (signals.direction(axle) * np.exp(-fading),)

    def level_possible(self, reference: NominalModel, axle: int, settings: Numbers, values: Numbers) -> bool:
        return rubs(reference, axle, coulomb=values["rise"])

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces:
        """Of an exponential (δ 1), the bell of the same area and mean over the speed."""
        rise, speed = values["rise"], values["speed"]
        if values["shape"] != 2:
            rise, speed = bell_near(rise, speed)
        return PassiveForces(
            bristles=Bristles(values.get("reversal_level", 0.0), rise, speed, values.get("reversal_travel", 0.0))
        )
