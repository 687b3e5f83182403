"""Forces at a joint that a simulator can have by itself: springs, damping, bristles, waves over the angle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial

_SAMPLES = 100  # of a curve that a polynomial is laid through


@dataclass(frozen=True)
class Bristles:
    """Friction of bristles: dz/dt = w − σ |w| z / g(w), τ = σ z, g = level + rise exp(−(w / speed)²) [N·m], LuGre's
    without damping of its own (Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40, 1995), Dahl's without a rise.

    σ is such that they carry the greatest g after a `travel` [rad], 0 for one that is to be as short as possible.
    `additional` to the joint's friction, or a part of it.
    """

    level: float = 0.0
    rise: float = 0.0
    speed: float = 1.0
    travel: float = 0.0
    additional: bool = False

    def of_joint(self, friction: float) -> Bristles:
        """With what they take of the Coulomb friction [N·m] of their joint: all of it where it falls with speed."""
        if self.additional:
            return self
        return replace(self, level=friction if self.rise else min(self.level, friction))

    def torque(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """(S,) torque [N·m] on consecutive positions and speeds (S,), all of their friction included."""
        carried = self.level + self.rise * np.exp(-((qd / self.speed) ** 2))
        sliding, stiffness = carried * np.sign(qd), (self.level + self.rise) / max(self.travel, 1e-12)
        force, before = sliding.copy(), sliding[0]
        for k, fading in enumerate(np.exp(-stiffness * np.abs(np.diff(q)) / np.maximum(carried[1:], 1e-12)), start=1):
            force[k] = before = sliding[k] + (before - sliding[k]) * fading
        return force


@dataclass(frozen=True)
class PassiveForces:
    """What an effect is at its joint, as a simulator with passive forces can say it: the torque against the motion.

    `spring` (c₀ … c₃): Σ cₖ qᵏ [N·m/radᵏ]. `damping` (a, b, c): a w + b w|w| + c w³. `periodic`: amplitude [N·m], order
    and phase [rad] of amplitude · sin(order · q + phase). On a slide metres stand for radians.
    """

    spring: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    damping: tuple[float, float, float] = (0.0, 0.0, 0.0)
    periodic: tuple[tuple[float, float, float], ...] = ()
    bristles: Bristles | None = None

    def torque(self, q: np.ndarray, qd: np.ndarray, friction: float) -> np.ndarray:
        """(S,) torque [N·m] beyond the joint's Coulomb `friction` [N·m] at consecutive positions and speeds (S,)."""
        a, b, c = self.damping
        total = np.polynomial.polynomial.polyval(q, self.spring) + (a + b * np.abs(qd) + c * qd**2) * qd
        for amplitude, order, phase in self.periodic:
            total = total + amplitude * np.sin(order * q + phase)
        if self.bristles is not None:
            bristles = self.bristles.of_joint(friction)
            total = total + bristles.torque(q, qd) - (0.0 if bristles.additional else bristles.level) * np.sign(qd)
        return total


def periodic(values: Mapping[str, float], order: float = 1.0) -> tuple[tuple[float, float, float], ...]:
    """Σ cosine_h cos(h ν q) + sine_h sin(h ν q) with ν the `order`, as sines with a phase."""
    count = int(values["harmonics"])
    return tuple(
        (float(np.hypot(sine, cosine)), h * order, float(np.arctan2(cosine, sine)))
        for h in range(1, count + 1)
        for cosine, sine in [(values[f"cosine_{h}"], values[f"sine_{h}"])]
    )


def spring_near(
    curve: Callable[[np.ndarray], np.ndarray], low: float, high: float
) -> tuple[float, float, float, float]:
    """The `spring` of least squares to a torque `curve` over positions from `low` to `high`."""
    q = np.linspace(low, high, _SAMPLES)
    return spring_of(Polynomial.fit(q, curve(q), 3).convert())


def spring_of(torque: Polynomial) -> tuple[float, float, float, float]:
    """The `spring` of a cubic in the position."""
    c0, c1, c2, c3 = map(float, np.append(torque.coef, np.zeros(4))[:4])
    return c0, c1, c2, c3


def damping_near(curve: Callable[[np.ndarray], np.ndarray], fastest: float) -> tuple[float, float, float]:
    """The `damping` of least squares to a torque `curve` over speeds up to the `fastest`."""
    speed = np.linspace(0.0, fastest, _SAMPLES)
    a, b, c = map(float, np.linalg.lstsq(speed[:, None] ** [1, 2, 3], curve(speed), rcond=None)[0])
    return a, b, c


def bell_near(rise: float, speed: float) -> tuple[float, float]:
    """Height and width of the bell that has area and mean of rise · exp(−w / speed) over speeds w."""
    return 2 / np.pi * rise, float(np.sqrt(np.pi)) * speed
