"""Coulomb or viscous level that differs from the model's."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import FitContext, Joints, Numbers, rubs
from agent.model.effects.friction_level import FrictionLevel
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers


class FrictionChange(FrictionLevel):
    """τ = a s + b w, or either term alone."""

    name = "friction_change"
    family = "friction"
    stepped = "joint_friction_change"
    formula = "a · s + b · w"
    source = "Bittencourt, Axelsson, identification of wear in a robot joint, report LiTH-ISY-R-3058 (2013)"
    signature = "residual with the sign of the speed at all speeds, and growing in proportion to it"
    confused_with = ("torque_constant", "thermal_friction", "load_dependent_friction")
    phrase = "the friction level differs from the model's"
    look_at = "wear and lubrication of the gear, a dragging brake, bearing preload"
    of_servos = (
        "friction differs from the file's",
        "the friction of the file, which the corrected one has; then at wear and lubrication of the gear",
    )
    units = MappingProxyType({"coulomb": "N·m", "viscous": "N·m·s/rad"})
    leading = ("coulomb_change", "viscous_change")
    needs_reversals = 1  # derived: friction shows where its sign changes
    shapes = ("speed",)
    not_reported = ("coulomb", "viscous")
    numbers = FileNumbers.FRICTION

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        return [{"coulomb": 1.0}, {"viscous": 1.0}, {"coulomb": 1.0, "viscous": 1.0}]

    def level_names(self, settings: Numbers) -> tuple[str, ...]:
        return tuple(f"{kind}_change" for kind in ("coulomb", "viscous") if kind in settings)

    def level_columns(self, signals: MotionSignals, axle: int, settings: Numbers) -> tuple[np.ndarray, ...]:
        parts = {"coulomb": signals.direction(axle), "viscous": signals.axles.speed[:, axle]}
        return tuple(parts[kind] for kind in parts if kind in settings)

    def level_possible(self, reference: NominalModel, axle: int, settings: Numbers, values: Numbers) -> bool:
        change = {kind: values[f"{kind}_change"] for kind in ("coulomb", "viscous") if kind in settings}
        return rubs(reference, axle, **change)

    def reversing(self, context: FitContext, joints: Joints, settings: Numbers) -> list[dict[str, float]]:
        return super().reversing(context, joints, settings) if "coulomb" in settings else []

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers:
        levels = {form: values[f"{form}_change"] for form in ("coulomb", "viscous") if f"{form}_change" in values}
        return SimulatorNumbers(friction=levels, beyond=self.reversal(values))
