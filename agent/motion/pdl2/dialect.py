"""PDL2 as a dialect (`agent.motion.dialect`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from agent.motion.pdl2.reader import parse_program
from agent.motion.pdl2.reduced_job import job_text, listing_beside
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.pdl2.variables import FRAMES
from agent.motion.pdl2.writer import write_loop_program, write_program

if TYPE_CHECKING:
    from agent.robot import RobotDescription


class Pdl2:
    """The language of COMAU's C4G and C5G controllers."""

    name = "pdl2"
    suffix = ".pdl"
    comment = "--"
    interpolators = ("fly", "orl")
    fly_keys = frozenset({"type", "trajectory", "distance", "percent", "stress"})
    frame_names = FRAMES
    write = staticmethod(write_program)
    write_loop = staticmethod(write_loop_program)
    read = staticmethod(parse_program)
    job = staticmethod(job_text)
    companion = staticmethod(listing_beside)

    def settings(self, fly: Mapping[str, Any], speed: float, robot: RobotDescription) -> Pdl2Settings:
        """The system variables of the FLY statement; the tool turns no faster than the robot's limit."""
        settings = Pdl2Settings(
            fly_type=fly["type"],
            fly_trajectory=fly["trajectory"],
            fly_distance=fly["distance"],
            fly_percent=100.0 * fly["percent"],
            stress_percent=100.0 * fly["stress"],
            linear_speed=speed,
        )
        limits = robot.cartesian_limits
        return settings if limits is None else settings.changed(rotational_speed=limits.rotational_speed)
