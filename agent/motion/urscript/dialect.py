"""URScript as a dialect (`agent.motion.dialect`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.motion.urscript.reader import job_text, read_program
from agent.motion.urscript.settings import LINEAR_ACCELERATION, UrSettings
from agent.motion.urscript.writer import write_loop_program, write_program

if TYPE_CHECKING:
    from agent.robot import RobotDescription


class UrScript:
    """The language of Universal Robots' controllers, from CB3 on."""

    name = "urscript"
    suffix = ".script"
    comment = "#"
    interpolators = ("ur",)
    fly_keys = frozenset({"distance"})
    frame_names: Mapping[str, str] = {"tool": "TCP"}
    write = staticmethod(write_program)
    write_loop = staticmethod(write_loop_program)
    read = staticmethod(read_program)

    def settings(self, fly: Mapping[str, Any], speed: float, robot: RobotDescription) -> UrSettings:
        """Blend radius and speed of the recipe; the tool accelerates as `movel` does where nothing is said, or less.

        Joint moves take the speed of the slowest joint as their whole.
        """
        limits = robot.cartesian_limits
        most = np.inf if limits is None else limits.linear_acceleration
        return UrSettings(
            fly_distance=fly["distance"],
            linear_speed=speed,
            linear_acceleration=min(LINEAR_ACCELERATION, most),
            joint_speed=float(robot.max_velocity.min()),
        )

    def job(
        self, text: str, path: str = "", robot: RobotDescription | None = None, companion: str = ""
    ) -> tuple[str, dict[str, int]]:
        """What moves in a person's program, written anew; endless loops are gone through once."""
        statements, passed = job_text(text, path, robot)
        return write_program("job", statements, robot), passed

    def companion(self, program: Path) -> Path | None:
        """None: positions are in the program."""
        return None
