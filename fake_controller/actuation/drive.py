"""The drives of a machine in motion: friction, gears, and what else acts on axles (`agent.simulators.Actuation`)."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp

import numpy as np

from agent.simulators import RigidActuation
from fake_controller.actuation.machine import Machine


def actuation(machine: Machine) -> Drive | RigidActuation:
    """Of a machine: compiled, where its axles have friction and nothing else."""
    if any(machine.terms.values()) or machine.gears or any(machine.motor_loads.values()):
        return Drive(machine)
    none = np.zeros(len(machine.friction))
    return RigidActuation(none, none, none, none, np.transpose([curve.numbers for curve in machine.friction]))


class Drive:
    """States of all axles of one machine, one Python step at a time: any effect may act on them."""

    def __init__(self, machine: Machine):
        self._curves = [curve.numbers for curve in machine.friction]
        n = len(self._curves)
        self._terms = [machine.terms.get(k, ()) for k in range(n)]
        self._gears = list(machine.gears.items())
        self._motor_loads = list(machine.motor_loads.items())
        self._rotors = machine.reflected_rotors.tolist()
        self.rigid = [k not in machine.gears for k in range(n)]
        self._bristles = [0.0] * n
        self._last_speed = [0.0] * n
        self._motor = {k: (0.0, 0.0, 0.0) for k in machine.gears}  # position, velocity half a step ago, acceleration
        self._dt = 0.0

    def reset(self, position: Sequence[float], torque: Sequence[float]) -> None:
        """At rest under the static torque, all bristles relaxed; what is warm stays warm."""
        self._bristles = [0.0] * len(self._bristles)
        self._last_speed = [0.0] * len(self._last_speed)
        for k, gear in self._gears:
            self._motor[k] = (position[k] + gear.twist(torque[k]), 0.0, 0.0)

    def motors(self, position: Sequence[float], velocity: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        """(n,) and (n,) of the motor shafts, over the gear ratio."""
        if self._gears:
            position, velocity = list(position), list(velocity)
            for k, _ in self._gears:
                angle, speed, acceleration = self._motor[k]
                position[k], velocity[k] = angle, speed + 0.5 * self._dt * acceleration
        return position, velocity

    def step(
        self, time: float, position: Sequence[float], velocity: Sequence[float], torque: Sequence[float], dt: float
    ) -> Sequence[float]:
        """(n,) torque on the load side of the gears; see the protocol."""
        self._dt = dt
        shaft, speeds = self.motors(position, velocity)
        if self._motor_loads:
            torque = list(torque)
            for k, sources in self._motor_loads:
                for source in sources:
                    torque[k] += source.torque(shaft[k], speeds[k], dt)
        bristles, terms = self._bristles, self._terms
        load = []
        for k, (coulomb, rise, per_speed, viscous, per_knee, stiffness) in enumerate(self._curves):
            speed = speeds[k]
            ratio = speed * per_speed
            ratio *= ratio
            level = coulomb + rise * exp(-ratio) if ratio < 20.0 else coulomb
            drag = viscous * speed / (1.0 + abs(speed) * per_knee)
            if terms[k]:
                level, drag = self._alter(k, level, drag, speed, torque[k], dt)
            # Implicit in the bristle, whose rate |v| k / g is far beyond the step's at full speed.
            stretch = stiffness * speed * dt
            bristles[k] = bristle = (bristles[k] + stretch) / (1.0 + abs(stretch) / level)
            load.append(torque[k] - bristle - drag)
        for k, gear in self._gears:
            angle, speed, _ = self._motor[k]
            transmitted = gear.torque(angle - position[k], speeds[k] - velocity[k])
            acceleration = (load[k] - transmitted) / self._rotors[k]
            speed += dt * acceleration
            self._motor[k] = (angle + dt * speed, speed, acceleration)
            load[k] = transmitted
        return load

    def _alter(self, k: int, level: float, drag: float, speed: float, torque: float, dt: float) -> tuple[float, float]:
        """Coulomb level and everything else that opposes the motion, with this axle's terms."""
        friction = self._bristles[k] + drag
        acceleration = (speed - self._last_speed[k]) / dt
        transmitted = torque - friction - self._rotors[k] * acceleration
        self._last_speed[k] = speed
        floor = 0.05 * level
        extra = 0.0
        for term in self._terms[k]:
            level = term.level(level, speed, transmitted)
            drag = term.viscous(drag, speed)
            extra += term.bristles(speed, dt)
            term.heat(friction * speed, dt)
        # Friction can be low but never drives.
        return max(level, floor), drag + extra
