"""The robot arm behind the fake controller: drives, rigid bodies and sensors of one individual machine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import InputError
from agent.robot import Dynamics, RobotDescription
from agent.simulators import ExternalTorque, ForwardSimulation, ServoGains
from fake_controller.actuation import load_effect
from fake_controller.actuation.drive import Drive, SteppedSimulation, rigid_actuation
from fake_controller.actuation.machine import Machine, check_bodies, draw_machine, poses
from fake_controller.actuation.sensors import Measured, Sensors

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from fake_controller.modelled import BeyondMachine

__all__ = ["Measured", "Plant"]

_SETTLING = 0.5  # s
_INNER_RATE, _HIGHEST_RATE = 2000.0, 20_000.0  # Hz, of servo and integration; gears that give way raise it


class Plant:
    """A machine drawn from `seed`, with `effects` built into it, following set-points.

    Args:
        robot: its type.
        seed: of the individual and of its measurement noise; the same seed gives the same samples.
        effects: plain mappings as `fake_controller.actuation.load_effect` takes them.
        period: of set-points and samples [s].
        model: the machine is what this model says, instead of one drawn from `seed`.

    Raises:
        InputError: bodies that cannot exist, or an effect that does not exist, does not fit this robot, or is too
            stiff to simulate.
    """

    def __init__(
        self,
        robot: RobotDescription,
        seed: int = 0,
        effects: Sequence[Mapping[str, Any]] = (),
        period: float = 0.002,
        model: IdentifiedModel | None = None,
    ):
        self.robot = robot
        self._beyond: BeyondMachine | None = None
        if model is None:
            self.machine = draw_machine(robot, seed)
        else:
            from fake_controller.modelled import BeyondMachine, modelled_machine  # estimation is not needed without

            self.machine = modelled_machine(model)
            self._beyond = BeyondMachine(model, self.machine)
        self._beyond_series, self._beyond_start = np.zeros((1, robot.dof)), 0.0
        for effect in effects:
            load_effect(effect).install(self.machine)
        check_bodies(self.machine)
        dynamics = self.machine.dynamics()
        gains = ServoGains.tuned(self.machine.typical_inertia, self.machine.limit)
        rate = max(_INNER_RATE, _rate_for_gears(self.machine, dynamics, gains))
        rotors, external = self.machine.rotor_inertias, self._external(dynamics, period)
        rigid = rigid_actuation(self.machine)
        self._simulation = (
            SteppedSimulation(dynamics, rotors, Drive(self.machine), gains, period, rate, external)
            if rigid is None
            else ForwardSimulation(dynamics, rotors, rigid, gains, period, rate, external)
        )
        self._sensors = Sensors(self.machine, seed, period)
        self._period = period
        self.rest(np.zeros(robot.dof))

    @property
    def position(self) -> np.ndarray:
        """(n,) where the controller believes the joints to be, without quantisation."""
        to_joints = np.linalg.inv(self.machine.coupling).T  # as this machine's controller knows its coupling
        return self._simulation.motor_position @ to_joints + self.machine.encoder_offset

    def rest(self, q: np.ndarray) -> None:
        """Put the arm at the set-point q (n,), stationary and settled; time starts again.

        `resting` is what was measured at the end of that.
        """
        reference = np.asarray(q, dtype=float)
        self._simulation.time = -_SETTLING
        self._simulation.rest(reference - self.machine.encoder_offset)
        self._sensors.restart()
        for measured in self.hold(reference, _SETTLING):
            self.resting = measured
        self._simulation.time = 0.0

    def hold(self, q: np.ndarray, duration: float) -> Iterator[Measured]:
        """Samples while the set-point stays at q (n,) for `duration` [s]."""
        reference = np.repeat(np.asarray(q, dtype=float)[None], max(1, round(duration / self._period)), axis=0)
        return self.run(reference, np.zeros_like(reference))

    def run(self, reference: np.ndarray, reference_velocity: np.ndarray, chunk: int = 250) -> Iterator[Measured]:
        """Follow set-points (S, n) and their velocities, one a period; yields what was measured at their moments.

        At most `chunk` samples are computed ahead of what the caller has taken; the next call goes on from there.
        """
        reference, reference_velocity = np.asarray(reference, float), np.asarray(reference_velocity, float)
        if self._beyond is not None and len(reference):
            self._beyond_start = self._simulation.time
            self._beyond_series = self._beyond.torque(self._beyond_start, reference, reference_velocity, self._period)
        for at in range(0, len(reference), chunk):
            part = slice(at, at + chunk)
            motion = self._simulation.run(reference[part] - self.machine.encoder_offset, reference_velocity[part])
            yield self._sensors.measure(motion)

    def executed_path(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The set-points that this machine's interpolator makes of planned ones (S, n), rest to rest.

        Nothing changes without an effect that changes it; with one their number may.
        """
        for change in self.machine.path_changes:
            position = change(position, self._period)
            velocity = np.gradient(position, self._period, axis=0)
        return position, velocity

    def _external(self, dynamics: Dynamics, period: float) -> ExternalTorque | None:
        """Joint torque of everything that sits on the joints or pushes the flange, and of what a model has beyond."""
        machine = self.machine
        if not machine.contacts and not machine.joint_loads and self._beyond is None:
            return None

        def torque(time: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
            series = self._beyond_series
            at = min(max(round((time - self._beyond_start) / period), 0), len(series) - 1)
            total = -series[at]
            force = sum((contact(time) for contact in machine.contacts), np.zeros(3))
            if np.any(force):
                total += dynamics.tcp_jacobian(q[None])[0, :3].T @ force
            for k, loads in machine.joint_loads.items():
                for load in loads:
                    total[k] += load.torque(q[k], qd[k], period)
            return total

        return torque


def _rate_for_gears(machine: Machine, dynamics: Dynamics, gains: ServoGains) -> float:
    """[Hz] at which every gear that gives way is integrated well: half a radian of its fastest swing a step.

    Raises:
        InputError: no reasonable rate would do.
    """
    rotors = machine.reflected_rotors
    rigid = np.array([rotor if k not in machine.gears else 0.0 for k, rotor in enumerate(rotors)])
    rate = 0.0
    for q in poses(machine.robot, 32):
        matrix = dynamics.mass_matrix(q) + machine.coupling.T @ np.diag(rigid) @ machine.coupling
        mobility = np.diag(machine.coupling @ np.linalg.solve(matrix, machine.coupling.T))
        for k, gear in machine.gears.items():
            swing = 1.0 / rotors[k] + mobility[k]
            rate = max(rate, 2.0 * np.sqrt(gear.stiffness * swing), 2.0 * gear.damping * swing)
            rate = max(rate, 2.5 * gains.velocity[k] / rotors[k])
            if rate > _HIGHEST_RATE:
                joint = machine.robot.joint_names[k]
                raise InputError(
                    f"effect on {joint}: its gear of {gear.stiffness:.3g} N·m/rad would need steps at {rate:.0f} Hz, "
                    f"the simulation's limit is {_HIGHEST_RATE:.0f} Hz: make it softer"
                )
    return float(rate)
