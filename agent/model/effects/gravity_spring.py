"""Counterbalance, spring or cylinder between two pivots."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import (
    BENDS,
    STRONGEST,
    Columns,
    Effect,
    FitContext,
    Joints,
    Numbers,
    harmonic_names,
    harmonics,
)
from agent.model.effects.experiments import WHOLE_RANGE
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers, linear_spring
from agent.model.passive_forces import PassiveForces, periodic


class GravitySpring(Effect):
    """τ = a cos q + b sin q, or with the second harmonic, which a spring between two pivots has as well; or a + b q.

    The straight line is a torsion spring, a spring on a slide, or any on little motion. A hose that neither hardens nor
    rubs is the same.
    """

    name = "gravity_spring"
    family = "load"
    stepped = "joint_gravity_spring"
    formula = "Σ a_h · cos(h q) + b_h · sin(h q), h = 1 or 1, 2; or a + b · q"
    source = "two pivots and a spring: Klimchik, Wu, Caro, Dumas, Furet, Pashkevich, arXiv:1311.6674 (2013)"
    signature = "residual that is a smooth function of the joint's own angle, like a pendulum's"
    confused_with = ("dress_pack", "inertial_mismatch", "torque_offset")
    structurally_equivalent = ("dress_pack", "torque_offset")
    phrase = "a balancer or spring pulls differently"
    look_at = "the balancer: its spring, gas pressure and pivots"
    units = MappingProxyType({"constant": "N·m", "stiffness": "N·m/rad", "cosine": "N·m", "sine": "N·m"})
    leading = ("stiffness", "cosine_1")
    components = ("amplitude", ("cosine_1", "sine_1"))
    needs_travel = BENDS
    shapes = ("position",)
    experiment = WHOLE_RANGE
    nonlinear = ()
    numbers = FileNumbers.SPRING

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        slides = context.reference.robot.joints[joints[0]].prismatic
        return [{}] if slides else [*({"harmonics": float(h)} for h in range(1, 4)), {}]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        if "harmonics" not in settings:
            return ("constant", "stiffness")
        return harmonic_names(settings)

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        q = signals.q[:, joints[0]]
        if "harmonics" not in settings:
            return {joints[0]: np.column_stack([np.ones(len(q)), q])}
        return {joints[0]: np.column_stack(harmonics(q, settings))}

    def possible(self, reference: NominalModel, joints: Joints, settings: Numbers, values: Numbers) -> bool:
        swing = [value for name, value in values.items() if name != "constant"]  # about its rest position
        return float(np.linalg.norm(swing)) < STRONGEST * float(reference.scale[joints[0]])

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers | None:
        return linear_spring(values)

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces:
        if "harmonics" in values:
            return PassiveForces(periodic=periodic(values))
        return PassiveForces(spring=(values["constant"], values["stiffness"], 0.0, 0.0))
