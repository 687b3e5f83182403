"""Effects that alter the friction of a drive, some with a temperature or with springs that stick and slip."""

from __future__ import annotations

from dataclasses import replace
from math import asinh, exp
from typing import Annotated

from fake_controller.actuation.effect import FrictionEffect, JointEffect, effect
from fake_controller.actuation.machine import Machine

_SPRINGS = 6  # that slip one after the other


@effect("stribeck")
class SimulatedStribeck(FrictionEffect):
    """The bristles hold up to `rise` [N·m] more at low speed, fading as 1 / (1 + (|v| / speed)^shape).

    Hess, Soom, J. Tribology 112 (1990): a longer tail than an exponential has.
    """

    usual = staticmethod(lambda d: {"rise": 0.06 * d.size * d.nominal, "speed": d.uniform(0.02, 0.08) * d.fastest})
    POSITIVE = ("speed", "shape")
    rise: Annotated[float, "N·m"]
    speed: Annotated[float, "rad/s"]
    shape: float = 2.0

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        return level + self.rise / (1.0 + (abs(speed) / self.speed) ** self.shape)


@effect("asymmetric_friction")
class SimulatedAsymmetricFriction(FrictionEffect):
    """Coulomb and viscous levels are higher by these fractions where the axle turns forward, lower backward."""

    usual = staticmethod(
        lambda d: {"coulomb": d.sign * min(0.25 * d.size, 0.8), "viscous_fraction": d.sign * min(0.3 * d.size, 0.8)}
    )
    coulomb: float = 0.0
    viscous_fraction: float = 0.0

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        return level * (1.0 + self.coulomb if speed > 0 else 1.0 - self.coulomb)

    def viscous(self, torque: float, speed: float) -> float:
        return torque * (1.0 + self.viscous_fraction if speed > 0 else 1.0 - self.viscous_fraction)


@effect("load_dependent_friction")
class SimulatedLoadDependentFriction(FrictionEffect):
    """Teeth rub by `coefficient` N·m each N·m that they transmit, once they bear: below a tenth of nominal, less."""

    usual = staticmethod(lambda d: {"coefficient": 0.12 * d.size})
    coefficient: Annotated[float, "N·m/(N·m)"]

    def install_on(self, machine: Machine, k: int) -> None:
        self._bearing = 0.1 * float(machine.nominal[k])
        super().install_on(machine, k)

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        return level + self.coefficient * load * load / (abs(load) + self._bearing)


@effect("viscous_nonlinearity")
class SimulatedViscousNonlinearity(FrictionEffect):
    """A film that shears thin, `torque` · asinh(v / `speed`) (Eyring), and churning, `cubic` · v³ [N·m·s³/rad³]."""

    usual = staticmethod(lambda d: {"torque": 0.08 * d.size * d.nominal, "speed": d.uniform(0.02, 0.06) * d.fastest})
    POSITIVE = ("speed",)
    torque: Annotated[float, "N·m"] = 0.0
    speed: Annotated[float, "rad/s"] = 0.2
    cubic: Annotated[float, "N·m·s³/rad³"] = 0.0

    def viscous(self, torque: float, speed: float) -> float:
        return torque + self.torque * asinh(speed / self.speed) + self.cubic * speed**3


@effect("friction_change")
class SimulatedFrictionChange(JointEffect):
    """Wear or another grease: the Coulomb and viscous levels are these multiples of what the machine had."""

    usual = staticmethod(
        lambda d: {
            "coulomb": 1 + d.sign * min(0.4 * d.size, 0.7),
            "viscous": 1 + d.sign * min(d.uniform(0, 0.5) * d.size, 0.7),
        }
    )
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


@effect("thermal_friction")
class SimulatedThermalFriction(FrictionEffect):
    """One thermal mass: time_constant · Ṫ = equilibrium + resistance · (friction power) − T, starting at `start`.

    T [K] counts from the temperature at which the machine's friction curves hold. The Coulomb level falls by
    `coulomb_rate` [1/K] of itself each kelvin, the viscous one by exp(−viscous_rate · T) as grease does.
    `resistance` [K/W], `time_constant` [s].
    """

    usual = staticmethod(
        lambda d: {
            "start": -25.0,
            "time_constant": d.uniform(10, 60),
            "coulomb_rate": 0.012 * d.size,
            "viscous_rate": 0.02 * d.size,
        }
    )
    POSITIVE = ("time_constant",)
    start: Annotated[float, "K"] = 0.0
    equilibrium: Annotated[float, "K"] = 0.0
    resistance: Annotated[float, "K/W"] = 0.0
    time_constant: Annotated[float, "s"] = 60.0
    coulomb_rate: Annotated[float, "1/K"] = 0.0
    viscous_rate: Annotated[float, "1/K"] = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        self.temperature: float = self.start
        super().install_on(machine, k)

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        return level * (1.0 - self.coulomb_rate * (self.temperature or 0.0))

    def viscous(self, torque: float, speed: float) -> float:
        return torque * exp(-self.viscous_rate * (self.temperature or 0.0))

    def heat(self, power: float, dt: float) -> None:
        steady = self.equilibrium + self.resistance * power
        now = self.temperature or 0.0
        self.temperature = now + (steady - now) * dt / self.time_constant


@effect("presliding")
class SimulatedPresliding(FrictionEffect):
    """A `share` (0 to 0.9) of the Coulomb level builds up over `travel` [rad] after each reversal.

    Six springs in parallel, each slipping at its own stretch (Iwan, 1966): a hysteresis in position with the memory
    of inner loops. The level in steady sliding stays what it was.
    """

    usual = staticmethod(lambda d: {"share": d.uniform(0.6, 0.9), "travel": 0.02 * d.size})
    POSITIVE = ("travel",)
    share: float
    travel: Annotated[float, "rad"]

    def install_on(self, machine: Machine, k: int) -> None:
        self.need(0.0 <= self.share <= 0.9, "share", "between 0 and 0.9")
        self._torque = self.share * machine.friction[k].coulomb
        # Evenly spread limits; the mean reversal is complete after `travel`.
        self._limits = [self.travel * (i + 0.5) / _SPRINGS for i in range(_SPRINGS)]
        self._stretch = [0.0] * _SPRINGS
        super().install_on(machine, k)

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        return level - self._torque

    def bristles(self, speed: float, dt: float) -> float:
        total = 0.0
        for i, limit in enumerate(self._limits):
            stretch = self._stretch[i] + speed * dt
            self._stretch[i] = stretch = min(max(stretch, -limit), limit)
            total += stretch / limit
        return self._torque * total / _SPRINGS
