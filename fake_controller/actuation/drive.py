"""The drives of a machine in motion: friction, gears, and what else acts on axles."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp

import numpy as np

from agent.robot import Dynamics
from agent.simulators import ExternalTorque, ForwardSimulation, RigidActuation, ServoGains
from fake_controller.actuation.machine import Machine


def rigid_actuation(machine: Machine) -> RigidActuation | None:
    """Of a machine whose axles have friction and nothing else; None of any other."""
    if any(machine.terms.values()) or machine.gears or any(machine.motor_loads.values()):
        return None
    none = np.zeros(len(machine.friction))
    return RigidActuation(none, none, none, none, np.transpose([curve.numbers for curve in machine.friction]))


class Drive:
    """States of all axles of one machine, one Python step at a time: any effect may act on them.

    Plain floats in lists: for six joints they cost a fifth of what small arrays do. All in rad, rad/s, N·m
    (m, m/s, N on a prismatic joint), of the axles. `rigid` (n,): whether an axle turns with its motor, so that the
    rotor's inertia belongs to the joint's; where it is False, `step` integrates the rotor itself.
    """

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
        """(n,) torque on the load side while the motors give `torque` (n,); advances the states by `dt` [s]."""
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
                level, drag = self._alter(k, level, drag, shaft[k], speed, torque[k], dt)
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

    def _alter(
        self, k: int, level: float, drag: float, angle: float, speed: float, torque: float, dt: float
    ) -> tuple[float, float]:
        """Coulomb level and everything else that opposes the motion, with this axle's terms."""
        friction = self._bristles[k] + drag
        transmitted = torque - friction - self._rotors[k] * ((speed - self._last_speed[k]) / dt)
        self._last_speed[k] = speed
        floor, extra = 0.05 * level, 0.0
        for term in self._terms[k]:
            level = term.level(level, speed, transmitted, angle)
            drag = term.viscous(drag, speed)
            extra += term.bristles(speed, dt)
            term.heat(friction * speed, dt)
        # Friction can be low but never drives.
        return max(level, floor), drag + extra


class SteppedSimulation(ForwardSimulation):
    """An arm with a drive that is asked step by step, as anything may act on its axles."""

    def __init__(
        self,
        dynamics: Dynamics,
        rotor_inertias: np.ndarray,
        drive: Drive,
        gains: ServoGains,
        period: float = 0.002,
        inner_rate: float = 2000.0,
        external: ExternalTorque | None = None,
    ):
        self._drive, self._servo = drive, CascadedServo(gains)
        turning = np.where(drive.rigid, rotor_inertias, 0.0)
        none = np.zeros(len(turning))
        rigid = RigidActuation(none, none, none, none)
        super().__init__(dynamics, turning, rigid, gains, period, inner_rate, external)
        self._accelerate = dynamics.acceleration_function(self._rotors)

    @property
    def motor_position(self) -> np.ndarray:
        axle, speed = self._coupling @ self.position, self._coupling @ self.velocity
        return np.array(self._drive.motors(axle.tolist(), speed.tolist())[0])

    def rest(self, q: np.ndarray) -> None:
        super().rest(q)
        torque = self._state[3].tolist()
        self._servo.reset(torque)
        self._drive.reset(self._set_point[0].tolist(), torque)

    def _integrate(self, references: np.ndarray) -> np.ndarray:
        substeps, coupling, external = self._substeps, self._coupling, self._external
        motors, actuate, servo = self._drive.motors, self._drive.step, self._servo.step
        accelerate, coupled = self._accelerate, bool(np.any(coupling - np.eye(len(coupling))))
        assert not isinstance(external, np.ndarray)
        dt = self.period / substeps
        q, v, a = self._state[:3].copy()
        time = self.time
        whole, half = np.full((2, len(q)), dt) * [[1.0], [0.5]]  # small arrays times a number are slower
        outside = None
        rows = []
        for step, (position, velocity) in enumerate(references.tolist()):
            predicted = v + half * a
            if coupled:
                axle, speed = (coupling @ q).tolist(), (coupling @ predicted).tolist()
            else:
                axle, speed = q.tolist(), predicted.tolist()
            motor, motor_speed = motors(axle, speed)
            command = servo(position, velocity, motor, motor_speed, dt)
            if step % substeps == 0:
                rows.append((q.copy(), predicted, motor, motor_speed, command))
                if external is not None:
                    outside = external(time, q, predicted)
            load = np.array(actuate(time, axle, speed, command, dt))
            pull = load @ coupling if coupled else load
            if outside is not None:
                pull = pull + outside
            a = accelerate(q, predicted, pull)
            v += whole * a
            q += whole * v
            time += dt
        self._state[:3] = q, v, a
        return np.array(rows).reshape(-1, *self._state.shape)


class CascadedServo:
    """The servo of `ServoGains`, one step at a time."""

    def __init__(self, gains: ServoGains):
        columns = (gains.position, gains.velocity, gains.integral, gains.feedforward, gains.limit)
        self._axles = list(zip(*(np.asarray(column, dtype=float).tolist() for column in columns), strict=True))
        self._integral = [0.0] * len(self._axles)

    def reset(self, torque: Sequence[float]) -> None:
        """Start from rest, holding against the static `torque` (n,)."""
        self._integral = list(torque)

    def step(
        self,
        reference: Sequence[float],
        reference_velocity: Sequence[float],
        position: Sequence[float],
        velocity: Sequence[float],
        dt: float,
    ) -> list[float]:
        """(n,) motor torque, on the axles; all arguments (n,)."""
        integral = self._integral
        torque = []
        for k, (kp, kv, ki, kff, limit) in enumerate(self._axles):
            error = kff * reference_velocity[k] + kp * (reference[k] - position[k]) - velocity[k]
            command = kv * error + integral[k]
            if command > limit:
                command = limit
            elif command < -limit:
                command = -limit
            else:
                integral[k] += ki * error * dt
            torque.append(command)
        return torque
