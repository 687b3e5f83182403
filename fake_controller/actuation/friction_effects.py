"""Effects that alter the friction of a drive without states of their own."""

from __future__ import annotations

from dataclasses import replace
from math import asinh

from fake_controller.actuation.effect import FrictionEffect, JointEffect, effect
from fake_controller.actuation.friction import FrictionModifier
from fake_controller.actuation.machine import Machine


@effect("stribeck")
class SimulatedStribeck(FrictionEffect):
    """The bristles hold up to `rise` [N·m] more at low speed, fading as 1 / (1 + (|v| / speed)^shape).

    Hess, Soom, J. Tribology 112 (1990): a longer tail than an exponential has.
    """

    POSITIVE = ("speed", "shape")
    rise: float
    speed: float
    shape: float = 2.0

    def level(self, level: float, speed: float, load: float) -> float:
        return level + self.rise / (1.0 + (abs(speed) / self.speed) ** self.shape)


@effect("asymmetric_friction")
class SimulatedAsymmetricFriction(FrictionEffect):
    """Coulomb and viscous levels are higher by these fractions where the axle turns forward, lower backward."""

    coulomb: float = 0.0
    viscous_fraction: float = 0.0

    def level(self, level: float, speed: float, load: float) -> float:
        return level * (1.0 + self.coulomb if speed > 0 else 1.0 - self.coulomb)

    def viscous(self, torque: float, speed: float) -> float:
        return torque * (1.0 + self.viscous_fraction if speed > 0 else 1.0 - self.viscous_fraction)


@effect("load_dependent_friction")
class SimulatedLoadDependentFriction(JointEffect):
    """Teeth rub by `coefficient` N·m each N·m that they transmit, once they bear: below a tenth of nominal, less."""

    coefficient: float

    def install_on(self, machine: Machine, k: int) -> None:
        machine.terms[k].append(_RubbingTeeth(self.coefficient, 0.1 * float(machine.nominal[k])))


class _RubbingTeeth(FrictionModifier):
    def __init__(self, coefficient: float, bearing: float):
        self._coefficient, self._bearing = coefficient, bearing

    def level(self, level: float, speed: float, load: float) -> float:
        return level + self._coefficient * load * load / (abs(load) + self._bearing)


@effect("viscous_nonlinearity")
class SimulatedViscousNonlinearity(FrictionEffect):
    """A film that shears thin, `torque` · asinh(v / `speed`) (Eyring), and churning, `cubic` · v³ [N·m·s³/rad³]."""

    POSITIVE = ("speed",)
    torque: float = 0.0
    speed: float = 0.2
    cubic: float = 0.0

    def viscous(self, torque: float, speed: float) -> float:
        return torque + self.torque * asinh(speed / self.speed) + self.cubic * speed**3


@effect("friction_change")
class SimulatedFrictionChange(JointEffect):
    """Wear or another grease: the Coulomb and viscous levels are these multiples of what the machine had."""

    POSITIVE = ("coulomb",)
    coulomb: float = 1.0
    viscous: float = 1.0

    def install_on(self, machine: Machine, k: int) -> None:
        curve = machine.friction[k]
        machine.friction[k] = replace(
            curve,
            coulomb=curve.coulomb * self.coulomb,
            rise=curve.rise * self.coulomb,
            viscous=curve.viscous * self.viscous,
        )
