"""Zero position that differs from the model's."""

from __future__ import annotations

from types import MappingProxyType

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import BENDS, Columns, Effect, Joints, Numbers
from agent.model.effects.experiments import WHOLE_RANGE
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers


class EncoderOffset(Effect):
    """τ = −a ∂τ_bodies / ∂q_k on all joints: the joint stands at q_k − a."""

    name = "encoder_offset"
    family = "measurement"
    formula = "−a · ∂τ_bodies / ∂q_k"
    linear = ("offset",)
    source = "torque expanded in q_k; Khalil, Dombre, Modeling, Identification and Control of Robots (2002)"
    signature = "residual like gravity turned about one joint, on this and the neighbouring joints"
    confused_with = ("inertial_mismatch", "gravity_spring", "base_tilt")
    phrase = "the zero position of the joint is off"
    look_at = "the calibration mark of this joint; a motor, belt or encoder that was changed"
    needs_travel = BENDS
    units = MappingProxyType({"offset": "rad"})
    leading = ("offset",)
    numbers = FileNumbers.ZERO
    experiment = WHOLE_RANGE

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        change = -signals.link_slope[:, :, joints[0]]
        return {joint: change[:, joint, None] for joint in range(signals.q.shape[1])}

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return abs(values["offset"]) < BENDS

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers:
        return SimulatorNumbers(zero=values["offset"])
