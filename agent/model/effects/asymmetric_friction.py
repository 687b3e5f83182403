"""Friction that differs by direction."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import SLIDES, Columns, Effect, FitContext, Joints, Numbers, on_axle, rubs
from agent.model.effects.experiments import RAMPS_AND_STANDSTILLS


class AsymmetricFriction(Effect):
    """τ = a |s| + b |w|, or either term alone.

    The first term equals a torque offset, both in motion and at standstill, so no motion distinguishes the two. The
    second term does, at high speeds.
    """

    name = "asymmetric_friction"
    family = "friction"
    stepped = "joint_asymmetric_friction"
    formula = "a · |s| + b · |w|"
    source = "Armstrong-Hélouvry, Control of Machines with Friction (1991); Janot, Gautier, Brunot, EMPS benchmark"
    signature = "residual of one sign while the joint moves either way, gone at standstill or growing with speed"
    confused_with = ("torque_offset",)
    phrase = "friction differs between the two directions"
    look_at = "one-sided bearing load, seals, preload of a screw or belt"
    units = MappingProxyType({"coulomb": "N·m", "viscous": "N·m·s/rad"})
    leading = ("coulomb_asymmetry", "viscous_asymmetry")
    needs_speed = SLIDES
    needs_reversals = 1  # derived: friction shows where its sign changes
    shapes = ("speed", "position")
    experiment = RAMPS_AND_STANDSTILLS
    not_reported = ("coulomb", "viscous")
    nonlinear = ()

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        return [{"coulomb": 1.0}, {"viscous": 1.0}, {"coulomb": 1.0, "viscous": 1.0}]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        return tuple(f"{kind}_asymmetry" for kind in ("coulomb", "viscous") if kind in settings)

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        (axle,) = joints
        parts = {"coulomb": np.abs(signals.direction(axle)), "viscous": signals.axles.magnitude[:, axle]}
        return on_axle(signals.reference, axle, *(parts[kind] for kind in parts if kind in settings))

    def possible(self, reference: NominalModel, joints: Joints, settings: Numbers, values: Numbers) -> bool:
        less = {kind: -abs(values[f"{kind}_asymmetry"]) for kind in ("coulomb", "viscous") if kind in settings}
        return rubs(reference, joints[0], **less)
