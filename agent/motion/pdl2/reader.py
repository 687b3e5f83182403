"""From text to a checked program, and the moves that it makes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from agent.motion.pdl2 import syntax
from agent.motion.pdl2.checker import check
from agent.motion.pdl2.evaluation import Memory, Scope, Value, assigned_value, evaluate, setting_value, subscript
from agent.motion.pdl2.syntax import Pdl2Error, TextPosition
from agent.motion.pdl2.variables import motion_settings, pos_to_pose, read
from agent.motion.program import CartesianTarget, Delay, JointTarget, Move, MoveType, Statement, Target

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Default number of statements and loop turns after which a run is refused.
MAX_STEPS = 1_000_000
MAX_DELAY = 3_600_000
#: A program has no inputs, so its first steps are the same on every run. They are tried when it is read.
_TRIAL_STEPS = 5000


def parse_program(text: str, path: str = "", robot: RobotDescription | None = None) -> Program:
    """Read and check a program of the motion subset; `path` is named in messages.

    With `robot`, a JOINTPOS must have its number of joints, and its prismatic joints are in mm.

    Args:
        text: of the program.
        path: named in messages.
        robot: whose number and kind of joints a JOINTPOS must have.

    Raises:
        Pdl2Error: text outside the subset, an undeclared name, a data type that does not fit, and whatever the first
            5000 steps of the program would meet when it runs (positions not assigned, values out of range).
    """
    try:
        tree = syntax.parse_tree(text)
        program = Program(str(tree.word), path, tree.cycle, tree, check(tree), robot)
    except Pdl2Error as error:
        raise error.within(path) from None
    try:
        for _ in program.run(limit=_TRIAL_STEPS):
            pass
    except StepLimitError:
        pass
    return program


@dataclass(frozen=True, eq=False)
class Program:
    """A program that was read and checked. `cycle` says that it has BEGIN CYCLE and so never ends by itself.

    `syntax` and `scope` are what was read, for another interpreter.
    """

    name: str
    path: str
    cycle: bool
    syntax: syntax.ProgramTree
    scope: Scope
    _robot: RobotDescription | None

    def run(self, limit: int = MAX_STEPS) -> Iterator[Statement]:
        """The moves and delays in order, loops unrolled as they are reached; SI units.

        `limit` is the number of statements and loop turns that may be executed.

        Raises:
            Pdl2Error: while iterating, where a statement cannot be executed (a position that was not assigned, a value
                out of its range, …) or `limit` is passed.
        """
        run = _Run(self, limit)
        try:
            yield from run.block(self.syntax.block)
            while self.cycle:
                run.step(self.syntax.position)
                yield from run.block(self.syntax.block)
        except Pdl2Error as error:
            raise error.within(self.path) from None


class StepLimitError(Pdl2Error):
    """The run was longer than its limit."""


class _Run:
    """The state of one run: assigned values, and the number of steps that are left."""

    def __init__(self, program: Program, limit: int):
        scope = program.scope
        self.robot = program._robot
        self.variables: dict[str | tuple[str, int], Value] = {name: value for name, value in scope.initial.items()}
        self.system: dict[str, Value] = {}
        self.memory = Memory(scope.constants, self.variables, self.system, scope.variables)
        self.limit = limit
        self.steps_left = limit

    def step(self, position: TextPosition) -> None:
        self.steps_left -= 1
        if self.steps_left < 0:
            raise StepLimitError(f"the program executes more than {self.limit} statements", position)

    def block(self, block: syntax.Block) -> Iterator[Statement]:
        for statement in block:
            self.step(statement.position)
            match statement:
                case syntax.MoveStatement():
                    yield self.move(statement)
                case syntax.Assignment():
                    self.assign(statement)
                case syntax.ForLoop():
                    yield from self.loop(statement)
                case syntax.DelayStatement():
                    yield self.delay(statement)

    def integer(self, expression: syntax.Expression) -> int:
        return int(evaluate(expression, self.memory))  # type: ignore[arg-type]  # the checker knows that it is one

    def loop(self, statement: syntax.ForLoop) -> Iterator[Statement]:
        first, last = self.integer(statement.first), self.integer(statement.last)
        step = 1 if statement.step is None else self.integer(statement.step)
        if step < 1:
            raise Pdl2Error(f"STEP is {step} and must be at least 1; DOWNTO counts down", statement.position)
        for value in range(first, last - 1, -step) if statement.down else range(first, last + 1, step):
            self.step(statement.position)
            self.variables[statement.variable.name] = value
            yield from self.block(statement.block)

    def assign(self, statement: syntax.Assignment) -> None:
        target = statement.target
        if isinstance(target, syntax.System):
            self.system[target.name] = setting_value(target, statement.value, self.memory)
            return
        value = assigned_value(target, statement.value, self.memory)
        if isinstance(target, syntax.Element):
            self.variables[target.name, subscript(target, self.memory)] = value
        else:
            self.variables[target.name] = value

    def delay(self, statement: syntax.DelayStatement) -> Delay:
        milliseconds = float(evaluate(statement.milliseconds, self.memory))  # type: ignore[arg-type]
        if not 0 <= milliseconds <= MAX_DELAY:
            raise Pdl2Error(f"the time is {milliseconds:g} ms and must be in 0..{MAX_DELAY} ms", statement.position)
        return Delay(milliseconds / 1000.0)

    def move(self, statement: syntax.MoveStatement) -> Move:
        system = dict(self.system)
        for setting in statement.settings:
            system[setting.name] = setting_value(setting, setting.value, self.memory)
        kind = MoveType[statement.trajectory or read("$MOVE_TYPE", system).name]  # type: ignore[arg-type,union-attr]
        if (kind is MoveType.CIRCULAR) != (statement.via is not None):
            raise Pdl2Error("VIA belongs to a CIRCULAR move, and a CIRCULAR move needs it", statement.position)
        target, name = self.target(statement.target)
        return Move(
            type=kind,
            target=target,
            settings=motion_settings(system),  # type: ignore[arg-type]  # no setting is of joints
            fly=statement.fly,
            via=None if statement.via is None else self.target(statement.via)[0],
            name=name,
            line=statement.position.line,
        )

    def target(self, node: syntax.Expression) -> tuple[Target, str]:
        value = evaluate(node, self.memory)
        name = str(node.word) if isinstance(node, syntax.Name | syntax.Element) else ""
        if isinstance(node, syntax.Element):
            name += f"[{subscript(node, self.memory)}]"
        if isinstance(value, syntax.Pos):
            return CartesianTarget(_pose(value.fields), value.configuration), name
        assert isinstance(value, syntax.Joints)
        return JointTarget(self.joints(value.fields, node.position)), name

    def joints(self, fields: tuple[float, ...], position: TextPosition) -> np.ndarray:
        if self.robot is None:
            return np.radians(fields)
        if len(fields) != self.robot.dof:
            raise Pdl2Error(f"has {len(fields)} joints; {self.robot.name} has {self.robot.dof}", position)
        prismatic = [joint.prismatic for joint in self.robot.joints]
        return np.where(prismatic, np.array(fields) / 1000.0, np.radians(fields))


@lru_cache(maxsize=1024)
def _pose(fields: tuple[float, ...]) -> np.ndarray:
    pose = pos_to_pose(np.array(fields))
    pose.setflags(write=False)  # shared by every move to this point
    return pose
