"""Forward simulation of a servo-controlled arm: set-points in, motion and motor torque out.

    (M(q) + Cᵀ I C) q̈ + h(q, q̇) = Cᵀ f + τ_external

with the coupling C, the inertia I of the rotors that turn with their axles, and f from the actuation, which the servo
drives. Leapfrog with a predicted velocity: positions live at t, velocities at t − dt/2, forces see
v̂ = v + dt/2 · (last acceleration). Second order, one evaluation of the dynamics a step; the damping that the actuation
declares is taken linearly implicitly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.robot import Dynamics
from agent.simulation.actuation import Actuation
from agent.simulation.servo import CascadedServo, ServoGains

#: (time [s], q (n,), q̇ (n,)) → joint torque (n,) [N·m] from outside, asked once a sample.
ExternalTorque = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """What happened at the moments of the set-points. S samples, n joints.

    time (S,) [s]; position, velocity (S, n) of the joints, load side; motor_position, motor_velocity (S, n) of the
    motors and motor_torque (S, n) on the axles; torque (S, n) is the motors' torque seen at the joints.
    """

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    motor_position: np.ndarray
    motor_velocity: np.ndarray
    motor_torque: np.ndarray
    torque: np.ndarray


class ForwardSimulation:
    """A servo-controlled arm whose state persists between calls.

    `rotor_inertias` (n,) [kg·m², motor side]; `period` [s] of set-points and samples, each divided into as many steps
    as `inner_rate` [Hz] needs. A set-point is reached one period after it is given: the drive interpolates between
    the last two.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        rotor_inertias: np.ndarray,
        actuation: Actuation,
        gains: ServoGains,
        period: float = 0.002,
        inner_rate: float = 2000.0,
        external: ExternalTorque | None = None,
    ):
        robot = dynamics.robot
        self.period = period
        self.time = 0.0
        self._dynamics = dynamics
        self._actuation = actuation
        self._servo = CascadedServo(gains)
        self._inertia_feedforward = np.asarray(gains.inertia, dtype=float)
        self._external = external
        self._coupling = robot.coupling
        self._coupled = bool(np.any(robot.coupling - np.eye(robot.dof)))
        reflected = robot.gear_ratios**2 * np.asarray(rotor_inertias, dtype=float)
        self._accelerate = dynamics.acceleration_function(np.where(actuation.rigid, reflected, 0.0))
        self._substeps = max(1, int(np.ceil(period * inner_rate - 1e-9)))
        self.rest(np.zeros(robot.dof))

    @property
    def position(self) -> np.ndarray:
        """(n,) joint positions now, load side."""
        return self._q.copy()

    @property
    def velocity(self) -> np.ndarray:
        """(n,) joint velocities now, load side."""
        dt = self.period / self._substeps
        return self._v + 0.5 * dt * self._a

    @property
    def motor_position(self) -> np.ndarray:
        """(n,) positions of the motors now, on the axles."""
        axle, speed = self._coupling @ self._q, self._coupling @ self.velocity
        return np.array(self._actuation.motors(axle.tolist(), speed.tolist())[0])

    def rest(self, q: np.ndarray) -> None:
        """Put the arm at q (n,), at rest, holding itself; transients of friction and gears are not waited for."""
        self._q = np.array(q, dtype=float)
        self._v = np.zeros(len(self._q))
        self._a = np.zeros(len(self._q))
        still = np.zeros((1, len(self._q)))
        load = self._dynamics.inverse_dynamics(self._q[None], still, still)[0]
        if self._external is not None:
            load = load - self._external(self.time, self._q, still[0])
        torque = np.linalg.solve(self._coupling.T, load).tolist()
        axle = self._coupling @ self._q
        self._servo.reset(torque)
        self._actuation.reset(axle.tolist(), torque)
        self._set_point = (axle, np.zeros(len(axle)))

    def run(
        self, reference: np.ndarray, reference_velocity: np.ndarray, feedforward: np.ndarray | None = None
    ) -> SimulatedMotion:
        """Follow joint set-points (S, n), one a period; `feedforward` (S, n) [N·m] is added to the torque command."""
        positions, velocities, torques = self._inner_references(reference, reference_velocity, feedforward)
        rows = self._march(len(reference), positions, velocities, torques)
        q, v, motor_position, motor_velocity, motor_torque = (np.array(row) for row in zip(*rows, strict=True))
        start = self.time - self.period * len(reference)
        time = start + self.period * np.arange(len(reference))
        return SimulatedMotion(time, q, v, motor_position, motor_velocity, motor_torque, motor_torque @ self._coupling)

    def _march(
        self, samples: int, positions: list[list[float]], velocities: list[list[float]], torques: list[list[float]]
    ) -> list[tuple[Any, ...]]:
        substeps, coupled, coupling, external = self._substeps, self._coupled, self._coupling, self._external
        motors, actuate, servo, accelerate = (
            self._actuation.motors,
            self._actuation.step,
            self._servo.step,
            self._accelerate,
        )
        actuation = self._actuation
        implicit = actuation.damping is not None
        dt = self.period / substeps
        q, v, a, time = self._q, self._v, self._a, self.time
        whole, half = np.full((2, len(q)), dt) * [[1.0], [0.5]]  # small arrays times a number are slower
        outside = None
        added = None
        rows = []
        step = 0
        for _ in range(samples):
            for inner in range(substeps):
                predicted = v + half * a
                if coupled:
                    axle, speed = (coupling @ q).tolist(), (coupling @ predicted).tolist()
                else:
                    axle, speed = q.tolist(), predicted.tolist()
                motor, motor_speed = motors(axle, speed)
                command = servo(positions[step], velocities[step], torques[step], motor, motor_speed, dt)
                if inner == 0:
                    rows.append((q.copy(), predicted, motor, motor_speed, command))
                    if external is not None:
                        outside = external(time, q, predicted)
                load = np.array(actuate(time, axle, speed, command, dt))
                if implicit:
                    damping = np.array(actuation.damping)
                    added = damping * dt
                    load -= damping * (coupling @ v)
                torque = load @ coupling if coupled else load
                if outside is not None:
                    torque = torque + outside
                a = accelerate(q, predicted, torque, added)
                v += whole * a
                q += whole * v
                time += dt
                step += 1
        self._a, self.time = a, time
        return rows

    def _inner_references(
        self, reference: np.ndarray, reference_velocity: np.ndarray, feedforward: np.ndarray | None
    ) -> tuple[list[list[float]], list[list[float]], list[list[float]]]:
        """Cubic Hermite interpolation of the axles' set-points at the inner rate, from the last one given."""
        position = np.vstack([self._set_point[0], np.asarray(reference, dtype=float) @ self._coupling.T])
        velocity = np.vstack([self._set_point[1], np.asarray(reference_velocity, dtype=float) @ self._coupling.T])
        self._set_point = (position[-1], velocity[-1])
        h = self.period
        s = (np.arange(self._substeps) / self._substeps)[None, :, None]
        p0, p1 = position[:-1, None], position[1:, None]
        v0, v1 = velocity[:-1, None], velocity[1:, None]
        fine = p0 + s * (h * v0 + s * (3 * (p1 - p0) - h * (2 * v0 + v1) + s * (2 * (p0 - p1) + h * (v0 + v1))))
        fine_velocity = v0 + s * (6 * (p1 - p0) / h - 4 * v0 - 2 * v1 + 3 * s * (2 * (p0 - p1) / h + v0 + v1))
        torque = self._inertia_feedforward * np.repeat((v1 - v0) / h, self._substeps, axis=1)
        if feedforward is not None:
            torque = torque + np.asarray(feedforward, dtype=float)[:, None]
        rows = -1, position.shape[1]
        return fine.reshape(rows).tolist(), fine_velocity.reshape(rows).tolist(), torque.reshape(rows).tolist()
