"""Effects that no catalogue of the vocabulary has: what a diagnosis must call unknown."""

from __future__ import annotations

from math import exp, floor, sqrt, tanh

import numpy as np

from fake_controller.actuation.effect import OUTSIDE, JointEffect, effect
from fake_controller.actuation.friction import FrictionModifier
from fake_controller.actuation.machine import Machine

_FULL_SPEED = 0.003  # rad/s of sliding beyond which a rough bearing opposes fully


@effect("rough_bearing", OUTSIDE)
class RoughBearing(JointEffect):
    """A pitted raceway: every patch of `patch` [rad] of the joint's travel drags by up to `amplitude` [N·m] more.

    The drag of each patch is drawn from `seed`, linear in between; it only opposes motion.
    """

    POSITIVE = ("amplitude", "patch")
    amplitude: float
    patch: float = 0.1
    seed: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        machine.joint_loads[k].append(_Raceway(self, k))


class _Raceway:
    PATCHES = 512

    def __init__(self, effect: RoughBearing, k: int):
        rng = np.random.default_rng([int(effect.seed), 11, k])
        self._drag = (effect.amplitude * rng.uniform(size=self.PATCHES) ** 2).tolist()
        self._patch = effect.patch

    def torque(self, position: float, velocity: float, dt: float) -> float:
        at = position / self._patch
        first = floor(at)
        share = at - first
        drag = (1.0 - share) * self._drag[first % self.PATCHES] + share * self._drag[(first + 1) % self.PATCHES]
        return -drag * tanh(velocity / _FULL_SPEED)


@effect("wandering_torque", OUTSIDE)
class WanderingTorque(JointEffect):
    """A torque on the motor shaft that wanders: noise of `amplitude` [N·m] that forgets itself within `memory` [s].

    Ornstein and Uhlenbeck's process, drawn from `seed`: a bus voltage that breathes, an amplifier about to fail.
    """

    POSITIVE = ("amplitude", "memory")
    amplitude: float
    memory: float = 0.5
    seed: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        machine.motor_loads[k].append(_Wandering(self, k))


class _Wandering:
    def __init__(self, effect: WanderingTorque, k: int):
        self._rng = np.random.default_rng([int(effect.seed), 12, k])
        self._effect = effect
        self._value = 0.0
        self._drawn: list[float] = []

    def torque(self, position: float, velocity: float, dt: float) -> float:
        if not self._drawn:
            self._drawn = self._rng.standard_normal(4096).tolist()
        kept = exp(-dt / self._effect.memory)
        self._value = kept * self._value + sqrt(1.0 - kept * kept) * self._effect.amplitude * self._drawn.pop()
        return self._value


@effect("rubbing_brake", OUTSIDE)
class RubbingBrake(JointEffect):
    """A brake that drags now and then: `drag` [N·m] more friction for `on` [s] on average, then none for `off` [s].

    The moments are drawn from `seed`.
    """

    POSITIVE = ("drag", "on", "off")
    drag: float
    on: float = 0.4
    off: float = 1.2
    seed: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        machine.terms[k].append(_Brake(self, k))


class _Brake(FrictionModifier):
    def __init__(self, effect: RubbingBrake, k: int):
        self._rng = np.random.default_rng([int(effect.seed), 13, k])
        self._effect = effect
        self._drags = False
        self._left = float(self._rng.exponential(effect.off))

    def level(self, level: float, speed: float, load: float) -> float:
        return level + self._effect.drag if self._drags else level

    def heat(self, power: float, dt: float) -> None:
        self._left -= dt
        if self._left <= 0.0:
            self._drags = not self._drags
            self._left = float(self._rng.exponential(self._effect.on if self._drags else self._effect.off))
