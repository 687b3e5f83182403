"""Gears that give way: two masses and a spring, with or without play between the teeth."""

from __future__ import annotations

from math import sqrt
from typing import Annotated

import numpy as np

from agent.core import InputError
from fake_controller.actuation.effect import JointEffect, effect
from fake_controller.actuation.machine import Gear, Machine

_USUAL_TOOTH_FREQUENCY = 60.0  # Hz, of rotor against link


def _reduced_inertia(machine: Machine, k: int) -> float:
    """[kg·m²] of the rotor swinging against a typical link."""
    rotor = machine.reflected_rotors[k]
    link = max(machine.typical_inertia[k] - rotor, 1e-3 * rotor)
    return float(rotor * link / (rotor + link))


def _mount(machine: Machine, k: int, name: str, gear: Gear) -> None:
    if k in machine.gears:
        raise InputError(f"effect {name}: joints: {machine.robot.joint_names[k]} has another gear effect already")
    machine.gears[k] = gear


@effect("joint_elasticity")
class SimulatedJointElasticity(JointEffect):
    """The gear is a spring of `stiffness` [N·m/rad] between rotor and link, with a damper of `damping_ratio`."""

    usual = staticmethod(lambda d: {"stiffness": d.inertia * (2 * np.pi * d.uniform(7, 11)) ** 2 / d.size})
    POSITIVE = ("stiffness",)
    stiffness: Annotated[float, "N·m/rad"]
    damping_ratio: float = 0.03

    def install_on(self, machine: Machine, k: int) -> None:
        self.damping = 2.0 * self.damping_ratio * sqrt(self.stiffness * _reduced_inertia(machine, k))
        _mount(machine, k, self.name, self)

    def torque(self, twist: float, twist_rate: float) -> float:
        return self.stiffness * twist + self.damping * twist_rate

    def twist(self, torque: float) -> float:
        return torque / self.stiffness


@effect("backlash")
class SimulatedBacklash(JointEffect):
    """Teeth with a play of `gap` [rad], flank to flank; they touch as springs of `stiffness` [N·m/rad].

    A stiffness of 0 stands for the usual: rotor against link at 60 Hz.
    """

    usual = staticmethod(lambda d: {"gap": 0.002 * d.size})
    POSITIVE = ("gap",)
    gap: Annotated[float, "rad"]
    stiffness: Annotated[float, "N·m/rad"] = 0.0
    damping_ratio: float = 0.1

    def install_on(self, machine: Machine, k: int) -> None:
        inertia = _reduced_inertia(machine, k)
        self.stiffness = self.stiffness or inertia * (2.0 * np.pi * _USUAL_TOOTH_FREQUENCY) ** 2
        self.damping = 2.0 * self.damping_ratio * sqrt(self.stiffness * inertia)
        self._half_gap = 0.5 * self.gap
        _mount(machine, k, self.name, self)

    def torque(self, twist: float, twist_rate: float) -> float:
        if twist > self._half_gap:
            # A flank pushes, it never pulls.
            return max(self.stiffness * (twist - self._half_gap) + self.damping * twist_rate, 0.0)
        if twist < -self._half_gap:
            return min(self.stiffness * (twist + self._half_gap) + self.damping * twist_rate, 0.0)
        return 0.0

    def twist(self, torque: float) -> float:
        return torque / self.stiffness + (self._half_gap if torque >= 0 else -self._half_gap)
