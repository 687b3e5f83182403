"""Measured torque that is shifted."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import Columns, Effect, Joints, Numbers, on_axle
from agent.model.effects.experiments import RAMPS_AND_STANDSTILLS
from agent.model.effects.simulator_numbers import FileNumbers


class TorqueOffset(Effect):
    """τ = a."""

    name = "torque_offset"
    family = "measurement"
    stepped = "reading_shifted"
    formula = "a"
    linear = ("offset",)
    source = "by definition: a constant added to the torque channel"
    signature = "constant residual"
    confused_with = ("asymmetric_friction", "gravity_spring", "dress_pack")
    structurally_equivalent = ("asymmetric_friction",)
    phrase = "the measured torque is shifted by a constant"
    look_at = "the zero of this drive's current sensor, read with the drives off; a constant force such as a hose"
    shapes = ("position",)
    experiment = RAMPS_AND_STANDSTILLS
    moves_arm = False
    of_servos = ("its set-points are shifted", "the zero of this servo's set-points against its positions")
    units = MappingProxyType({"offset": "N·m", "set_point_offset": "rad"})
    leading = ("set_point_offset", "offset")
    adds_to_report = "offset"
    numbers = FileNumbers.OFFSET

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return on_axle(signals.reference, joints[0], np.ones(len(signals.time)))
