"""Forward simulation of a servo-controlled arm: set-points in, motion and motor torque out.

    (M(q) + Cᵀ I C) q̈ + h(q, q̇) = Cᵀ f + τ_external

with the coupling C, the inertia I of the rotors, and f the motor torque of the servo less friction. All that acts
between motors and joints is on the axles (see `agent.robot.drivetrain`): an axle's position is its motor's angle over
the gear ratio, a torque on it is the motor's times the gear ratio. Leapfrog with a predicted velocity: positions live
at t, velocities at t − dt/2, forces see v̂ = v + dt/2 · (last acceleration). Second order, one evaluation of the
dynamics a step, compiled; memoryless friction is linearly implicit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent.compiled import integrate
from agent.robot import Dynamics

#: (time [s], q (n,), q̇ (n,)) → joint torque (n,) [N·m] from outside, asked once a sample.
ExternalTorque = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


class RigidActuation:
    """Stiff gears and friction f0 tanh(v / transition) + f1 v + f2 |v| v on every axle; it runs compiled.

    Arrays (n,): `coulomb` f0 [N·m], `viscous` f1 [N·m·s/rad], `quadratic` f2 [N·m·s²/rad²], `transition` [rad/s], all
    taken at the velocity after the step, so that stiff friction stays stable at standstill. `bristles` (6, n) add
    friction with a memory, see `agent.compiled.integrate`.
    """

    def __init__(
        self,
        coulomb: np.ndarray | float,
        viscous: np.ndarray | float,
        quadratic: np.ndarray | float,
        transition: np.ndarray | float,
        bristles: np.ndarray | None = None,
    ):
        terms = np.broadcast_arrays(coulomb, viscous, quadratic, np.maximum(transition, 1e-9))
        memoryless = np.array(terms, dtype=float)
        self.friction = np.vstack([memoryless, np.zeros((6, memoryless.shape[1])) if bristles is None else bristles])


@dataclass(frozen=True, eq=False)
class ServoGains:
    """Gains of the cascaded position and velocity servo of an industrial drive, on n axles, arrays (n,).

    u = kv (kff ṙ + kp (r − θ) − θ̇) + ki ∫(…) dt, clamped; the integral holds while clamped.

    `position` [1/s]; `velocity` [N·m·s/rad] and `integral` [N·m/rad] of the PI velocity loop; `feedforward`, the
    fraction of the reference velocity that is fed forward; `limit` [N·m], the largest torque of the drive.
    """

    position: np.ndarray
    velocity: np.ndarray
    integral: np.ndarray
    feedforward: np.ndarray
    limit: np.ndarray

    @classmethod
    def tuned(cls, inertia: np.ndarray, limit: np.ndarray) -> ServoGains:
        """Common gains for axles of total `inertia` (n,) [kg·m²] and torque `limit` (n,) [N·m].

        Position loop of 30/s, velocity loop of 190 rad/s that resets at 30/s, 95 % of the velocity fed forward.
        """
        ones, gain = np.ones(len(inertia)), 190.0 * inertia
        return cls(30.0 * ones, gain, 30.0 * gain, 0.95 * ones, limit)


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """Simulated motion at the times of the set-points. S samples, n joints.

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
    the last two. `external` acts on the joints: a function, or (S, n) [N·m] of the samples from the beginning on.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        rotor_inertias: np.ndarray,
        actuation: RigidActuation,
        gains: ServoGains,
        period: float = 0.002,
        inner_rate: float = 2000.0,
        external: ExternalTorque | np.ndarray | None = None,
    ):
        robot = dynamics.robot
        self.period = period
        self.time = 0.0
        self._dynamics = dynamics
        self._actuation = actuation
        self._gains = gains
        self._external = external
        self._coupling = np.array(robot.coupling, dtype=float)
        self._rotors = robot.gear_ratios**2 * np.asarray(rotor_inertias, dtype=float)
        self._substeps = max(1, int(np.ceil(period * inner_rate - 1e-9)))
        self.rest(np.zeros(robot.dof))

    @property
    def position(self) -> np.ndarray:
        """(n,) joint positions now, load side."""
        return self._state[0].copy()

    @property
    def velocity(self) -> np.ndarray:
        """(n,) joint velocities now, load side."""
        dt = self.period / self._substeps
        return self._state[1] + 0.5 * dt * self._state[2]

    @property
    def motor_position(self) -> np.ndarray:
        """(n,) positions of the motors now, on the axles."""
        return np.asarray(self._coupling @ self.position)

    def rest(self, q: np.ndarray) -> None:
        """Put the stationary arm at q (n,), holding itself; transients of friction and gears remain."""
        # As compiled: position, velocity, acceleration of the joints; integral of the servos, torque of the bristles.
        self._state = np.zeros((5, len(q)))
        self._state[0] = q
        still = np.zeros((1, len(q)))
        load = self._dynamics.inverse_dynamics(self._state[:1], still, still)[0]
        if self._external is not None:
            load = load - self._outside(0, 1)[0]
        self._state[3] = np.linalg.solve(self._coupling.T, load)
        self._set_point = (self._coupling @ self.position, np.zeros(len(q)))

    def run(self, reference: np.ndarray, reference_velocity: np.ndarray) -> SimulatedMotion:
        """Follow joint set-points (S, n) and their velocities, one per period."""
        references = self._inner_references(reference, reference_velocity)
        states = self._integrate(references)
        time = self.time + self.period * np.arange(len(states))
        self.time += self.period * len(states)
        q, v, motor_position, motor_velocity, motor_torque = (states[:, row].copy() for row in range(5))
        return SimulatedMotion(time, q, v, motor_position, motor_velocity, motor_torque, motor_torque @ self._coupling)

    def _integrate(self, references: np.ndarray) -> np.ndarray:
        """(S, 5, n) what `agent.compiled.integrate` finds: at once, or from sample to sample where something acts."""
        gains, steps = self._gains, self._substeps
        servo = np.array([gains.position, gains.velocity, gains.integral, gains.feedforward, gains.limit], dtype=float)
        arm = *self._dynamics.chain, self._coupling, self._rotors, servo, self._actuation.friction
        states = np.empty((len(references) // steps, *self._state.shape))
        together = 1 if callable(self._external) else max(len(states), 1)
        for k in range(0, len(states), together):
            part, outside = references[k * steps : (k + together) * steps], self._outside(k, together)
            integrate(*arm, part, outside, steps, self.period / steps, self._state, states[k : k + together])
        return states

    def _outside(self, first: int, count: int) -> np.ndarray:
        """(count, n) torque from outside during samples, of which the `first` is counted from now on."""
        if self._external is None:
            return np.zeros((count, len(self._rotors)))
        if callable(self._external):
            return self._external(self.time + first * self.period, self.position, self.velocity)[None]
        now = round(self.time / self.period) + first
        return np.ascontiguousarray(self._external[now : now + count])

    def _inner_references(self, reference: np.ndarray, reference_velocity: np.ndarray) -> np.ndarray:
        """(S · substeps, 2, n) position and velocity of the axles: cubic Hermite from the last set-point given."""
        position = np.vstack([self._set_point[0], np.asarray(reference, dtype=float) @ self._coupling.T])
        velocity = np.vstack([self._set_point[1], np.asarray(reference_velocity, dtype=float) @ self._coupling.T])
        self._set_point = (position[-1], velocity[-1])
        h = self.period
        s = (np.arange(self._substeps) / self._substeps)[None, :, None]
        p0, p1 = position[:-1, None], position[1:, None]
        v0, v1 = velocity[:-1, None], velocity[1:, None]
        fine = p0 + s * (h * v0 + s * (3 * (p1 - p0) - h * (2 * v0 + v1) + s * (2 * (p0 - p1) + h * (v0 + v1))))
        fine_velocity = v0 + s * (6 * (p1 - p0) / h - 4 * v0 - 2 * v1 + 3 * s * (2 * (p0 - p1) / h + v0 + v1))
        return np.stack([fine, fine_velocity], axis=2).reshape(-1, 2, position.shape[1])
