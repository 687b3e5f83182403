"""Motion statements to URScript text.

Every program begins with what lets it be stopped and recognised: it writes its number into output register 25, stops
the arm where the heartbeat in input register 24 stops, and waits until input register 25 allows this number to move. It
writes the number of the cycle that begins into output register 24.
"""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion import rotation
from agent.motion.program import CartesianTarget, Delay, MoveType, Statement, Target, decimals, matrix_of
from agent.motion.urscript.reader import read_program
from agent.motion.urscript.settings import UrSettings

if TYPE_CHECKING:
    from agent.robot import RobotDescription

_HEAD = """def {name}():
  write_output_integer_register(25, {number})
  write_output_integer_register(24, -1)
  rtde_set_watchdog("input_int_register_24", 2, "stop")
{frames}  while read_input_integer_register(25) != {number}:
    sync()
  end
  write_output_integer_register(25, 0)
{body}end
"""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
#: Longest name of a program in characters; eight of them and a `_` belong to the checksum.
_LONGEST, _DIGEST = 31, 8


class ScriptWriter:
    """Writes moves, and before them the tool and load where they change.

    Coordinates have nine decimals (m, rad), speeds and accelerations twelve digits. A program is called by its name and
    the checksum of what it does.
    """

    def __init__(self, robot: RobotDescription | None):
        self._robot = robot
        self._frames: list[str] | None = None  # that the program begins with
        self._settings_lines: list[str] = []

    def statement(self, statement: Statement, indent: str = "  ") -> list[str]:
        """Its lines."""
        if isinstance(statement, Delay):
            return [f"{indent}sleep({statement.seconds:.12g})"]
        settings = UrSettings.of(statement.settings)
        before = _frames(settings)
        changed = [line for line in before if line not in self._settings_lines]
        if self._frames is None:
            self._frames, changed = before, []
        self._settings_lines = before
        targets = [target for target in (statement.via, statement.target) if target is not None]
        where = ", ".join(self._target(target) for target in targets)
        joint = statement.type is MoveType.JOINT
        acceleration = settings.joint_acceleration if joint else settings.linear_acceleration
        speed = (settings.joint_speed if joint else settings.linear_speed) * settings.speed_override
        radius = settings.fly_distance if statement.fly else 0.0
        word = {MoveType.JOINT: "movej", MoveType.LINEAR: "movel", MoveType.CIRCULAR: "movec"}[statement.type]
        ending = f"a={acceleration:.12g}, v={speed:.12g}, r={radius:.12g}"
        return [indent + line for line in (*changed, f"{word}({where}, {ending})")]

    def text(self, name: str, lines: list[str]) -> str:
        """The program of these lines, which was read back.

        Raises:
            InputError: a name or a coordinate that URScript does not take.
        """
        if _NAME.fullmatch(name) is None:
            raise InputError(f"program name {name!r}: a letter, then letters, digits and _")
        body = "".join(f"{line}\n" for line in lines)
        frames = "".join(f"  {line}\n" for line in self._frames or [])
        digest = hashlib.sha256((frames + body).encode()).hexdigest()[:_DIGEST]
        text = _HEAD.format(
            name=f"{name[: _LONGEST - _DIGEST - 1]}_{digest}", number=int(digest[:7], 16) + 1, frames=frames, body=body
        )
        read_program(text, "the program to be written", self._robot)
        return text

    def _target(self, target: Target) -> str:
        if isinstance(target, CartesianTarget):
            return f"p[{_pose(np.asarray(target.pose, dtype=float))}]"
        position = np.asarray(target.position, dtype=float)
        if self._robot is not None and len(position) != self._robot.dof:
            raise InputError(f"a joint target has {len(position)} joints; {self._robot.name} has {self._robot.dof}")
        return f"[{', '.join(decimals(value) for value in position)}]"


def _frames(settings: UrSettings) -> list[str]:
    lines = [] if settings.tool is None else [f"set_tcp(p[{_pose(matrix_of(settings.tool))}])"]
    if settings.load is not None:
        mass, *centre = (decimals(value) for value in settings.load)
        lines.append(f"set_target_payload({mass}, [{', '.join(centre)}])")
    return lines


def _pose(pose: np.ndarray) -> str:
    turned = rotation.rotation_vector(rotation.from_matrix(pose[:3, :3]))
    return ", ".join(decimals(value) for value in (*pose[:3, 3], *turned))
