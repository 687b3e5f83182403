"""The controller's own reading of a program's statements, with its own system variables.

With the planner it shares the grammar and the arithmetic of expressions, not what a statement or a variable means.
System variables outlive a program: what one has set, the next finds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from agent.motion import (
    CartesianTarget,
    Delay,
    FlyTrajectory,
    FlyType,
    Frame,
    JointTarget,
    Move,
    MoveType,
    OrientationType,
    Pdl2Settings,
    SpeedOption,
    Statement,
    Target,
    Termination,
)
from agent.motion.pdl2 import (
    Assignment,
    Block,
    Constant,
    DelayStatement,
    Element,
    Expression,
    ForLoop,
    Joints,
    Memory,
    MoveStatement,
    Pdl2Error,
    Pos,
    Program,
    System,
    Value,
    evaluate,
    subscript,
)
from agent.robot import RobotDescription
from fake_controller.program.frames import Transform, target_in_robot_base

_NOWHERE = Pos((0.0,) * 6, "")
#: As the controller comes, in its own units: mm, degrees, percent, m/s, rad/s.
FACTORY: dict[str, Value] = {
    "$BASE": _NOWHERE,
    "$TOOL": _NOWHERE,
    "$UFRAME": _NOWHERE,
    "$MOVE_TYPE": Constant("JOINT"),
    "$FLY_TYPE": Constant("FLY_NORM"),
    "$FLY_TRAJ": Constant("FLY_AUTO"),
    "$FLY_DIST": 10.0,
    "$FLY_PER": 100,
    "$STRESS_PER": 50,
    "$SPD_OPT": Constant("SPD_LIN"),
    "$LIN_SPD": 0.25,
    "$ROT_SPD": 1.0,
    "$ORNT_TYPE": Constant("RS_WORLD"),
    "$TERM_TYPE": Constant("COARSE"),
    "$TOL_FINE": 0.5,
    "$TOL_COARSE": 1.0,
    "$CNFG_CARE": False,
    "$TURN_CARE": False,
    "$SING_CARE": False,
    "$JNT_MTURN": True,
    "$PROG_SPD_OVR": 100,
    "$PROG_ACC_OVR": 100,
    "$PROG_DEC_OVR": 100,
    "$ARM_SPD_OVR": 100,
    "$ARM_ACC_OVR": 100,
    "$ARM_DEC_OVR": 100,
    "$ARM_OVR": 100,
}
#: Belong to the arm, not to the program: the others are as the controller comes whenever a program starts.
OF_THE_ARM = (
    "$BASE", "$TOOL", "$UFRAME", "$CNFG_CARE", "$TURN_CARE", "$JNT_MTURN",
    "$ARM_SPD_OVR", "$ARM_ACC_OVR", "$ARM_DEC_OVR", "$ARM_OVR",
)  # fmt: skip


def left_over(seed: int) -> dict[str, Value]:
    """System variables as some earlier program has left them: frames of its work, its tool, and how it turned."""
    rng = np.random.default_rng([seed, 16])

    def frame(reach: float) -> Pos:
        fields = [*rng.uniform(-reach, reach, 3), *rng.uniform((-180, 0, -180), (180, 180, 180))]
        return Pos(tuple(float(np.round(x, 3)) for x in fields), "")

    frames = {"$BASE": frame(500.0), "$TOOL": frame(200.0), "$UFRAME": frame(800.0)}
    return {**FACTORY, **frames, "$JNT_MTURN": False}


class Interpreter:
    """One run of a program on the controller's system variables, which it changes.

    In the moves it yields poses are in the robot's base already; the tool goes with the settings.

    Args:
        program: translated.
        robot: whose program it is.
        system: the controller's system variables by name.
    """

    def __init__(self, program: Program, robot: RobotDescription, system: dict[str, Value]) -> None:
        system.update({name: value for name, value in FACTORY.items() if name not in OF_THE_ARM})
        scope = program.scope
        self._program = program
        self._prismatic = np.array([joint.prismatic for joint in robot.joints])
        self._system = system
        self._variables: dict[Any, Value] = dict(scope.initial)
        self._reals = {name for name, kind in scope.variables.items() if kind.name == "REAL"}
        self._memory = Memory(scope.constants, self._variables, system, scope.variables)
        self._poses: dict[tuple[Any, ...], np.ndarray] = {}

    def run(self) -> Iterator[Statement]:
        """Moves and delays as they are reached.

        Raises:
            Pdl2Error: while iterating, at a statement that cannot be executed.
        """
        while True:
            yield from self._block(self._program.syntax.block)
            if not self._program.cycle:
                return

    def _block(self, block: Block) -> Iterator[Statement]:
        for statement in block:
            match statement:
                case MoveStatement():
                    yield self._move(statement)
                case DelayStatement():
                    yield Delay(float(self._value(statement.milliseconds)) * 1e-3)  # type: ignore[arg-type]
                case Assignment():
                    self._assign(statement)
                case ForLoop():
                    yield from self._loop(statement)

    def _loop(self, loop: ForLoop) -> Iterator[Statement]:
        count, last = int(self._value(loop.first)), int(self._value(loop.last))  # type: ignore[arg-type]
        step = 1 if loop.step is None else int(self._value(loop.step))  # type: ignore[arg-type]
        if step < 1:
            raise Pdl2Error(f"STEP is {step}; it counts from 1 up", loop.position)
        sign = -1 if loop.down else 1
        while sign * (last - count) >= 0:
            self._variables[loop.variable.name] = count
            yield from self._block(loop.block)
            count += sign * step

    def _assign(self, statement: Assignment) -> None:
        target, value = statement.target, self._value(statement.value)
        if isinstance(target, System):
            self._system[target.name] = value
            return
        if target.name in self._reals:
            value = float(value)  # type: ignore[arg-type]
        if isinstance(target, Element):
            self._variables[target.name, subscript(target, self._memory)] = value
        else:
            self._variables[target.name] = value

    def _move(self, move: MoveStatement) -> Move:
        """WITH holds for its own move; all its values are taken before any of them is in force."""
        system = self._system | {setting.name: self._value(setting.value) for setting in move.settings}
        word = move.trajectory or system["$MOVE_TYPE"].name  # type: ignore[union-attr]
        return Move(
            type=MoveType(word),
            target=self._target(move.target, system),
            settings=_settings(system),
            fly=move.fly,
            via=None if move.via is None else self._target(move.via, system),
            line=move.position.line,
        )

    def _target(self, node: Expression, system: dict[str, Value]) -> Target:
        value = self._value(node)
        if isinstance(value, Joints):
            if len(value.fields) != len(self._prismatic):
                raise Pdl2Error(f"this arm has {len(self._prismatic)} joints", node.position)
            return JointTarget(np.array(value.fields) * np.where(self._prismatic, 1e-3, np.pi / 180))
        assert isinstance(value, Pos)
        base, uframe = _fields(system["$BASE"]), _fields(system["$UFRAME"])
        key = (base, uframe, value.fields)
        if key not in self._poses:
            self._poses[key] = target_in_robot_base(*key)
        return CartesianTarget(self._poses[key], value.configuration)

    def _value(self, node: Expression) -> Value:
        return evaluate(node, self._memory)


def _fields(value: Value) -> tuple[float, ...]:
    assert isinstance(value, Pos)
    return value.fields


def _matrix(value: Value) -> Frame:
    return tuple(tuple(row) for row in Transform.of_pos(_fields(value)).matrix.tolist())


def _settings(system: dict[str, Value]) -> Pdl2Settings:
    """The interpolator's view of system variables: SI, overrides multiplied, no frames but the tool's."""

    def number(name: str) -> float:
        return float(system[name])  # type: ignore[arg-type]

    def word(name: str) -> str:
        return system[name].name  # type: ignore[union-attr]

    tool = _matrix(system["$TOOL"])
    # Poses are in the robot's base by now; where the robot stands still matters to Euler angles of the world.
    world = _matrix(system["$BASE"]) if word("$ORNT_TYPE") == "EUL_WORLD" else None
    return Pdl2Settings(
        fly_type=FlyType(word("$FLY_TYPE")),
        fly_trajectory=FlyTrajectory(word("$FLY_TRAJ")),
        fly_distance=number("$FLY_DIST") * 1e-3,
        fly_percent=number("$FLY_PER"),
        stress_percent=number("$STRESS_PER"),
        speed_option=SpeedOption(word("$SPD_OPT")),
        linear_speed=number("$LIN_SPD"),
        rotational_speed=number("$ROT_SPD"),
        orientation=OrientationType(word("$ORNT_TYPE")),
        termination=Termination(word("$TERM_TYPE")),
        tolerance_fine=number("$TOL_FINE") * 1e-3,
        tolerance_coarse=number("$TOL_COARSE") * 1e-3,
        speed_override=number("$PROG_SPD_OVR") * number("$ARM_SPD_OVR") * 1e-4,
        acceleration_override=number("$PROG_ACC_OVR") * number("$ARM_ACC_OVR") * 1e-4,
        deceleration_override=number("$PROG_DEC_OVR") * number("$ARM_DEC_OVR") * 1e-4,
        arm_override=number("$ARM_OVR") * 1e-2,
        base=world,
        tool=tool,
        uframe=world,
        configuration_care=bool(system["$CNFG_CARE"]),
        turn_care=bool(system["$TURN_CARE"]),
        singularity_care=bool(system["$SING_CARE"]),
        multi_turn=bool(system["$JNT_MTURN"]),
    )
