"""Friction that grows with the torque the gear transmits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.model.effects.effect import Columns, Effect, on_axle
from agent.model.signals import MotionSignals


class LoadDependentFriction(Effect):
    """τ = a s |τ_load|."""

    name = "load_dependent_friction"
    family = "friction"
    formula = "a · s · |τ_load|"
    source = "Bittencourt, Wernholt, Sander-Tavallaey, Brogårdh, IROS (2010)"
    signature = "residual with the sign of the speed, larger where the arm reaches out or accelerates"
    confused_with = ("friction_change", "torque_constant")
    phrase = "friction grows with the load on the gear"
    look_at = "gear efficiency: tooth or wave-generator wear, overload"
    needs_speed = 0.02
    needs_reversals = 1
    shapes = ("speed",)
    special_cases = ("friction_change",)

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return ("coefficient",)

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        (axle,) = joints
        assert signals.axles.load is not None
        return on_axle(signals.reference, axle, signals.direction(axle) * np.abs(signals.axles.load[:, axle]))
