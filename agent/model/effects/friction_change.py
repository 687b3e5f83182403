"""Coulomb or viscous level that is not the model's any more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.model.effects.effect import FitContext, rubs
from agent.model.effects.friction_level import FrictionLevel
from agent.model.signals import MotionSignals, NominalModel


class FrictionChange(FrictionLevel):
    """τ = a s + b w, or either term alone."""

    name = "friction_change"
    family = "friction"
    formula = "a · s + b · w"
    source = "Bittencourt, Axelsson, identification of wear in a robot joint, report LiTH-ISY-R-3058 (2013)"
    signature = "residual with the sign of the speed at all speeds, and growing in proportion to it"
    confused_with = ("torque_constant", "thermal_friction", "load_dependent_friction")
    phrase = "the friction level is not the model's any more"
    look_at = "wear and lubrication of the gear, brake that drags, bearing preload"
    needs_speed = 0.02
    needs_reversals = 1
    shapes = ("speed",)
    not_reported = ("coulomb", "viscous")
    numbers = "friction"

    def settings(self, context: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        return [{"coulomb": 1.0}, {"viscous": 1.0}, {"coulomb": 1.0, "viscous": 1.0}]

    def level_names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return tuple(f"{kind}_change" for kind in ("coulomb", "viscous") if kind in settings)

    def level_columns(self, signals: MotionSignals, axle: int, settings: Mapping[str, float]) -> tuple[np.ndarray, ...]:
        parts = {"coulomb": signals.direction(axle), "viscous": signals.axles.speed[:, axle]}
        return tuple(parts[kind] for kind in parts if kind in settings)

    def level_possible(
        self, reference: NominalModel, axle: int, settings: Mapping[str, float], values: Mapping[str, float]
    ) -> bool:
        change = {kind: values[f"{kind}_change"] for kind in ("coulomb", "viscous") if kind in settings}
        return rubs(reference, axle, **change)

    def level_changes(self, settings: Mapping[str, float]) -> bool:
        return "coulomb" in settings

    def level_parameters(self, settings: Mapping[str, float]) -> int:
        return len(settings)
