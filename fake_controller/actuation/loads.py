"""Torques in addition to friction and gears: ripple of the motor, springs, hoses, external forces."""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import Annotated

import numpy as np

from fake_controller.actuation.effect import ArmEffect, JointEffect, effect
from fake_controller.actuation.machine import Machine


@effect("torque_ripple")
class SimulatedTorqueRipple(JointEffect):
    """The torque is off by `amplitude` · sin(x + sin(x) / 3) [N·m, joint side], x = order · motor angle + phase.

    Magnets and teeth make no pure sine: the wave leans to one side and has all harmonics.

    `order` counts periods a motor turn: whole for cogging and current sensors, a fraction for gear angles.
    """

    usual = staticmethod(
        lambda d: {
            "amplitude": 0.06 * d.size * d.nominal,
            "order": float(d.rng.choice([0.5, 1.0, 2.0])),
            "phase": d.uniform(0, 6),
        }
    )
    amplitude: Annotated[float, "N·m"]
    order: Annotated[float, "1/motor turn"]
    phase: Annotated[float, "rad"] = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        self._per_angle = self.order * machine.robot.joints[k].gear_ratio
        machine.motor_loads[k].append(self)

    def torque(self, position: float, velocity: float, dt: float) -> float:
        turned = self._per_angle * position + self.phase
        return self.amplitude * sin(turned + sin(turned) / 3)


@effect("gravity_spring")
class SimulatedGravitySpring(JointEffect):
    """A counterbalance between a pivot `anchor` [m] and a pivot `lever` [m] from the joint's axis.

    It pulls with `preload` [N] where the pivots are nearest, at the joint angle `angle`, and `rate` [N/m] more beyond:
    τ = −F a b sin(q − angle) / l with l² = a² + b² − 2 a b cos(q − angle).
    """

    usual = staticmethod(
        lambda d: {
            "preload": 0.6 * d.size * d.nominal,
            "rate": d.uniform(0, 1) * d.size * d.nominal,
            "angle": d.uniform(-1, 1),
        }
    )
    POSITIVE = ("anchor", "lever")
    preload: Annotated[float, "N"]
    rate: Annotated[float, "N/m"] = 0.0
    anchor: Annotated[float, "m"] = 0.4
    lever: Annotated[float, "m"] = 0.15
    angle: Annotated[float, "rad"] = 0.0

    def install_on(self, machine: Machine, k: int) -> None:
        self.need(self.anchor != self.lever, "lever", "unlike the anchor: the pivots would meet")
        machine.joint_loads[k].append(self)

    def torque(self, position: float, velocity: float, dt: float) -> float:
        a, b, angle = self.anchor, self.lever, position - self.angle
        length = sqrt(a * a + b * b - 2.0 * a * b * cos(angle))
        force = self.preload + self.rate * (length - abs(a - b))
        return -force * a * b * sin(angle) / length


@effect("dress_pack")
class SimulatedDressPack(JointEffect):
    """A hose between two clamps: `stiffness` [N·m/rad] and `cubic` [N·m/rad³] of the chord 2 sin(bend / 2), the bend
    counted from `centre` [rad].

    Its inner friction lags behind by up to `hysteresis` [N·m]; its strands slip one after the other within `travel`
    [rad] of a reversal (Iwan).
    """

    usual = staticmethod(
        lambda d: {
            "stiffness": 0.05 * d.size * d.nominal,
            "centre": d.uniform(-1, 1),
            "hysteresis": 0.02 * d.size * d.nominal,
        }
    )
    POSITIVE = ("travel",)
    stiffness: Annotated[float, "N·m/rad"]
    centre: Annotated[float, "rad"] = 0.0
    cubic: Annotated[float, "N·m/rad³"] = 0.0
    hysteresis: Annotated[float, "N·m"] = 0.0
    travel: Annotated[float, "rad"] = 0.05

    def install_on(self, machine: Machine, k: int) -> None:
        self._limits = [self.travel * share for share in (0.25, 0.6, 1.0)]
        self._stretch = [0.0, 0.0, 0.0]
        machine.joint_loads[k].append(self)

    def torque(self, position: float, velocity: float, dt: float) -> float:
        bend = 2.0 * sin(0.5 * (position - self.centre))
        lag = 0.0
        for i, limit in enumerate(self._limits):
            self._stretch[i] = min(max(self._stretch[i] + velocity * dt, -limit), limit)
            lag += self._stretch[i] / limit / 3.0
        return -(self.stiffness * bend + self.cubic * bend**3 + self.hysteresis * lag)


@effect("contact")
class ContactForce(ArmEffect):
    """Somebody leans on the flange: `force` (3,) [N] in the base frame, from `start` [s] on for `duration` [s].

    Time runs from when the arm was put to rest. The force swells and fades as sin² over a fifth of the duration.
    """

    usual = staticmethod(
        lambda d: {
            "force": (way := d.rng.normal(size=3)) / np.linalg.norm(way) * 120 * d.size,
            "start": d.uniform(5, 50),
            "duration": d.uniform(0.5, 3),
        }
    )
    POSITIVE = ("duration",)
    force: Annotated[tuple[float, ...], "N"]
    start: Annotated[float, "s"]
    duration: Annotated[float, "s"]

    def build_into(self, machine: Machine) -> None:
        self.need(len(self.force) == 3, "force", "three numbers")
        machine.contacts.append(self.at)

    def at(self, time: float) -> np.ndarray:
        """(3,) [N]."""
        since, ramp = time - self.start, 0.2 * self.duration
        edge = min(since, self.duration - since) / ramp
        share = 0.0 if edge <= 0 else sin(0.5 * pi * min(edge, 1.0)) ** 2
        return share * np.array(self.force)
