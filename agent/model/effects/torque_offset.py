"""Measured torque that is shifted."""

import numpy as np

from agent.model.effects.effect import Effect, on_axle


class TorqueOffset(Effect):
    """τ = a."""

    name = "torque_offset"
    formula = "a"
    source = "by definition: a constant added to the torque channel"
    signature = "constant residual"
    confused_with = ("asymmetric_friction", "gravity_spring", "dress_pack")
    structurally_equivalent = ("asymmetric_friction",)
    look_at = "zero of the current sensor of this drive; a constant force such as a hose or a balancer"

    def names(self, settings):
        return ("offset",)

    def columns(self, signals, joints, settings):
        return on_axle(signals.reference, joints[0], np.ones(len(signals.time)))
