"""URScript statements to motion statements. What waits for the outside world (`while read_…`) counts as fulfilled."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections import ChainMap, Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.motion import rotation
from agent.motion.fly.fly_parameters import LONGEST
from agent.motion.program import (
    NO_FRAME,
    CartesianTarget,
    Delay,
    JointTarget,
    Move,
    MoveType,
    Statement,
    Target,
    frame_of,
    matrix_of,
)
from agent.motion.urscript.preamble import STILL, check_margin, check_preamble, check_statements, check_text, waits
from agent.motion.urscript.settings import (
    JOINT_ACCELERATION,
    JOINT_SPEED,
    LINEAR_ACCELERATION,
    LINEAR_SPEED,
    UrSettings,
)
from agent.motion.urscript.statements import DEEPEST, HEADER, ScriptLine, UrScriptError, nested, parsed, rows_of

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Functions that move the arm in ways that are no moves to a target.
_MOVING = re.compile(r"\b(servo[jcl]|speed[jl]|optimove[jl]|force_mode|freedrive_mode|teach_mode|conveyor_\w+)\(")
_TARGETED = re.compile(r"\bmove[jlpc]\(")
#: Statements that a program may take.
_LONGEST = 200_000
_PARAMETERS = {
    "movej": ("q", "a", "v", "t", "r"),
    "movel": ("pose", "a", "v", "t", "r"),
    "movep": ("pose", "a", "v", "r"),
    "movec": ("pose_via", "pose_to", "a", "v", "r", "mode"),
}
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: operator.mod,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "d2r": math.radians,
    "r2d": math.degrees,
    "pose_trans": lambda first, second: first @ second,
    "pose_inv": np.linalg.inv,
    "get_inverse_kin": lambda pose, *seed: pose,
    **{each.__name__: each for each in (math.acos, math.asin, math.atan, math.atan2)},
    **{each.__name__: each for each in (math.cos, math.sin, math.sqrt, math.tan)},
}


class _Outside(Exception):
    """A value that only the controller knows."""


@dataclass(frozen=True)
class UrScriptProgram:
    """A program that was read. `lenient` passes over what is not understood and does not move, and counts it."""

    name: str
    path: str
    lines: list[ScriptLine]
    robot: RobotDescription | None = None
    lenient: bool = False
    passed: Counter[str] = field(default_factory=Counter)

    def run(self, once: bool = False) -> Iterator[Statement]:
        """Its moves and delays in order; `once`: every loop is gone through once.

        Raises:
            UrScriptError: a statement that cannot be executed, or a program that never ends.
        """
        return _ScriptRun(self, once).block(self.lines, 0)


def read_program(text: str, path: str = "", robot: RobotDescription | None = None) -> UrScriptProgram:
    """Read a program of the motion subset that may run: one whose watchdog is in effect before anything else.

    Raises:
        UrScriptError: not one; names path and line.
    """
    check_text(text, path)
    program = _read(text, path, robot, lenient=False)
    check_margin(text, path)
    check_statements(program.lines, path)
    for _ in program.run(once=True):
        pass
    check_preamble(program.lines, path)
    return program


def job_text(text: str, path: str, robot: RobotDescription | None) -> tuple[list[Statement], dict[str, int]]:
    """The moves of a person's program, every loop gone through once, and how often each word was passed over.

    Raises:
        UrScriptError: something moves that is not understood.
    """
    program = _read(text, path, robot, lenient=True)
    return list(program.run(once=True)), dict(program.passed)


def _read(text: str, path: str, robot: RobotDescription | None, lenient: bool) -> UrScriptProgram:
    remaining = deque(row for row in rows_of(text) if not row[1].startswith("$"))  # PolyScope's tree of the program
    lines = nested(remaining, path)
    if remaining:
        raise UrScriptError(f"{path}:{remaining[0][0]}: `{remaining[0][1]}` ends no block")
    top = [line for line in lines if line.word == "def"]
    if not lenient and (len(top) != 1 or len(lines) != 1):
        raise UrScriptError(f"{path}: one `def NAME():` is expected, and nothing before or after it")
    first = HEADER.match(top[0].text) if top else None
    if not lenient and (first is None or first[2].strip()):
        raise UrScriptError(f"{path}: `def NAME():` is expected first")
    body = top[0].block if len(top) == 1 and len(lines) == 1 else lines
    return UrScriptProgram(first[1] if first else "script", path, body, robot, lenient)


class _ScriptRun:
    """One run of a program: variables, the tool and load in force, and the functions that were defined."""

    def __init__(self, program: UrScriptProgram, once: bool) -> None:
        self._program = program
        self._once = once or program.lenient
        self._values: ChainMap[str, Any] = ChainMap({"True": True, "False": False})
        self._defined: dict[str, tuple[ScriptLine, ChainMap[str, Any]]] = {}
        self._settings = UrSettings(base=NO_FRAME, uframe=NO_FRAME)
        self._left, self._waited = _LONGEST, 0.0

    def block(self, lines: list[ScriptLine], depth: int) -> Iterator[Statement]:
        for line in lines:
            try:
                yield from self._line(line, depth)
            except (_Outside, UrScriptError, ArithmeticError, LookupError, TypeError, ValueError) as error:
                if not self._program.lenient or _MOVING.search(line.text) or _TARGETED.search(line.text):
                    raise self._error(line, error) from None
                self._program.passed[re.match(r"\W*\w*", line.text)[0] or line.text[:10]] += 1  # type: ignore[index]

    def _error(self, line: ScriptLine, error: Exception) -> UrScriptError:
        if isinstance(error, UrScriptError):
            return error
        what = "depends on what only the controller knows" if isinstance(error, _Outside) else f"{error}"
        return UrScriptError(f"{self._program.path}:{line.number}: `{line.text[:60]}`: {what}")

    def _line(self, line: ScriptLine, depth: int) -> Iterator[Statement]:
        self._left -= 1
        if self._left < 0 or depth > DEEPEST:
            raise UrScriptError(f"{self._program.path}:{line.number}: the program does not come to an end")
        if line.word == "def":
            header = HEADER.match(line.text)
            if header is None:
                raise ValueError("a function needs a name and parentheses")
            self._defined[header[1]] = line, self._values
        elif line.word in ("thread", "sec"):
            raise ValueError("what runs beside the program is not understood")
        elif line.word == "while":
            yield from self._loop(line, depth)
        elif line.word == "if":
            try:
                chosen = line.block if self._value(line.text) else line.otherwise
            except _Outside:
                if not self._program.lenient:
                    raise
                chosen = line.block
            yield from self.block(chosen, depth + 1)
        elif line.word.startswith("set "):
            self._assign(line.word[4:], line.scope, self._value(line.text))
        else:
            yield from self._call(line, depth)

    def _assign(self, name: str, scope: str, value: Any) -> None:
        """To the variable of that name that can be seen; to a new one of the function where there is none."""
        holder = next((values for values in self._values.maps if name in values), self._values.maps[0])
        {"local": self._values.maps[0], "global": self._values.maps[-1]}.get(scope, holder)[name] = value

    def _loop(self, line: ScriptLine, depth: int) -> Iterator[Statement]:
        lenient = self._program.lenient
        if isinstance(parsed(line.text), ast.Constant) and not lenient:
            raise ValueError("a loop without an end is not understood")
        try:
            while self._value(line.text):
                yield from self.block(line.block, depth + 1)
                if self._once:
                    return
        except _Outside:  # it waits for the world outside
            if lenient:
                yield from self.block(line.block, depth + 1)
            elif not waits(line):
                raise

    def _call(self, line: ScriptLine, depth: int) -> Iterator[Statement]:
        tree = parsed(line.text)
        if not (isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name)):
            raise ValueError("is no statement that is understood")
        name = tree.func.id
        if STILL.fullmatch(name):
            return
        positional = [self._evaluated(argument) for argument in tree.args]
        named = {str(argument.arg): self._evaluated(argument.value) for argument in tree.keywords}
        if name in self._defined:
            routine, around = self._defined[name]
            header = HEADER.match(routine.text)
            assert header is not None
            parameters = [argument.partition("=")[0].strip() for argument in header[2].split(",") if argument.strip()]
            caller, self._values = self._values, around.new_child(_arguments(parameters, positional, named))
            yield from self.block(routine.block, depth + 1)
            self._values = caller
        elif name == "sleep":
            seconds = _number(positional[0], least=0.0)
            self._waited += seconds
            if self._waited > LONGEST and not self._program.lenient:
                raise ValueError(f"the program sleeps for more than {LONGEST:g} s up to here; run it in parts")
            yield Delay(seconds)
        elif name == "set_tcp":
            self._settings = self._settings.changed(tool=frame_of(positional[0]))
        elif name in ("set_payload", "set_target_payload"):
            centre = positional[1] if len(positional) > 1 else matrix_of(self._settings.tool)[:3, 3]
            self._settings = self._settings.changed(load=(_number(positional[0], least=0.0), *map(_number, centre)))
        elif name in ("movej", "movel", "movep", "movec"):
            yield self._move(name, positional, named, line.number)
        else:
            raise ValueError(f"the function {name} is not understood")

    def _move(self, name: str, positional: list[Any], named: dict[str, Any], line: int) -> Move:
        arguments = _arguments(_PARAMETERS[name], positional, named)
        via, goal = arguments.get("pose_via"), arguments[_PARAMETERS[name][1 if name == "movec" else 0]]
        if arguments.get("t") and not self._program.lenient:
            raise ValueError("a move in a given time is not understood; give a= and v=")
        radius = _number(arguments.get("r", 0.0), least=0.0)
        settings = self._settings.changed(fly_distance=radius)
        joint = name == "movej"
        speed = _number(arguments.get("v", JOINT_SPEED if joint else LINEAR_SPEED), above=0.0)
        acceleration = _number(arguments.get("a", JOINT_ACCELERATION if joint else LINEAR_ACCELERATION), above=0.0)
        if joint:
            settings = settings.changed(joint_speed=speed, joint_acceleration=acceleration)
        else:
            settings = settings.changed(linear_speed=speed, linear_acceleration=acceleration)
        kind = {"movej": MoveType.JOINT, "movec": MoveType.CIRCULAR}.get(name, MoveType.LINEAR)
        through = None if via is None else self._target(via)
        return Move(kind, self._target(goal), settings, radius > 0.0, through, line=line)

    def _target(self, value: Any) -> Target:
        if isinstance(value, np.ndarray):
            return CartesianTarget(value)
        robot = self._program.robot
        position = np.array([_number(part) for part in value], dtype=float)
        if robot is not None and position.shape != (robot.dof,):
            raise ValueError(f"{robot.name} has {robot.dof} joints")
        return JointTarget(position)

    def _value(self, text: str) -> Any:
        return self._evaluated(parsed(text))

    def _evaluated(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=value):
                return value if isinstance(value, str | bool) else _number(value)
            case ast.Name() if node.id in self._values:
                return self._values[node.id]
            case ast.List() | ast.Tuple():
                return [self._evaluated(element) for element in node.elts]
            case ast.Subscript(value=ast.Name(id="p")):
                return _pose(self._evaluated(node.slice))
            case ast.Subscript():
                return _element(self._evaluated(node.value), self._evaluated(node.slice))
            case ast.UnaryOp() | ast.BinOp() | ast.Compare(ops=[_]):
                of = node.ops[0] if isinstance(node, ast.Compare) else node.op
                parts = [part for part in ast.iter_child_nodes(node) if isinstance(part, ast.expr)]
                return _computed(type(of), [self._evaluated(part) for part in parts])
            case ast.BoolOp():
                values = [bool(self._evaluated(element)) for element in node.values]
                return all(values) if isinstance(node.op, ast.And) else any(values)
            case ast.Call(func=ast.Name(id=name)) if name in _FUNCTIONS:
                return self._asked(name, node)
            case ast.Name() | ast.Call():
                raise _Outside
        raise ValueError("is no expression that is understood")

    def _asked(self, name: str, call: ast.Call) -> Any:
        if not self._program.lenient and (call.keywords or (name == "get_inverse_kin" and len(call.args) > 1)):
            raise ValueError("which of its postures the arm takes is not known here; give joint values")
        return _FUNCTIONS[name](*(self._evaluated(element) for element in call.args))


def _number(value: Any, least: float = -math.inf, above: float = -math.inf) -> float:
    """A number that a controller can hold: of 32 bits if it is whole (user manual, "Variable value types").

    Raises:
        ValueError: another value, or one out of range.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value if isinstance(value, bool) else type(value).__name__} is no number")
    if not math.isfinite(value) or (isinstance(value, int) and not -(2**31) <= value < 2**31):
        raise ValueError("a number is too large")
    if value < least or value <= above:
        raise ValueError(f"{value:g} is too small a number here")
    return value


