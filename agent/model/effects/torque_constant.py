"""Measured torque that is scaled."""

from __future__ import annotations

from types import MappingProxyType

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import Columns, Effect, Joints, Numbers, near_one, on_axle
from agent.model.effects.simulator_numbers import FileNumbers


class TorqueConstant(Effect):
    """τ = a τ_model of the axle: bodies, rotor and friction alike."""

    name = "torque_constant"
    family = "measurement"
    stepped = "reading_scaled"
    formula = "a · τ_axle"
    linear = ("scale_error",)
    source = "Gautier, Briot, J. Dynamic Systems, Measurement and Control 136 (2014)"
    signature = "residual in proportion to the whole torque of the joint, and of no other joint"
    confused_with = ("friction_change", "inertial_mismatch")
    phrase = "the measured torque is scaled wrongly"
    look_at = "the torque constant and current scaling of this drive; a demagnetised or replaced motor"
    shapes = ("speed",)
    moves_arm = False
    units = MappingProxyType({"scale_error": "%"})
    leading = ("scale_error",)
    scales_report = "scale_error"
    numbers = FileNumbers.GAIN
    of_servos = ("its servo has another gain", "the gain (P) of this servo in its firmware, and its supply voltage")

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return near_one(1 + values["scale_error"])

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return on_axle(signals.reference, joints[0], signals.axle_torque[:, joints[0]])
