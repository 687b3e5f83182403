"""Effects that give the friction of a drive states of its own: temperature, and springs that stick and slip."""

from __future__ import annotations

from math import exp

from fake_controller.actuation.effect import JointEffect, effect
from fake_controller.actuation.friction import FrictionModifier
from fake_controller.actuation.machine import Machine


@effect("thermal_friction")
class SimulatedThermalFriction(JointEffect):
    """One thermal mass: time_constant · Ṫ = equilibrium + resistance · (friction power) − T, starting at `start`.

    T [K] counts from the temperature at which the machine's friction curves hold. The Coulomb level falls by
    `coulomb_rate` [1/K] of itself each kelvin, the viscous one by exp(−viscous_rate · T) as grease does.
    `resistance` [K/W], `time_constant` [s].
    """

    POSITIVE = ("time_constant",)
    start: float = 0.0
    equilibrium: float = 0.0
    resistance: float = 0.0
    time_constant: float = 60.0
    coulomb_rate: float = 0.0
    viscous_rate: float = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        machine.terms[k].append(_ThermalMass(self))


class _ThermalMass(FrictionModifier):
    def __init__(self, effect: SimulatedThermalFriction):
        self._effect = effect
        self.temperature: float = effect.start

    def level(self, level: float, speed: float, load: float) -> float:
        return level * (1.0 - self._effect.coulomb_rate * self.temperature)

    def viscous(self, torque: float, speed: float) -> float:
        return torque * exp(-self._effect.viscous_rate * self.temperature)

    def heat(self, power: float, dt: float) -> None:
        effect = self._effect
        steady = effect.equilibrium + effect.resistance * power
        self.temperature += (steady - self.temperature) * dt / effect.time_constant


@effect("presliding")
class SimulatedPresliding(JointEffect):
    """A `share` (0 to 0.9) of the Coulomb level builds up over `travel` [rad] after each reversal.

    Six springs in parallel, each slipping at its own stretch (Iwan, 1966): a hysteresis in position with the memory
    of inner loops. The level in steady sliding stays what it was.
    """

    POSITIVE = ("travel",)
    share: float
    travel: float

    def install_on(self, machine: Machine, k: int) -> None:
        self.need(0.0 <= self.share <= 0.9, "share", "between 0 and 0.9")
        machine.terms[k].append(_SlipChain(self, machine.friction[k].coulomb))


class _SlipChain(FrictionModifier):
    ELEMENTS = 6

    def __init__(self, effect: SimulatedPresliding, coulomb: float):
        self._torque = effect.share * coulomb
        # Evenly spread limits; the mean reversal is complete after `travel`.
        self._limits = [effect.travel * (i + 0.5) / self.ELEMENTS for i in range(self.ELEMENTS)]
        self._stretch = [0.0] * self.ELEMENTS

    def level(self, level: float, speed: float, load: float) -> float:
        return level - self._torque

    def bristles(self, speed: float, dt: float) -> float:
        total = 0.0
        for i, limit in enumerate(self._limits):
            stretch = self._stretch[i] + speed * dt
            self._stretch[i] = stretch = min(max(stretch, -limit), limit)
            total += stretch / limit
        return self._torque * total / self.ELEMENTS
