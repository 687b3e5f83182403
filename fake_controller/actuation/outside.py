"""Effects that no catalogue of the vocabulary has: what a diagnosis must call unknown."""

from __future__ import annotations

from math import exp, floor, sqrt, tanh
from typing import Annotated

import numpy as np

from fake_controller.actuation.effect import OUTSIDE, FrictionEffect, JointEffect, effect
from fake_controller.actuation.machine import Machine

_PATCHES = 512  # of a bearing, then they come again
_FULL_SPEED = 0.003  # rad/s of sliding beyond which a rough bearing opposes fully


@effect("rough_bearing", OUTSIDE)
class RoughBearing(JointEffect):
    """A pitted raceway: every patch of `patch` [rad] of the joint's travel drags by up to `amplitude` [N·m] more.

    The drag of each patch is drawn from `seed`, linear in between; it only opposes motion.
    """

    usual = staticmethod(
        lambda d: {"amplitude": 0.15 * d.size * d.nominal, "patch": d.uniform(0.04, 0.15), "seed": d.seed}
    )
    POSITIVE = ("amplitude", "patch")
    amplitude: Annotated[float, "N·m"]
    patch: Annotated[float, "rad"] = 0.1
    seed: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        rng = np.random.default_rng([int(self.seed), 11, k])
        self._drag = (self.amplitude * rng.uniform(size=_PATCHES) ** 2).tolist()
        machine.joint_loads[k].append(self)

    def torque(self, position: float, velocity: float, dt: float) -> float:
        at = position / self.patch
        first = floor(at)
        share = at - first
        drag = (1.0 - share) * self._drag[first % _PATCHES] + share * self._drag[(first + 1) % _PATCHES]
        return -drag * tanh(velocity / _FULL_SPEED)


@effect("wandering_torque", OUTSIDE)
class WanderingTorque(JointEffect):
    """A torque on the motor shaft that wanders: noise of `amplitude` [N·m] that forgets itself within `memory` [s].

    Ornstein and Uhlenbeck's process, drawn from `seed`: a bus voltage that breathes, an amplifier about to fail.
    """

    usual = staticmethod(
        lambda d: {
            "amplitude": 0.05 * d.size * d.nominal,
            "memory": float(np.exp(d.uniform(np.log(0.2), np.log(2.0)))),
            "seed": d.seed,
        }
    )
    POSITIVE = ("amplitude", "memory")
    amplitude: Annotated[float, "N·m"]
    memory: Annotated[float, "s"] = 0.5
    seed: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        self._rng = np.random.default_rng([int(self.seed), 12, k])
        self._value = 0.0
        self._drawn: list[float] = []
        machine.motor_loads[k].append(self)

    def torque(self, position: float, velocity: float, dt: float) -> float:
        if not self._drawn:
            self._drawn = self._rng.standard_normal(4096).tolist()
        decay = exp(-dt / self.memory)
        self._value = decay * self._value + sqrt(1.0 - decay * decay) * self.amplitude * self._drawn.pop()
        return self._value


@effect("rubbing_brake", OUTSIDE)
class RubbingBrake(FrictionEffect):
    """A brake that drags now and then: `drag` [N·m] more friction for `on` [s] on average, then none for `off` [s].

    The moments are drawn from `seed`.
    """

    usual = staticmethod(
        lambda d: {
            "drag": 0.1 * d.size * d.nominal,
            "on": d.uniform(0.2, 0.8),
            "off": d.uniform(0.5, 2),
            "seed": d.seed,
        }
    )
    POSITIVE = ("drag", "on", "off")
    drag: Annotated[float, "N·m"]
    on: Annotated[float, "s"] = 0.4
    off: Annotated[float, "s"] = 1.2
    seed: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        self._rng = np.random.default_rng([int(self.seed), 13, k])
        self._drags = False
        self._time_left = float(self._rng.exponential(self.off))
        super().install_on(machine, k)

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        return level + self.drag if self._drags else level

    def heat(self, power: float, dt: float) -> None:
        self._time_left -= dt
        if self._time_left <= 0.0:
            self._drags = not self._drags
            self._time_left = float(self._rng.exponential(self.on if self._drags else self.off))
