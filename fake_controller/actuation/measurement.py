"""Effects of sensors and of the interpolator: reported values differ from the true ones."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy.interpolate import CubicSpline

from fake_controller.actuation.effect import ArmEffect, JointEffect, effect
from fake_controller.actuation.machine import Machine


@effect("torque_constant")
class SimulatedTorqueConstant(JointEffect):
    """The motor gives 1 / `scale` of the torque that its current is taken for, so it draws and reports more.

    Magnets that have lost flux lose more of it under a high current: the error is what `scale` says at small torques, a
    sixth more at the nominal one and at most a third more.
    """

    usual = staticmethod(lambda d: {"scale": 1 + d.sign * 0.1 * d.size})
    POSITIVE = ("scale",)
    scale: float

    def install_on(self, machine: Machine, k: int) -> None:
        machine.torque_scale[k] *= self.scale


@effect("torque_offset")
class SimulatedTorqueOffset(JointEffect):
    """The current sensor reads too much by `offset` [N·m on the joint side], which its temperature swings by 5 %."""

    usual = staticmethod(lambda d: {"offset": d.sign * 0.06 * d.size * d.nominal})
    offset: Annotated[float, "N·m"]

    def install_on(self, machine: Machine, k: int) -> None:
        machine.torque_offset[k] += self.offset


@effect("time_delay")
class SimulatedTimeDelay(ArmEffect):
    """Torques arrive `delay` [s] later than the positions of the same moment; below zero, positions do.

    Half of it is the way over the bus, the other half two filters of the drive, which also round corners.
    """

    usual = staticmethod(lambda d: {"delay": 0.006 * d.size})
    delay: Annotated[float, "s"]

    def build_into(self, machine: Machine) -> None:
        machine.torque_delay += self.delay


@effect("encoder_offset")
class SimulatedEncoderOffset(JointEffect):
    """The joint reads `offset` [rad] more than it stands at, to controller and user alike."""

    usual = staticmethod(lambda d: {"offset": d.sign * 0.02 * d.size})
    offset: Annotated[float, "rad"]

    def install_on(self, machine: Machine, k: int) -> None:
        machine.encoder_offset[k] += self.offset


@effect("interpolator_mismatch")
class SimulatedInterpolatorMismatch(ArmEffect):
    """The path is run at `rate` times the planned speed, and its corners are averaged over `blend` [s].

    Start, end and rests of at least `blend` stay where they were.
    """

    usual = staticmethod(lambda d: {"rate": 1 + d.sign * 0.02 * d.size, "blend": d.uniform(0, 0.08) * d.size})
    POSITIVE = ("rate",)
    rate: float = 1.0
    blend: Annotated[float, "s"] = 0.0

    def build_into(self, machine: Machine) -> None:
        self.need(self.blend >= 0, "blend", "0 or more")
        machine.path_changes.append(self.executed)

    def executed(self, position: np.ndarray, period: float) -> np.ndarray:
        """Set-points (T, n) that replace the planned ones (S, n)."""
        last = len(position) - 1
        samples = 1 + int(np.ceil(last / self.rate - 1e-9))
        path = position
        if self.rate != 1.0 and last > 0:
            at = np.minimum(self.rate * np.arange(samples), last)
            path = CubicSpline(np.arange(last + 1), position, bc_type="clamped")(at)
        width = 2 * round(0.5 * self.blend / period) + 1
        padded = np.pad(path, ((width - 1, width - 1), (0, 0)), mode="edge")
        sums = np.cumsum(np.vstack([np.zeros(path.shape[1]), padded]), axis=0)
        return (sums[width:] - sums[:-width]) / width
