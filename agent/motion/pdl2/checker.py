"""Checks of a program before it runs: names, data types, constants and the shape of each move."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.motion.pdl2 import syntax
from agent.motion.pdl2.evaluation import (
    NUMBERS,
    DataType,
    Memory,
    Scope,
    assignable,
    assigned_value,
    check_variable,
    evaluate,
    setting_value,
)
from agent.motion.pdl2.syntax import Pdl2Error, position_of
from agent.motion.pdl2.variables import PREDEFINED

if TYPE_CHECKING:
    from lark import Token

MAX_ARRAY = 65535

_DATA_TYPES = {
    "integer": "INTEGER",
    "real": "REAL",
    "boolean": "BOOLEAN",
    "position": "POS",
    "pos": "POS",
    "jointpos": "JOINTPOS",
}
_ATTRIBUTES = {"HOLD": None, "NOHOLD": None, "EZ": None, "PROG_ARM": (1, 1), "PRIORITY": (1, 3), "STACK": (1, 65535)}


def check(program: syntax.ProgramTree) -> Scope:
    """Check a whole program.

    Raises:
        Pdl2Error: at the first word that is undeclared, of the wrong data type or out of its range.
    """
    _check_header(program)
    declarations = _Declarations()
    for declaration in program.declarations:
        declarations.declare(declaration)
    scope = declarations.scope
    _check_block(program.block, Memory(scope.constants, {}, {}, scope.variables, checking=True))
    return scope


def _check_header(program: syntax.ProgramTree) -> None:
    attributes: dict[str, syntax.Attribute] = {}
    for attribute in program.attributes:
        name = attribute.word.upper()
        if name not in _ATTRIBUTES or name in attributes:
            known = ", ".join(_ATTRIBUTES)
            raise Pdl2Error(f"is given twice or is not an attribute known here ({known})", attribute.position)
        attributes[name] = attribute
        allowed = _ATTRIBUTES[name]
        if (allowed is None) != (attribute.value is None):
            raise Pdl2Error("takes no value" if allowed is None else "takes '=' and an integer", attribute.position)
        if allowed and attribute.value and not allowed[0] <= int(attribute.value.value) <= allowed[1]:
            raise Pdl2Error(f"{name} is in {allowed[0]}..{allowed[1]} here", attribute.value.position)
    if {"HOLD", "NOHOLD"} <= attributes.keys():
        raise Pdl2Error("a program is HOLD or NOHOLD, not both", program.attributes[-1].position)
    if "NOHOLD" in attributes:
        raise Pdl2Error("a NOHOLD program cannot move the arm; write HOLD", attributes["NOHOLD"].position)
    if program.end.lower() != program.name:
        raise Pdl2Error(f"END names the program, which is {program.word}", position_of(program.end))


class _Declarations:
    """The declared names."""

    def __init__(self) -> None:
        self.scope = Scope({}, {}, {})
        self._types = {word: DataType(name) for word, name in _DATA_TYPES.items()}
        self._constants = Memory(self.scope.constants, {}, {})

    def declare(self, declaration: syntax.Declaration) -> None:
        """Add the names of one declaration, or raise Pdl2Error."""
        data_type = None if declaration.type is None else self._data_type(declaration.type)
        value = declaration.value
        initial = None
        if value is not None:
            if data_type is not None and data_type.size is not None:
                raise Pdl2Error("an array has no initial value here; assign its elements", value.position)
            initial = evaluate(value, self._constants, *(assignable(data_type.name) if data_type else ()))
        for word in declaration.words:
            name = self._new(word)
            if data_type is None:
                assert initial is not None
                self.scope.constants[name] = initial
            elif declaration.section == "TYPE":
                self._types[name] = data_type
            else:
                self.scope.variables[name] = data_type
                if initial is not None:
                    self.scope.initial[name] = initial

    def _new(self, word: Token) -> str:
        """The name of a word that is not declared yet."""
        name = word.lower()
        if name in PREDEFINED or name in _DATA_TYPES:
            raise Pdl2Error("is a predefined word and cannot be declared", position_of(word))
        if name in self.scope.constants or name in self.scope.variables or name in self._types:
            raise Pdl2Error("is declared twice", position_of(word))
        return name

    def _data_type(self, named: syntax.NamedType) -> DataType:
        data_type = self._types.get(named.name)
        if data_type is None:
            reason = "is not a data type known here (INTEGER, REAL, BOOLEAN, POSITION, JOINTPOS)"
            raise Pdl2Error(reason, named.position)
        if named.size is None:
            return data_type
        size = evaluate(named.size, self._constants)
        if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= MAX_ARRAY:
            raise Pdl2Error(f"the size of an array is an integer in 1..{MAX_ARRAY}", named.size.position)
        if data_type.size is not None:
            raise Pdl2Error("is an array already; arrays of arrays are not read here", named.position)
        return DataType(data_type.name, size)


def _check_block(block: syntax.Block, memory: Memory) -> None:
    for statement in block:
        match statement:
            case syntax.Assignment(target=syntax.System() as target):
                setting_value(target, statement.value, memory)
            case syntax.Assignment(target=syntax.Name() | syntax.Element() as target):
                assigned_value(target, statement.value, memory)
            case syntax.MoveStatement():
                _check_move(statement, memory)
            case syntax.DelayStatement():
                evaluate(statement.milliseconds, memory, *NUMBERS)
            case syntax.ForLoop():
                for expression in (statement.variable, statement.first, statement.last, statement.step):
                    if expression is not None:
                        evaluate(expression, memory, "INTEGER")
                check_variable(statement.variable, memory)
                _check_block(statement.block, memory)


def _check_move(statement: syntax.MoveStatement, memory: Memory) -> None:
    evaluate(statement.target, memory, "POS", "JOINTPOS")
    if statement.via is not None:
        evaluate(statement.via, memory, "POS", "JOINTPOS")
        if statement.trajectory in ("LINEAR", "JOINT"):
            raise Pdl2Error(f"VIA belongs to a CIRCULAR move, not to {statement.trajectory}", statement.via.position)
    elif statement.trajectory == "CIRCULAR":
        raise Pdl2Error("a CIRCULAR move needs VIA and a point", statement.position)
    names: set[str] = set()
    for setting in statement.settings:
        setting_value(setting, setting.value, memory)
        if setting.name in names:
            raise Pdl2Error("is set twice in this move", setting.position)
        names.add(setting.name)
