"""PDL2 as a dialect (`agent.motion.dialect`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.motion.pdl2.reader import Program, parse_program
from agent.motion.pdl2.reduced_job import job_text
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.pdl2.variables import FRAMES
from agent.motion.pdl2.writer import write_loop_program, write_program
from agent.motion.program import LoopProgram, Statement

if TYPE_CHECKING:
    from agent.robot import RobotDescription


class Pdl2:
    """The language of COMAU's C4G and C5G controllers."""

    name = "pdl2"
    suffix = ".pdl"
    comment = "--"
    interpolators = ("fly", "orl")
    fly_keys = frozenset({"type", "trajectory", "distance", "percent", "stress"})
    frame_names: Mapping[str, str] = FRAMES

    def read(self, text: str, path: str = "", robot: RobotDescription | None = None) -> Program:
        """A program of the motion subset."""
        return parse_program(text, path, robot)

    def write(self, name: str, statements: Sequence[Statement], robot: RobotDescription | None = None) -> str:
        """A HOLD program that makes these moves and delays once."""
        return write_program(name, statements, robot)

    def write_loop(self, name: str, loop: LoopProgram, robot: RobotDescription | None = None) -> str:
        """A HOLD program: MOVE JOINT to the start, then LINEAR round the points, as often as it is run."""
        return write_loop_program(name, loop, robot)

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

    def job(
        self, text: str, path: str = "", robot: RobotDescription | None = None, companion: str = ""
    ) -> tuple[str, dict[str, int]]:
        """The lines of a person's program that move the arm; `companion` is the text of its variable file."""
        return job_text(text, path, robot, companion)

    def companion(self, program: Path) -> Path | None:
        """The listing of the program's variables in the same folder, if there is one."""
        candidates = (program.with_suffix(suffix) for suffix in (".lsv", ".LSV"))
        return next((file for file in candidates if file.is_file()), None)

    def messages(self, text: str) -> dict[str, str]:
        """None: a program is loaded as it is."""
        return {}
