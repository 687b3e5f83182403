"""Motors that turn along with another axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import (
    BELOW_ZERO,
    BENDS,
    SLIDES,
    Columns,
    Effect,
    FitContext,
    Joints,
    Numbers,
    near_one,
)
from agent.model.friction_terms import AxleMotion, axle_columns
from agent.robot import RobotDescription

#: Below the least what the coupled axle rubs is no other than what it rubs by itself.
_RATIOS = tuple(np.geomspace(0.04, 2.0, 13).tolist())
_WRIST = 3  # derived: axes that meet in a wrist
_FEW_RATIOS = _RATIOS[::3]
_PARTS = ("coupling", "filtered coupling")  # names of what a motion remembers


class WristCoupling(Effect):
    """Axle j turns at w + r q̇_i and not at w = (C q̇)_j alone, so its rotor and friction act at that speed.

    What the axle's motor gives more, Δf_j = a r q̈_i + b (F(w + r q̇_i) − F(w)), reaches joint k as C_jk Δf_j. F is the
    friction that the model has for the axle, and b near 1. What else there is depends on where torque is reported. On
    the joint side the motor of joint i carries the axle's share too, Δτ_i = r (a (ẇ + r q̈_i) + b F(w + r q̇_i)). On the
    axles' side the load f_j of the axle, without its rotor, reaches axle i unseen: Δf_i = r (a ẇ − b f_j). Where the
    model's friction sits elsewhere, viscous and Coulomb part and that load have factors of their own (`free`).

    A seal or bearing of the coupled shaft rubs at that speed too, c sign(w + r q̇_i) + d (w + r q̇_i) on axle j, and r
    times that on joint i: though the motors turn as described (`besides`), or where they do not (`turning`, too). Other
    parts at that speed may add an inertia (`shaft`), e (ẇ + r q̈_i).
    """

    name = "wrist_coupling"
    family = "transmission"
    stepped = "arm_coupled"
    scope = "pair"
    formula = "τ = C'ᵀ f(C' q̇) − Cᵀ f(C q̇), C' is C with r more in row j, column i"
    source = "power is kept, so torques go by the transpose: Khalil, Dombre (2002), coupled transmissions"
    signature = "residual on two wrist axes, each with the speed and acceleration of the other"
    confused_with = ("friction_change",)
    phrase = "one motor turns along with another axis"
    look_at = "motor_coupling in the robot description; coupling compensation of the controller"
    units = MappingProxyType({"rotor": "kg·m²", "inertia": "kg·m²", "coulomb": "N·m", "viscous": "N·m·s/rad"})
    leading = ("ratio",)
    needs_travel = BENDS
    needs_speed = SLIDES
    refined = ("ratio",)
    nonlinear = ("ratio",)

    def possible_joints(self, robot: RobotDescription) -> list[tuple[int, ...]]:
        first = max(0, robot.dof - _WRIST)
        return [(i, j) for i in range(first, robot.dof) for j in range(i + 1, robot.dof)]

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        kinds = [
            *({"ratio": ratio} for ratio in _RATIOS),
            *({"ratio": ratio, "free": 1.0} for ratio in _FEW_RATIOS),
        ]
        sides: tuple[dict[str, float], ...] = ({}, {"axle_side": 1.0})
        turning = [{**kind, **side} for kind in kinds for side in sides]
        rubbing = [{"ratio": ratio, "besides": 1.0} for ratio in _RATIOS]
        rubbing += [{"ratio": ratio, "besides": 1.0, "turning": 1.0} for ratio in _FEW_RATIOS]
        return [{**kind, "ratio": sign * kind["ratio"]} for kind in turning + rubbing for sign in (-1.0, 1.0)]

    def nearby(self, settings: Numbers, factor: float) -> list[dict[str, float]]:
        """Several steps each way, as the gain peaks narrowly over the ratio; a free one with the model's friction."""
        tied = {name: value for name, value in settings.items() if name != "free"}
        kinds = [settings, tied] if "free" in settings else [settings]
        if "besides" in settings:
            rubbing = {"ratio": settings["ratio"], "besides": 1.0}
            kinds = [rubbing, {**rubbing, "turning": 1.0}, {**rubbing, "shaft": 1.0}]
        return [{**kind, "ratio": kind["ratio"] * factor**power} for kind in kinds for power in range(-3, 4)]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        if "besides" in settings:
            more = ("rotor", "share") if "turning" in settings else ("inertia",) if "shaft" in settings else ()
            return ("viscous", "coulomb", *more)
        if "free" not in settings:
            return ("rotor", "share")
        return ("rotor", "viscous", "coulomb", *(("transmission",) if "axle_side" in settings else ()))

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return self._made(_Parts(signals), joints, settings)

    def filtered(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return self._made(_Parts(signals, filtered=True), joints, settings)

    def _made(self, parts: _Parts, joints: Joints, settings: Numbers) -> Columns:
        i, j = joints
        ratio = settings["ratio"]
        coupling = parts.signals.reference.coupling
        if "besides" in settings:
            rubbing = parts.friction(j, i, ratio, free=True)
            if "shaft" in settings:
                rubbing = np.column_stack([rubbing, parts.axle(j) + ratio * parts.joint(i)])
            shares = coupling[j] + ratio * np.eye(len(coupling))[i]
            columns = {int(k): shares[k] * rubbing for k in np.flatnonzero(shares)}
            if "turning" not in settings:
                return columns
            motor, none = self._made(parts, joints, {"ratio": ratio}), np.zeros_like(rubbing)
            return {k: np.hstack([columns.get(k, none), motor.get(k, none)]) for k in columns.keys() | motor.keys()}
        uncoupled, turned = (parts.friction(j, i, part, "free" in settings) for part in (0.0, ratio))
        width = len(self.names(settings))
        more, carried = np.zeros((2, len(uncoupled), width))
        last = 1 + uncoupled.shape[1]
        more[:, 0], more[:, 1:last] = ratio * parts.joint(i), turned - uncoupled
        if "axle_side" in settings:
            carriers = coupling[i]
            carried[:, 0] = parts.axle(j)
            carried[:, -1] = parts.load(j) * (1.0 if "free" in settings else -1.0)
        else:
            carriers = np.eye(len(coupling))[i]
            carried[:, 0], carried[:, 1:last] = parts.axle(j) + ratio * parts.joint(i), turned
        felt = np.flatnonzero(np.abs(coupling[j]) + np.abs(carriers))
        return {int(k): coupling[j, k] * more + carriers[k] * ratio * carried for k in felt}

    def release(self, motions: Sequence[MotionSignals]) -> None:
        for motion, name in product(motions, _PARTS):
            motion.memory.pop(name, None)

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        if abs(settings["ratio"]) < _RATIOS[0]:
            return False
        if "besides" in settings:
            rubs = values["coulomb"] > 0 or values["viscous"] > 0
            turns = min(values.get("rotor", 1.0), values.get("inertia", 1.0)) > 0
            return rubs and turns and near_one(values.get("share", 1.0))
        as_ratio = near_one(values.get("share", 1.0))
        return values["rotor"] > 0 and as_ratio and values.get("transmission", -1.0) < 0

    def possible(self, reference: NominalModel, joints: Joints, settings: Numbers, values: Numbers) -> bool:
        """Friction at the coupled speed never drives, apart from a tenth of its size: both are estimates."""
        if "besides" not in settings:
            return True
        at_most = values["viscous"] * float(reference.robot.max_velocity[joints[1]])
        return min(values["coulomb"], at_most) > -BELOW_ZERO * max(values["coulomb"], at_most)


class _Parts:
    """Signals of all columns along one motion, `filtered` like the torque."""

    def __init__(self, signals: MotionSignals, filtered: bool = False):
        self.signals, self._filtered = signals, filtered
        self._key = _PARTS[filtered]

    def friction(self, axle: int, joint: int, ratio: float, free: bool) -> np.ndarray:
        """(S, 1) of the model on an axle that also turns with a joint, or (S, 2) parts of its own."""
        make = _viscous_and_coulomb if free else _model_friction
        return self._part((axle, joint if ratio else axle, ratio, free), lambda: make(self.signals, axle, joint, ratio))

    def axle(self, axle: int) -> np.ndarray:
        """(S,) acceleration of an axle as described."""
        return self._part(("axle", axle), lambda: self.signals.qdd @ self.signals.reference.coupling[axle])

    def joint(self, joint: int) -> np.ndarray:
        """(S,) acceleration of a joint."""
        return self._part(("joint", joint), lambda: self.signals.qdd[:, joint])

    def load(self, axle: int) -> np.ndarray:
        """(S,) torque that an axle carries, without its rotor."""
        carried = self.signals.axles.load
        assert carried is not None
        return self._part(("load", axle), lambda: carried[:, axle])

    def _part(self, key: tuple[object, ...], make: Callable[[], np.ndarray]) -> np.ndarray:
        """Computed once, because many forms need the same part."""
        parts = self.signals.remembered(self._key, dict)
        if key not in parts:
            part = make()
            flat = part.reshape(len(part), -1)
            parts[key] = self.signals.low_pass(flat).reshape(-1, *part.shape[1:]) if self._filtered else part
        return parts[key]


def _model_friction(signals: MotionSignals, axle: int, joint: int, ratio: float) -> np.ndarray:
    """(S, 1) friction of the model on an axle that also turns with a joint."""
    model, axles = signals.reference.model, signals.axles
    position = axles.position[:, axle] + ratio * signals.q[:, joint]
    speed = axles.speed[:, axle] + ratio * signals.qd[:, joint]
    load = None if axles.load is None else axles.load[:, [axle]]
    terms = [(k, term) for k, term in enumerate(model.terms, len(model.independent)) if term.axle == axle]
    one_axle = AxleMotion(position[:, None], speed[:, None], load)
    columns = axle_columns(tuple(replace(term, axle=0) for _, term in terms), one_axle)
    return columns @ model.values[[k for k, _ in terms], None]


def _viscous_and_coulomb(signals: MotionSignals, axle: int, joint: int, ratio: float) -> np.ndarray:
    """(S, 2) speed and direction of an axle that also turns with a joint."""
    reversal = signals.reference.reversals[axle]
    scale = reversal.scale if reversal.kind == "speed" else 0.0
    speed = signals.axles.speed[:, axle] + ratio * signals.qd[:, joint]
    return np.column_stack([speed, np.tanh(speed / (scale or signals.reference.sharp_reversal(axle).scale))])
