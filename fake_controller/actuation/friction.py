"""Friction of the simulated drives: a bristle state, no sign function.

The LuGre form (Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 1995) without its micro-damping, written for the
bristles' torque z:

    ż = k (v − |v| z / g(v)),   g(v) = Coulomb + rise · exp(−(v / v_s)²),   friction = z + f v / (1 + |v| / v_k)

It sticks, gives way smoothly over a few hundredths of a
milliradian, and its viscous part bends with speed as a shear-thinning grease does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FrictionCurve:
    """Friction of one axle [N·m, rad, s].

    `coulomb` level and the `rise` of the stiction over it, `stribeck_speed` v_s, `viscous` f, `knee` v_k, and
    `stiffness` k of the bristles [N·m/rad].
    """

    coulomb: float
    rise: float
    stribeck_speed: float
    viscous: float
    knee: float
    stiffness: float

    @property
    def numbers(self) -> tuple[float, ...]:
        """As `agent.simulators.RigidActuation` has bristles."""
        return self.coulomb, self.rise, 1.0 / self.stribeck_speed, self.viscous, 1.0 / self.knee, self.stiffness

    def steady(self, speed: np.ndarray) -> np.ndarray:
        """(S,) torque that opposes a constant speed (S,)."""
        level = self.coulomb + self.rise * np.exp(-((speed / self.stribeck_speed) ** 2))
        return np.sign(speed) * level + self.viscous * speed / (1.0 + np.abs(speed) / self.knee)


class FrictionModifier:
    """Something that alters the friction of one axle; each method gives back what it was given unless overridden.

    `temperature` [K] is above the one at which the machine's friction curves hold, None for what has none.
    """

    temperature: float | None = None

    def level(self, level: float, speed: float, load: float, angle: float) -> float:
        """Coulomb level [N·m] at `speed` [rad/s] and `angle` [rad] of the axle; its gear transmits `load` [N·m]."""
        return level

    def viscous(self, torque: float, speed: float) -> float:
        """Viscous torque [N·m]."""
        return torque

    def bristles(self, speed: float, dt: float) -> float:
        """Torque [N·m] of bristles of its own, advanced by `dt`."""
        return 0.0

    def heat(self, power: float, dt: float) -> None:
        """What the friction of the axle dissipates [W]."""