def _computed(kind: type, values: list[Any]) -> Any:
    """The value of an operator: of numbers, but for comparison and `not`.

    Raises:
        ValueError: not numbers, or a result on which this reader and a controller may differ.
    """
    if kind is ast.Not:
        return not values[0]
    if kind in (ast.Eq, ast.NotEq):
        if any(isinstance(value, np.ndarray) for value in values):
            raise ValueError("poses are not compared")
        return _OPERATORS[kind](*values)
    numbers = [_number(value) for value in values]
    whole = all(isinstance(value, int) for value in numbers)
    if (kind is ast.Div and whole and numbers[0] % numbers[1]) or (kind is ast.Mod and min(numbers) < 0):
        raise ValueError("controllers may round a quotient of whole numbers in another way; write a decimal point")
    result = _OPERATORS[kind](*numbers)
    return result if isinstance(result, bool) else _number(result)


def _pose(values: Any) -> np.ndarray:
    """The matrix (4, 4) of position [m] and rotation vector [rad].

    Raises:
        ValueError: not six numbers.
    """
    fields = np.array([_number(value) for value in values], dtype=float)
    if fields.shape != (6,):
        raise ValueError("a pose has six numbers")
    return rotation.to_pose(fields[:3], rotation.from_rotation_vector(fields[3:]))


def _element(values: Any, index: Any) -> Any:
    """Raises:
    ValueError: not an element of a list.
    """
    if not (isinstance(values, list) and type(index) is int and index >= 0):
        raise ValueError("an element is that of a list, by a number from 0")
    return values[index]


def _arguments(names: Sequence[str], positional: list[Any], named: dict[str, Any]) -> dict[str, Any]:
    """Values by the names of parameters.

    Raises:
        ValueError: more values than parameters, or a name that there is not.
    """
    if len(positional) > len(names) or not set(named) <= set(names[len(positional) :]):
        raise ValueError(f"takes {', '.join(names) or 'no argument'}")
    return dict(zip(names, positional, strict=False)) | named
