"""The robot arm behind the fake controller: drives, rigid bodies and sensors of one individual machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.robot import RobotDescription
from agent.simulation import ForwardSimulation, ServoGains, SimulatedMotion
from fake_controller.actuation.drive import Drive
from fake_controller.actuation.machine import ENCODER_COUNTS, Machine, draw_machine

TORQUE_NOISE = 0.005  # of nominal, standard deviation, white
CURRENT_COUNTS = 2**12  # over twice the drive's limit
_SETTLING = 0.5  # s


@dataclass(frozen=True, eq=False)
class Measured:
    """K samples of what the controller measures, (K, n) each: joint positions, velocities, torques."""

    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True, eq=False)
class Truth:
    """What only tests may ask for.

    `parameters` (10 n,) standard inertial, `rotor_inertias` (n,) [kg·m², motor side], and `predict`: q, q̇, q̈ (S, n)
    to the torque (S, n) that the controller would measure in steady sliding, without noise.
    """

    parameters: np.ndarray
    rotor_inertias: np.ndarray
    predict: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Plant:
    """A machine drawn from `seed`, with `effects` built into it, following set-points.

    Args:
        robot: its type.
        seed: of the individual and of its measurement noise; the same seed gives the same samples.
        effects: plain mappings as `fake_controller.actuation` loads them.
        period: of set-points and samples [s].
        inner_rate: of servo and integration [Hz].

    Raises:
        InputError: an effect that does not exist, or does not fit this robot.
    """

    def __init__(
        self,
        robot: RobotDescription,
        seed: int = 0,
        effects: Sequence[Mapping[str, Any]] = (),
        period: float = 0.002,
        inner_rate: float = 2000.0,
    ):
        from fake_controller.actuation import load_effect

        self.robot = robot
        self.machine = draw_machine(robot, seed)
        for effect in effects:
            load_effect(effect).install(self.machine)
        machine = self.machine
        dynamics = machine.dynamics()
        self._simulation = ForwardSimulation(
            dynamics,
            machine.rotor_inertias,
            Drive(machine),
            ServoGains.tuned(machine.typical_inertia, machine.limit),
            period,
            2.0 * inner_rate if machine.gears else inner_rate,
            _external(machine, dynamics) if machine.contacts else None,
        )
        self._period = period
        self._rng = np.random.default_rng([seed, 3])
        self._to_joints = np.linalg.inv(machine.coupling).T
        self._count = 2.0 * np.pi / (ENCODER_COUNTS * np.abs(robot.gear_ratios))
        self._torque_count = 2.0 * machine.limit / CURRENT_COUNTS
        self.rest(np.zeros(robot.dof))

    @property
    def position(self) -> np.ndarray:
        """(n,) where the controller believes the arm to be, without quantisation."""
        return self._simulation.position + self.machine.encoder_offset

    def rest(self, q: np.ndarray) -> None:
        """Put the arm at the set-point q (n,), at rest and settled."""
        reference = np.asarray(q, dtype=float)
        self._simulation.rest(reference - self.machine.encoder_offset)
        self._history = np.zeros((0, self.robot.dof))
        self._last_position: np.ndarray | None = None
        for _ in self.hold(reference, _SETTLING):
            pass
        self._reference = reference

    def hold(self, q: np.ndarray, duration: float) -> Iterator[Measured]:
        """Samples while the set-point stays at q (n,) for `duration` [s]."""
        reference = np.repeat(np.asarray(q, dtype=float)[None], max(1, round(duration / self._period)), axis=0)
        return self.run(reference, np.zeros_like(reference))

    def settled(self, tolerance: np.ndarray | float) -> bool:
        """Whether every joint is within `tolerance` [rad] of the last set-point and nearly at rest."""
        error = np.abs(self.position - self._reference)
        return bool(np.all(error < tolerance) and np.all(np.abs(self._simulation.velocity) * 0.1 < tolerance))

    def run(
        self, reference: np.ndarray, reference_velocity: np.ndarray, period: float | None = None, chunk: int = 250
    ) -> Iterator[Measured]:
        """Follow set-points (S, n) and (S, n), one a period; yields what was measured at their moments.

        The state persists: the next call goes on where the caller stopped iterating.

        Raises:
            ValueError: a `period` that is not the plant's.
        """
        if period is not None and abs(period - self._period) > 1e-9:
            raise ValueError(f"this plant runs at {self._period} s, not {period} s")
        return self._chunks(np.asarray(reference, float), np.asarray(reference_velocity, float), chunk)

    def executed_path(self, position: np.ndarray, velocity: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
        """The set-points that this machine's interpolator makes of planned ones (S, n); their number may change."""
        for change in self.machine.path_changes:
            position, velocity = change(position, velocity, period)
        return position, velocity

    def truth(self) -> Truth:
        """The plant's own true parameters. For tests: nothing that estimates may ask."""
        machine = self.machine
        dynamics = machine.dynamics()

        def predict(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
            links = dynamics.inverse_dynamics(q - machine.encoder_offset, qd, qdd)
            axles = links @ self._to_joints.T + machine.reflected_rotors * (qdd @ machine.coupling.T)
            speed = qd @ machine.coupling.T
            friction = [curve.steady(speed[:, k]) for k, curve in enumerate(machine.friction)]
            measured = (axles + np.stack(friction, axis=1)) * machine.torque_scale + machine.torque_offset
            return measured @ self.robot.coupling

        return Truth(machine.parameters.copy(), machine.rotor_inertias.copy(), predict)

    def _chunks(self, reference: np.ndarray, reference_velocity: np.ndarray, chunk: int) -> Iterator[Measured]:
        for at in range(0, len(reference), chunk):
            part = slice(at, at + chunk)
            motion = self._simulation.run(reference[part] - self.machine.encoder_offset, reference_velocity[part])
            self._reference = reference[part][-1]
            yield self._measure(motion)

    def _measure(self, motion: SimulatedMotion) -> Measured:
        """Encoders count, currents are quantised and noisy; velocity is what the counts differ by from the last."""
        machine = self.machine
        counted = np.round(motion.motor_position / self._count) * self._count
        position = counted @ self._to_joints + machine.encoder_offset
        before = position[:1] if self._last_position is None else self._last_position[None]
        velocity = np.diff(np.vstack([before, position]), axis=0) / self._period
        self._last_position = position[-1]

        current = self._delayed(motion.motor_torque)
        current = current + TORQUE_NOISE * machine.nominal * self._rng.standard_normal(current.shape)
        current = np.round(current / self._torque_count) * self._torque_count
        torque = (current * machine.torque_scale + machine.torque_offset) @ self.robot.coupling
        return Measured(position, velocity, torque)

    def _delayed(self, torque: np.ndarray) -> np.ndarray:
        """The torque `torque_delay` ago, between samples by linear interpolation."""
        samples = self.machine.torque_delay / self._period
        if samples == 0:
            return torque
        whole = int(np.ceil(samples))
        if not len(self._history):
            self._history = np.repeat(torque[:1], whole, axis=0)
        series = np.vstack([self._history, torque])
        self._history = series[-whole:]
        at = np.arange(len(torque)) + whole - samples
        low = at.astype(int)
        share = (at - low)[:, None]
        return (1.0 - share) * series[low] + share * series[np.minimum(low + 1, len(series) - 1)]


def _external(machine: Machine, dynamics: Any) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
    """Joint torque of all contacts."""

    def torque(time: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        jacobian = dynamics.tcp_jacobian(q[None])[0]
        return sum((jacobian.T @ contact(time, q, qd, jacobian) for contact in machine.contacts), np.zeros(len(q)))

    return torque
