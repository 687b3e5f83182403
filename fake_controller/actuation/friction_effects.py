"""Effects that alter the friction of a drive without states of their own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import asinh, exp
from typing import ClassVar

from fake_controller.actuation.effect import JointEffect
from fake_controller.actuation.friction import FrictionModifier
from fake_controller.actuation.machine import Machine


@dataclass(frozen=True, kw_only=True)
class SimulatedStribeck(JointEffect, FrictionModifier):
    """The bristles hold up to `rise` [N·m] more at low speed, fading with exp(−(|v| / speed)^shape)."""

    name: ClassVar[str] = "stribeck"
    rise: float
    speed: float
    shape: float = 2.0

    def level(self, level: float, speed: float, load: float) -> float:
        return level + self.rise * exp(-((abs(speed) / self.speed) ** self.shape))

    def install_on(self, machine: Machine, k: int) -> None:
        self.need_positive("speed", "shape")
        machine.terms.setdefault(k, []).append(self)


@dataclass(frozen=True, kw_only=True)
class SimulatedAsymmetricFriction(JointEffect, FrictionModifier):
    """Coulomb and viscous levels are higher by these fractions where the axle turns forward, lower backward."""

    name: ClassVar[str] = "asymmetric_friction"
    coulomb: float = 0.0
    viscous_fraction: float = 0.0

    def level(self, level: float, speed: float, load: float) -> float:
        return level * (1.0 + self.coulomb if speed > 0 else 1.0 - self.coulomb)

    def viscous(self, torque: float, speed: float) -> float:
        return torque * (1.0 + self.viscous_fraction if speed > 0 else 1.0 - self.viscous_fraction)

    def install_on(self, machine: Machine, k: int) -> None:
        machine.terms.setdefault(k, []).append(self)


@dataclass(frozen=True, kw_only=True)
class SimulatedLoadDependentFriction(JointEffect, FrictionModifier):
    """The Coulomb level grows with the torque that the gear transmits, by `coefficient` N·m each N·m."""

    name: ClassVar[str] = "load_dependent_friction"
    coefficient: float

    def level(self, level: float, speed: float, load: float) -> float:
        return level + self.coefficient * abs(load)

    def install_on(self, machine: Machine, k: int) -> None:
        machine.terms.setdefault(k, []).append(self)


@dataclass(frozen=True, kw_only=True)
class SimulatedViscousNonlinearity(JointEffect, FrictionModifier):
    """A film that shears thin, `torque` · asinh(v / `speed`) (Eyring), and churning, `cubic` · v³ [N·m·s³/rad³]."""

    name: ClassVar[str] = "viscous_nonlinearity"
    torque: float = 0.0
    speed: float = 0.2
    cubic: float = 0.0

    def viscous(self, torque: float, speed: float) -> float:
        return torque + self.torque * asinh(speed / self.speed) + self.cubic * speed**3

    def install_on(self, machine: Machine, k: int) -> None:
        self.need_positive("speed")
        machine.terms.setdefault(k, []).append(self)


@dataclass(frozen=True, kw_only=True)
class SimulatedFrictionChange(JointEffect):
    """Wear or another grease: the Coulomb and viscous levels are these multiples of what the machine had."""

    name: ClassVar[str] = "friction_change"
    coulomb: float = 1.0
    viscous: float = 1.0

    def install_on(self, machine: Machine, k: int) -> None:
        self.need_positive("coulomb")
        curve = machine.friction[k]
        machine.friction[k] = replace(
            curve,
            coulomb=curve.coulomb * self.coulomb,
            rise=curve.rise * self.coulomb,
            viscous=curve.viscous * self.viscous,
        )
