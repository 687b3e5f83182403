"""Gravity that is not where the model has it."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import Columns, Effect, FitContext, Joints, Numbers
from agent.model.effects.experiments import WHOLE_RANGE
from agent.model.effects.simulator_numbers import SimulatorNumbers


class BaseTilt(Effect):
    """τ = a τ_g(e₁) + b τ_g(e₂): torque of gravity of its full size along two directions across the model's."""

    name = "base_tilt"
    family = "load"
    scope = "base"
    formula = "a · τ(g e₁) + b · τ(g e₂), e₁ ⟂ e₂ ⟂ g"
    linear = ("tilt_1", "tilt_2")
    source = "Atkeson, An, Hollerbach, Int. J. Robotics Research 5 (1986): the regressor is linear in gravity"
    signature = "residual at standstill on all joints that carry weight, joint 1 too"
    confused_with = ("encoder_offset", "inertial_mismatch", "payload")
    phrase = "the base is tilted compared with the model"
    look_at = "the level of the base, its mounting angle in the robot description"
    units = MappingProxyType({"tilt": "rad"})
    leading = ("tilt_1",)
    components = ("tilt", ("tilt_1", "tilt_2"))
    experiment = WHOLE_RANGE
    why_absent = "no gravity in the robot description"

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        return [{}] if np.linalg.norm(context.reference.robot.gravity) > 0 else []

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        gravity = np.array(signals.reference.robot.gravity)
        still = np.zeros_like(signals.q)
        torques = []
        for direction in across(gravity):
            links = signals.reference.links.with_gravity(np.linalg.norm(gravity) * direction)
            torques.append(links.inverse_dynamics(signals.q, still, still))
        stacked = np.stack(torques, axis=2)
        return {joint: stacked[:, joint] for joint in range(signals.q.shape[1])}

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return float(np.hypot(values["tilt_1"], values["tilt_2"])) < 0.5

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers:
        return SimulatorNumbers(tilt=(values["tilt_1"], values["tilt_2"]))


def across(gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit vectors e₁ and e₂ (3,) across gravity (3,)."""
    down = gravity / np.linalg.norm(gravity)
    first = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    first /= np.linalg.norm(first)
    return first, np.cross(down, first)
