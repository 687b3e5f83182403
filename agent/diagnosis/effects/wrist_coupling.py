"""Motors that turn along with another axis."""

import numpy as np

from agent.diagnosis.effects.effect import Effect
from agent.diagnosis.signals import Signals
from agent.estimation.friction_terms import AxleMotion, axle_columns

_RATIOS = (0.07, 0.12, 0.2, 0.35, 0.6, 1.0)
_REVERSAL = 2e-3  # of the highest speed, where the model's friction reverses over a travel or at once


class WristCoupling(Effect):
    """Axle j turns at w + r q̇_i and not at w = (C q̇)_j alone, so its rotor and friction act at that speed.

    What the axle's motor gives more, Δf = a r q̈_i + F(w + r q̇_i) − F(w), reaches joint k as C_jk Δf. F is the friction
    that the model has for the axle times a share near 1, or a viscous and a Coulomb part of their own (`free`) where
    the model's friction sits elsewhere. What joint i feels depends on where torque is reported. On the joint side its
    motor carries the axle's share too, Δτ_i = r (a (ẇ + r q̈_i) + F(w + r q̇_i)); on the axle's side the load of joint j
    without its rotor reaches it unseen, Δτ_i = r (d τ_j + a ẇ) with d near -1.
    """

    name = "wrist_coupling"
    scope = "pair"
    formula = "τ = C'ᵀ f(C' q̇) − Cᵀ f(C q̇), C' is C with r more in row j, column i"
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
        ratios = [sign * ratio for ratio in _RATIOS for sign in (-1.0, 1.0)]
        kinds = [{**free, **side} for free in ({}, {"free": 1.0}) for side in ({}, {"axle_side": 1.0})]
        return [{"ratio": ratio, **kind} for ratio in ratios for kind in kinds]

    def names(self, settings):
        friction = ("viscous", "coulomb") if "free" in settings else ("friction",)
        return ("rotor", *friction, *(("transmission",) if "axle_side" in settings else ()))

    def columns(self, signals, joints, settings):
        i, j = joints
        ratio = settings["ratio"]
        friction = _viscous_and_coulomb if "free" in settings else _model_friction
        alone, turned = (friction(signals, j, i, part) for part in (0.0, ratio))
        coupling = signals.reference.coupling[j]
        acceleration = signals.qdd @ coupling
        more = np.column_stack([ratio * signals.qdd[:, i], turned - alone])
        if "axle_side" in settings:
            more = np.column_stack([more, np.zeros(len(more))])
        columns = {k: coupling[k] * more for k in np.flatnonzero(coupling)}
        if "axle_side" in settings:
            carried = np.zeros_like(more)
            carried[:, 0], carried[:, -1] = acceleration, signals.rigid[:, j]
        else:
            carried = np.column_stack([acceleration + ratio * signals.qdd[:, i], turned])
        columns[i] = columns.get(i, 0.0) + ratio * carried
        return columns

    def plausible(self, settings, values):
        return 0.3 < values.get("friction", 1.0) < 1.7

    def freedom(self, settings):
        return 1 + len(self.names(settings))


def _model_friction(signals: Signals, axle: int, joint: int, ratio: float) -> np.ndarray:
    """(S, 1) friction of the model on an axle that also turns with a joint."""
    model, seen = signals.reference.model, signals.axles
    position, speed = seen.position.copy(), seen.speed.copy()
    position[:, axle] += ratio * signals.q[:, joint]
    speed[:, axle] += ratio * signals.qd[:, joint]
    terms = [(k, term) for k, term in enumerate(model.terms, len(model.independent)) if term.axle == axle]
    columns = axle_columns(tuple(term for _, term in terms), AxleMotion(position, speed, seen.load))
    return columns @ model.values[[k for k, _ in terms], None]


def _viscous_and_coulomb(signals: Signals, axle: int, joint: int, ratio: float) -> np.ndarray:
    """(S, 2) speed and direction of an axle that also turns with a joint."""
    reversal = signals.reference.reversals[axle]
    scale = reversal.scale if reversal.kind == "speed" else 0.0
    speed = signals.axles.speed[:, axle] + ratio * signals.qd[:, joint]
    usual = _REVERSAL * float(signals.reference.robot.max_velocity[axle])
    return np.column_stack([speed, np.tanh(speed / (scale or usual))])
