"""Motors that turn along with another axis."""

import numpy as np

from agent.diagnosis.effects.effect import Effect


class WristCoupling(Effect):
    """Axle j turns at w = q̇_j + r q̇_i, so its rotor and friction act at w.

    Joint j feels Δτ_j = a r q̈_i + b r q̇_i + c (s(w) − s(q̇_j)). What joint i feels depends on where torque is
    reported. On the joint side its motor carries the axle's share too, Δτ_i = r (a ẇ + b w + c s(w)); on the axle's
    side the load of joint j reaches it unseen, Δτ_i = d r τ_j with d near -1.
    """

    name = "wrist_coupling"
    scope = "pair"
    formula = "τ = Cᵀ f(C q̇) − f(q̇), C with r in row j, column i"
    source = "power is kept, so torques go by the transpose: Khalil, Dombre (2002), coupled transmissions"
    signature = "residual on two wrist axes, each with the speed and acceleration of the other"
    confused_with = ("friction_change",)
    look_at = "motor_coupling in the robot description; coupling compensation of the controller"
    limits = ("friction_change",)
    refined = ("ratio",)

    def places(self, robot):
        first = max(0, robot.dof - 3)
        return [(i, j) for i in range(first, robot.dof) for j in range(i + 1, robot.dof)]

    def settings(self, survey, joints):
        ratios = (-1.0, -0.6, -0.3, -0.1, 0.1, 0.3, 0.6, 1.0)
        return [{"ratio": ratio, **side} for ratio in ratios for side in ({}, {"axle_side": 1.0})]

    def names(self, settings):
        return ("rotor", "viscous", "coulomb", *(("transmission",) if "axle_side" in settings else ()))

    def columns(self, signals, joints, settings):
        i, j = joints
        ratio = settings["ratio"]
        reversal = signals.reference.reversals[j]
        turning = signals.qd[:, j] + ratio * signals.qd[:, i]
        scale = (
            reversal.scale
            if reversal.kind == "speed" and reversal.scale > 0
            else 2e-3 * float(signals.reference.robot.max_velocity[j])
        )
        both, alone = np.tanh(turning / scale), np.tanh(signals.qd[:, j] / scale)
        none = np.zeros(len(both))
        on_j = [ratio * signals.qdd[:, i], ratio * signals.qd[:, i], both - alone]
        faster = signals.qdd[:, j] + ratio * signals.qdd[:, i]
        on_i = [ratio * faster, ratio * turning, ratio * both]
        if "axle_side" in settings:
            on_j, on_i = [*on_j, none], [none, none, none, ratio * signals.rigid[:, j]]
        return {i: np.column_stack(on_i), j: np.column_stack(on_j)}

    def freedom(self, settings):
        return 1 + len(self.names(settings))
