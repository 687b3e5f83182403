"""Hose or cable that bends with the joint."""

import numpy as np

from agent.diagnosis.effects.effect import Effect
from agent.estimation.friction_terms import dahl


class DressPack(Effect):
    """τ = a + b q + c q³ (either power may be absent), and with hysteresis d z(q), z Dahl's state over `travel`."""

    name = "dress_pack"
    formula = "a + b · q + c · q³ + d · z(q)"
    source = "hose as a beam with inner friction; Dahl, AIAA J. 14 (1976)"
    signature = "residual that depends on the joint's own position, without the shape of gravity"
    confused_with = ("gravity_spring", "torque_offset", "friction_change")
    look_at = "hoses and cables at this joint: stiff, caught or too short"
    limits = ("torque_offset",)

    def settings(self, survey, joints):
        return [{"power": 1.0}, {"power": 3.0}, {"power": 1.0, "travel": 0.05}, {"power": 3.0, "travel": 0.05}]

    def names(self, settings):
        cubic = ("cubic",) if settings["power"] == 3 else ()
        return ("constant", "stiffness", *cubic, *(("hysteresis",) if "travel" in settings else ()))

    def columns(self, signals, joints, settings):
        q = signals.q[:, joints[0]]
        parts = [np.ones(len(q)), q]
        if settings["power"] == 3:
            parts.append(q**3)
        if "travel" in settings:
            parts.append(dahl(q, np.array([settings["travel"]]))[:, 0])
        return {joints[0]: np.column_stack(parts)}

    def freedom(self, settings):
        return len(self.names(settings))
