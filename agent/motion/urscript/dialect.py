"""URScript as a dialect (`agent.motion.dialect`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.motion.program import LoopProgram, Statement
from agent.motion.urscript.reader import UrScriptProgram, job_text, read_program
from agent.motion.urscript.settings import LINEAR_ACCELERATION, UrSettings
from agent.motion.urscript.writer import ScriptWriter

if TYPE_CHECKING:
    from agent.robot import RobotDescription


#: A controller goes on from a stop in the next period; at this rest it shows where cycles begin.
_REST = "sleep(0.1)"


class UrScript:
    """The language of Universal Robots' controllers, from CB3 on."""

    name = "urscript"
    suffix = ".script"
    comment = "#"
    interpolators = ("ur",)
    fly_keys = frozenset({"distance"})
    frame_names: Mapping[str, str] = {"tool": "TCP"}

    def read(self, text: str, path: str = "", robot: RobotDescription | None = None) -> UrScriptProgram:
        """A program of the motion subset."""
        return read_program(text, path, robot)

    def write(self, name: str, statements: Sequence[Statement], robot: RobotDescription | None = None) -> str:
        """A program that makes these moves and delays once."""
        writer = ScriptWriter(robot)
        return writer.text(name, [line for statement in statements for line in writer.statement(statement)])

    def write_loop(self, name: str, loop: LoopProgram, robot: RobotDescription | None = None) -> str:
        """`movej` to the start, then `cycles` times `movel` through points 2 to K and to the first.

        All but the last `movel` of a cycle blend, so every cycle starts and ends with a standstill of 0.1 s.
        """
        writer = ScriptWriter(robot)
        lines = [*writer.statement(loop.approach), f"  {_REST}"]
        moves = [line for move in loop.moves for line in writer.statement(move, "    ")]
        lines += ["  i = 0", f"  while i < {loop.cycles}:", "    write_output_integer_register(24, i)"]
        return writer.text(name, [*lines, *moves, f"    {_REST}", "    i = i + 1", "  end"])

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
        return self.write("job", statements, robot), passed

    def companion(self, program: Path) -> Path | None:
        """None: positions are in the program."""
        return None

    def messages(self, text: str) -> dict[str, str]:
        """None: a program is loaded as it is."""
        return {}
