"""Friction that follows the position after a reversal before the contact slides."""

from __future__ import annotations

from types import MappingProxyType

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import (
    REVERSAL_TRAVELS,
    Columns,
    Effect,
    FitContext,
    Joints,
    Numbers,
    on_axle,
    travelled,
)
from agent.model.effects.experiments import SLOW_REVERSALS
from agent.model.friction_terms import Reversal
from agent.model.passive_forces import Bristles, PassiveForces


class Presliding(Effect):
    """τ = a (z − s): z is Dahl's state, dz = (1 − z sign(dx)) dx / travel, s the direction the model slides with."""

    name = "presliding"
    family = "friction"
    stepped = "joint_presliding"
    formula = "a · (z(x) − s), dz = (1 − z · sign(dx)) dx / travel"
    linear = ("level",)
    source = "Dahl, AIAA J. 14 (1976); Swevers, Al-Bender, Ganseman, Prajogo, IEEE TAC 45 (2000)"
    signature = "residual right after reversals, fading with the distance travelled, whatever the speed"
    confused_with = ("stribeck", "backlash")
    phrase = "friction builds up over a travel after each reversal"
    look_at = "gear wind-up and preloaded bearings; flexspline and seals that give way before they slide"
    units = MappingProxyType({"travel": "rad", "level": "N·m"})
    leading = ("level",)
    needs_reversals = 2  # derived: one each way
    shapes = ("speed",)
    experiment = SLOW_REVERSALS
    refined = ("travel",)

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        low, high = travelled(context, joints[0])
        return [{"travel": (high - low) * fraction} for fraction in REVERSAL_TRAVELS]

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        (axle,) = joints
        state = signals.axles.direction(axle, Reversal("travel", settings["travel"]))
        return on_axle(signals.reference, axle, state - signals.direction(axle))

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces:
        return PassiveForces(bristles=Bristles(values["level"], travel=values["travel"]))
