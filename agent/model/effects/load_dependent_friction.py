"""Friction that grows with the torque the gear transmits."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import POWERS, FitContext, Joints, Numbers
from agent.model.effects.friction_level import FrictionLevel


class LoadDependentFriction(FrictionLevel):
    """τ = a s |τ_load| or a s τ₁ (|τ_load| / τ₁)^p, plus b w |τ_load| or b τ_load.

    Friction of teeth is proportional to the load; that of preloaded rollers and flexsplines follows another power.
    An oil film under load resists more at higher speed (`sheared`). A gear driven by its load has another efficiency
    than one that drives (`driven`): a s |τ| + b τ is (a + b) |τ| one way and (a − b) |τ| the other. The gear transmits
    the torque of the links without the rotor (`links`), or of both where these could not be distinguished.
    """

    name = "load_dependent_friction"
    family = "friction"
    stepped = "joint_load_dependent_friction"
    usual = True
    formula = "a · s · |τ_load|, or a · s · τ₁ · (|τ_load| / τ₁)^p; with b · w · |τ_load| or b · τ_load"
    source = "Bittencourt, Wernholt, Sander-Tavallaey, Brogårdh, IROS (2010); Dohring, Lee, Newman, ICRA (1993)"
    signature = "residual with the sign of the speed, larger where the arm reaches out or accelerates"
    confused_with = ("friction_change", "torque_constant")
    phrase = "friction grows with the load on the gear"
    look_at = "gear efficiency: tooth or wave-generator wear, overload"
    needs_reversals = 1  # derived: friction shows where its sign changes
    shapes = ("speed",)
    units = MappingProxyType({"load": "N·m"})
    leading = ("coefficient",)
    not_reported = ("sheared", "driven", "links")
    nonlinear = ("power", "reversal_travel")

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        nominal = float(context.reference.scale[joints[0]])
        return [
            {},
            *({"power": power, "load": nominal} for power in POWERS),
            {"sheared": 1.0},
            {"driven": 1.0},
            {"links": 1.0},
            {"links": 1.0, "driven": 1.0},
        ]

    def level_names(self, settings: Numbers) -> tuple[str, ...]:
        return ("coefficient", *(f"{kind}_coefficient" for kind in ("sheared", "driven") if kind in settings))

    def level_columns(self, signals: MotionSignals, axle: int, settings: Numbers) -> tuple[np.ndarray, ...]:
        assert signals.axles.load is not None
        loads = signals.link_load @ signals.reference.from_joints if "links" in settings else signals.axles.load
        load, slide = loads[:, axle], signals.direction(axle)
        nominal = settings.get("load", 1.0)
        columns = [slide * nominal * (np.abs(load) / nominal) ** settings.get("power", 1.0)]
        if "sheared" in settings:
            columns.append(signals.axles.speed[:, axle] * np.abs(load))
        if "driven" in settings:
            columns.append(load)
        return tuple(columns)

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return abs(values.get("driven_coefficient", 0.0)) <= abs(values["coefficient"])
