"""Motion statements to PDL2 text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion.pdl2.reader import parse_program
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.pdl2.syntax import Constant, Pos
from agent.motion.pdl2.variables import FRAMES, SYSTEM_VARIABLES, SystemVariable, pose_to_pos
from agent.motion.program import (
    CartesianTarget,
    Delay,
    JointTarget,
    LoopProgram,
    Move,
    MoveType,
    Statement,
    Target,
    decimals,
)

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: The FLY statement as it is used in the field on the NS16, in its order.
_FLY_STATEMENT = (
    "$FLY_TYPE",
    "$MOVE_TYPE",
    "$SPD_OPT",
    "$FLY_TRAJ",
    "$STRESS_PER",
    "$FLY_DIST",
    "$LIN_SPD",
    "$TERM_TYPE",
    "$TOL_COARSE",
)
#: As published programs spell the arm's own overrides. Those but the first are multiplied with the program's.
_ARM_DATA = "$ARM_DATA[1]."
_MULTIPLIED = ("$ARM_SPD_OVR", "$ARM_ACC_OVR", "$ARM_DEC_OVR")
#: All are set before the first move, so that nothing is left to what ran on the controller before; but of the frames a
#: move need not say anything, and then neither does the text. $ARM_OVR is the last.
_STATED = (
    *FRAMES.values(),
    *(name for name in SYSTEM_VARIABLES if name not in {"$MOVE_TYPE", *FRAMES.values(), *_MULTIPLIED}),
)
_PROGRAM_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}", re.ASCII)
_WIDTH = 110


def write_program(name: str, statements: Sequence[Statement], robot: RobotDescription | None = None) -> str:
    """A HOLD program that makes these moves and delays once; `parse_program` gives them back.

    Coordinates have nine decimals (mm, degrees), settings twelve digits. With `robot`, prismatic joints are in mm.

    The text is read back before it is returned: what this package could not read, it does not write.

    Args:
        name: of the program.
        statements: moves, delays and assignments in order.
        robot: whose prismatic joints are written in mm.

    Raises:
        InputError: a program name PDL2 does not take, a setting outside the range of its system variable, a
            coordinate that is not finite.
    """
    writer = _Writer(statements, robot)
    return writer.text(name, [line for statement in statements for line in writer.statement(statement, indent=2)], [])


def _arriving(move: Move) -> Move:
    """The move, with FINE where it stops."""
    return move if move.fly else replace(move, settings=Pdl2Settings.of(move.settings).stopping())


def write_loop_program(name: str, loop: LoopProgram, robot: RobotDescription | None = None) -> str:
    """A HOLD program of the loop: approach, then the cycle in a FOR.

    The approach is MOVE JOINT and FINE, best to joint positions: they leave no turn or posture open. Each cycle flies
    LINEAR through points 2 to K and closes with MOVE LINEAR to the first point and FINE, so every cycle starts and ends
    at standstill.

    Args:
        name: of the program.
        loop: approach, moves and number of cycles.
        robot: whose prismatic joints are written in mm.

    Raises:
        InputError: what `write_program` refuses.
    """
    first, *moves = (_arriving(move) for move in (loop.approach, *loop.moves))
    writer = _Writer([*moves, first], robot, globals_of=Pdl2Settings.of(loop.moves[0].settings))
    for move in (moves[-1], *moves[:-1]):
        writer.point(move.target)
    lines = [*writer.statement(first, indent=2), f"  FOR cycle_number := 1 TO {loop.cycles} DO"]
    for move in moves:
        lines += writer.statement(move, indent=4)
    lines.append("  ENDFOR")
    return writer.text(name, lines, ["cycle_number : INTEGER"])


class _Writer:
    """Equal points are one variable, in order of first use; settings in force from the start are not repeated."""

    def __init__(
        self, statements: Sequence[Statement], robot: RobotDescription | None, globals_of: Pdl2Settings | None = None
    ):
        self.robot = robot
        self.names: dict[tuple[bytes, str], str] = {}
        self.points: list[Target] = []
        used = [Pdl2Settings.of(statement.settings) for statement in statements if isinstance(statement, Move)]
        self.globals = globals_of or (used[0] if used else Pdl2Settings())
        self.variables = [SYSTEM_VARIABLES[name] for name in _STATED]
        for field in FRAMES:
            if any(getattr(settings, field) is None for settings in used):  # the others say it themselves
                self.globals = self.globals.changed(**{field: None})

    def point(self, target: Target) -> str:
        if isinstance(target, CartesianTarget):
            key = (np.asarray(target.pose, dtype=float).tobytes(), f"'{target.configuration}'")
        else:
            key = (np.asarray(target.position, dtype=float).tobytes(), "")
        if key not in self.names:
            self.points.append(target)
            self.names[key] = f"p{len(self.points)}"
        return self.names[key]

    def statement(self, statement: Statement, indent: int) -> list[str]:
        blank = " " * indent
        if isinstance(statement, Delay):
            return [f"{blank}DELAY {1000.0 * statement.seconds:.12g}"]
        head = (
            f"{blank}{'MOVEFLY' if statement.fly else 'MOVE'} {statement.type.value} TO {self.point(statement.target)}"
        )
        if statement.via is not None:
            head += f" VIA {self.point(statement.via)}"
        if statement.fly:
            head += " ADVANCE"
        settings = self._settings(statement)
        if not settings:
            return [head]
        return [f"{head},", *_wrapped(settings, f"{blank}  WITH "), f"{blank}ENDMOVE"]

    def _settings(self, move: Move) -> list[str]:
        """What the move says itself: the FLY statement in full, then whatever differs from the start."""
        settings = Pdl2Settings.of(move.settings)
        stated = _FLY_STATEMENT if move.fly and move.type is MoveType.LINEAR else ()
        listed = []
        for name in stated:
            value = move.type.value if name == "$MOVE_TYPE" else _value(SYSTEM_VARIABLES[name], settings)
            listed.append(f"{name} = {value}")
        for variable in self.variables:
            field = str(variable.field)
            differs = getattr(settings, field) != getattr(self.globals, field)
            if differs and variable.name not in stated:
                listed.append(f"{variable.name} = {_value(variable, settings)}")
        return listed

    def text(self, name: str, lines: list[str], declarations: list[str]) -> str:
        if _PROGRAM_NAME.fullmatch(name) is None:
            raise InputError(f"program name {name!r}: a letter, then letters, digits and _, 32 characters at most")
        kinds = {"POSITION": CartesianTarget, "JOINTPOS": JointTarget}
        for kind, target_type in kinds.items():
            names = [self.point(target) for target in self.points if isinstance(target, target_type)]
            declarations += [f"{', '.join(names[k : k + 12])} : {kind} FOR ARM[1]" for k in range(0, len(names), 12)]
        declared = ["VAR", *(f"  {declaration}" for declaration in declarations)] if declarations else []
        start = [f"  {self.point(target)} := {_target(target, self.robot)}" for target in self.points]
        assigned = [variable for variable in self.variables if getattr(self.globals, str(variable.field)) is not None]
        start += [f"  {variable.name} := {_value(variable, self.globals)}" for variable in assigned]
        start[-1] = start[-1].replace("$", _ARM_DATA)
        start += [f"  {override.replace('$', _ARM_DATA)} := 100" for override in _MULTIPLIED]
        text = "\n".join([f"PROGRAM {name} HOLD, PROG_ARM=1", *declared, "BEGIN", *start, *lines, f"END {name}", ""])
        parse_program(text, "the program to be written", self.robot)
        return text


def _value(variable: SystemVariable, settings: Pdl2Settings) -> str:
    value = variable.read(settings)
    refusal = variable.refusal(value)
    if refusal:
        raise InputError(f"{variable.name} {refusal}")
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    if isinstance(value, Constant):
        return value.name
    if isinstance(value, Pos):
        return _pos(np.array(value.fields), "")
    return f"{float(value):.12g}"


def _target(target: Target, robot: RobotDescription | None) -> str:
    if isinstance(target, CartesianTarget):
        return _pos(pose_to_pos(target.pose), target.configuration)
    position = np.asarray(target.position, dtype=float)
    if robot is not None and len(position) != robot.dof:
        raise InputError(f"a joint target has {len(position)} joints; {robot.name} has {robot.dof}")
    prismatic = False if robot is None else np.array([joint.prismatic for joint in robot.joints])
    joints = np.where(prismatic, 1000.0 * position, np.degrees(position))
    return "{" + ", ".join(decimals(value) for value in joints) + "}"


def _pos(fields: np.ndarray, configuration: str) -> str:
    quoted = configuration.replace("'", "''")
    return f"POS({', '.join(decimals(value) for value in fields)}, '{quoted}')"


def _wrapped(items: list[str], head: str) -> list[str]:
    """Comma-separated items, each line beginning with `head` and ending in a comma."""
    lines, line = [], head
    for item in items:
        if len(line) + len(item) + 1 > _WIDTH and line != head:
            lines.append(line.rstrip())
            line = head
        line += f"{item}, "
    return [*lines, line.rstrip()]
