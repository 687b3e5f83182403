"""Sensors of the drives: counted angles, quantised and noisy currents, delayed channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.simulators import SimulatedMotion
from fake_controller.actuation.machine import Machine

TORQUE_NOISE = 0.005  # of nominal, standard deviation, white
ENCODER_COUNTS = 2**14  # per motor turn
CURRENT_COUNTS = 2**12  # from the drive's lowest to its highest torque

_SWING, _SWING_PERIOD = 0.05, 90.0  # of a torque offset; s


@dataclass(frozen=True, eq=False)
class Measured:
    """K samples of what the controller measures, (K, n) each: joint positions, velocities, torques."""

    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray


class Sensors:
    """Measurement of one machine, sample after sample at `period` [s], with noise from `seed`."""

    def __init__(self, machine: Machine, seed: int, period: float):
        self._machine = machine
        self._period = period
        self._rng = np.random.default_rng([seed, 3])
        self._axles_to_joints = np.linalg.inv(machine.coupling).T
        self._count = 2.0 * np.pi / (ENCODER_COUNTS * np.abs(machine.robot.gear_ratios))
        self._torque_count = 2.0 * machine.limit / CURRENT_COUNTS
        self.restart()

    def restart(self) -> None:
        """Forget what was before: the arm rests."""
        late = self._machine.torque_delay / self._period
        self._torque_line = _Late(max(late, 0.0))
        self._position_line = _Late(max(-late, 0.0))
        self._last_position: np.ndarray | None = None
        self._measured = 0

    def measure(self, motion: SimulatedMotion) -> Measured:
        """Velocity is by how much the counted position differs from the last sample's."""
        machine = self._machine
        counted = np.round(self._position_line.pass_on(motion.motor_position) / self._count) * self._count
        position = counted @ self._axles_to_joints + machine.encoder_offset
        before = position[:1] if self._last_position is None else self._last_position[None]
        velocity = np.diff(np.vstack([before, position]), axis=0) / self._period
        self._last_position = position[-1]
        current = self._torque_line.pass_on(motion.motor_torque)
        current = current + TORQUE_NOISE * machine.nominal * self._rng.standard_normal(current.shape)
        current = np.round(current / self._torque_count) * self._torque_count
        torque = (self._scaled(current) + self._offset(len(current))) @ machine.robot.coupling
        return Measured(position, velocity, torque)

    def _scaled(self, current: np.ndarray) -> np.ndarray:
        """(K, n) with the error of the torque constants, which grows with the torque."""
        share = (current / self._machine.nominal) ** 2
        return current * (1.0 + (self._machine.torque_scale - 1.0) * (1.0 + share / (3.0 * (1.0 + share))))

    def _offset(self, count: int) -> np.ndarray:
        """(K, n) as it swings with the temperature of the amplifier."""
        t = self._period * (self._measured + np.arange(count))
        self._measured += count
        return self._machine.torque_offset * (1.0 + _SWING * np.sin(2.0 * np.pi * t / _SWING_PERIOD))[:, None]


class _Late:
    """Samples (K, n) that are late by `delay` samples: half is a shift, the other half two first-order filters."""

    def __init__(self, delay: float):
        self._whole = int(np.ceil(0.5 * delay))
        self._share = self._whole - 0.5 * delay  # of the next sample, linear in between
        self._memory_share = 0.25 * delay / (1.0 + 0.25 * delay)
        self._line = self._memory = np.empty((0, 0))

    def pass_on(self, samples: np.ndarray) -> np.ndarray:
        if self._whole == 0:
            return samples
        first = not self._line.size
        series = np.vstack([np.repeat(samples[:1], self._whole, axis=0) if first else self._line, samples])
        self._line = series[-self._whole :]
        shifted = (1.0 - self._share) * series[: len(samples)] + self._share * series[1 : len(samples) + 1]
        if first:
            self._memory = np.tile(shifted[0], (2, 1))
        out = np.empty_like(shifted)
        for k, sample in enumerate(shifted):
            self._memory[0] += (1.0 - self._memory_share) * (sample - self._memory[0])
            self._memory[1] += (1.0 - self._memory_share) * (self._memory[0] - self._memory[1])
            out[k] = self._memory[1]
        return out
