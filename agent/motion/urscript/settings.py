"""The settings of a move that Universal Robots' controllers have and others do not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from agent.motion.program import MotionSettings

if TYPE_CHECKING:
    from agent.robot import Tool

#: Of moves that do not say: `movel` [m/s, m/s²], `movej` [rad/s, rad/s²] (URScript manual).
LINEAR_SPEED, LINEAR_ACCELERATION, JOINT_SPEED, JOINT_ACCELERATION = 0.25, 1.2, 1.05, 1.4


@dataclass(frozen=True)
class UrSettings(MotionSettings):
    """What `movel` and `movej` are told; `fly_distance` is the blend radius `r`.

    Acceleration of the tool [m/s²], and speed [rad/s] and acceleration [rad/s²] of the joint that moves farthest.
    `load` is the mass [kg] that is mounted and its centre in the flange's frame [m]; None is not said.
    """

    linear_acceleration: float = LINEAR_ACCELERATION
    joint_speed: float = JOINT_SPEED
    joint_acceleration: float = JOINT_ACCELERATION
    load: tuple[float, ...] | None = None

    def carrying(self, tool: Tool | None) -> Self:
        """The same with the load of this tool."""
        if tool is None:
            return self.changed(load=(0.0, 0.0, 0.0, 0.0))
        centre = np.zeros(3) if tool.centre_of_mass is None else np.asarray(tool.centre_of_mass, dtype=float)
        at_flange = tool.frame[:3, :3] @ centre + tool.frame[:3, 3] if tool.mass > 0.0 else np.zeros(3)
        return self.changed(load=(float(tool.mass), *at_flange.tolist()))
