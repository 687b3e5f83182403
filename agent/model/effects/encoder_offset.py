"""Zero position that differs from the model's."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import BENDS, Columns, Effect, FitContext, Joints, Numbers
from agent.model.effects.experiments import WHOLE_RANGE
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers

_SECANT = "secant"  # in settings, the offset [rad or m] at which the torque is exact


class EncoderOffset(Effect):
    """τ = a (τ_bodies(q_k − s) − τ_bodies(q_k)) / s on all joints, a near s: the joint stands at q_k − a.

    The secant to the fitted offset s is exact there, however large it is.
    """

    name = "encoder_offset"
    family = "measurement"
    formula = "a · (τ_bodies(q_k − s) − τ_bodies(q_k)) / s, a near s"
    linear = ("offset",)
    source = "secant of the torque over q_k; Khalil, Dombre, Modeling, Identification and Control of Robots (2002)"
    signature = "residual like gravity turned about one joint, on this and the neighbouring joints"
    confused_with = ("inertial_mismatch", "gravity_spring", "base_tilt")
    phrase = "the zero position of the joint is off"
    look_at = "the calibration mark of this joint; a motor, belt or encoder that was changed"
    needs_travel = BENDS
    units = MappingProxyType({"offset": "rad"})
    leading = ("offset",)
    numbers = FileNumbers.ZERO
    experiment = WHOLE_RANGE
    not_reported = (_SECANT,)
    nonlinear = ()

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        """The tangent, which misses 5 % of half the travel over which torque bends, or the secant to a larger one."""
        settings: dict[str, float] = {}
        for _ in range(2):
            offset = float(context.fit(self, joints, settings)[0])
            if abs(offset) < BENDS / 2:
                return [{}]
            settings = {_SECANT: float(np.clip(offset, -np.pi, np.pi))}
        return [settings]

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        (k,) = joints
        secant = settings.get(_SECANT, 1e-6)
        moved = signals.q.copy()
        moved[:, k] -= secant
        torque = signals.reference.links.inverse_dynamics(moved, signals.qd, signals.qdd)
        change = (torque - signals.link_load) / secant
        return {joint: change[:, joint, None] for joint in range(signals.q.shape[1])}

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return abs(values["offset"] - settings.get(_SECANT, 0.0)) < BENDS

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers:
        return SimulatorNumbers(zero=values["offset"])
