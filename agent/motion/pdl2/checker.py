"""What can be known of a program before it runs: names, data types, constants and the shape of each move."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.motion.pdl2 import syntax
from agent.motion.pdl2.errors import Pdl2Error
from agent.motion.pdl2.evaluation import NUMBERS, DataType, Memory, Scope, Value, evaluate, require, type_of
from agent.motion.pdl2.syntax import place_of
from agent.motion.pdl2.variables import PREDEFINED, SYSTEM_VARIABLES

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
    _check_block(program.block, declarations.scope)
    return declarations.scope


def _check_header(program: syntax.ProgramTree) -> None:
    given: dict[str, syntax.Attribute] = {}
    for attribute in program.attributes:
        name = attribute.word.upper()
        if name not in _ATTRIBUTES or name in given:
            known = ", ".join(_ATTRIBUTES)
            raise Pdl2Error(f"is given twice or is not an attribute known here ({known})", attribute.place)
        given[name] = attribute
        allowed = _ATTRIBUTES[name]
        if (allowed is None) != (attribute.value is None):
            raise Pdl2Error("takes no value" if allowed is None else "takes '=' and an integer", attribute.place)
        if allowed and attribute.value and not allowed[0] <= int(attribute.value.value) <= allowed[1]:
            raise Pdl2Error(f"{name} is in {allowed[0]}..{allowed[1]} here", attribute.value.place)
    if {"HOLD", "NOHOLD"} <= given.keys():
        raise Pdl2Error("a program is HOLD or NOHOLD, not both", program.attributes[-1].place)
    if "NOHOLD" in given:
        raise Pdl2Error("a NOHOLD program cannot move the arm; write HOLD", given["NOHOLD"].place)
    if program.end.lower() != program.name:
        raise Pdl2Error(f"END names the program, which is {program.word}", place_of(program.end))


class _Declarations:
    """What was declared so far."""

    def __init__(self) -> None:
        self.scope = Scope({}, {}, {})
        self._types: dict[str, DataType] = {}
        self._constants = Scope({}, self.scope.constants, {})

    def declare(self, declaration: syntax.Declaration) -> None:
        match declaration:
            case syntax.ConstantDeclaration():
                name = self._new(declaration.word)
                self.scope.constants[name] = self._constant(declaration.value)
            case syntax.TypeDeclaration():
                name = self._new(declaration.word)
                self._types[name] = self._data_type(declaration.type)
            case syntax.VariableDeclaration():
                self._variables(declaration)

    def _new(self, word: Token) -> str:
        """The name of a word that nothing is called by yet."""
        name = word.lower()
        if name in PREDEFINED or name in _DATA_TYPES:
            raise Pdl2Error("is a predefined word and cannot be declared", place_of(word))
        if name in self.scope.constants or name in self.scope.variables or name in self._types:
            raise Pdl2Error("is declared twice", place_of(word))
        return name

    def _constant(self, expression: syntax.Expression) -> Value:
        """The value of an expression that may refer to constants only."""
        type_of(expression, self._constants, constant=True)
        return evaluate(expression, Memory(self.scope.constants, {}, {}))

    def _data_type(self, named: syntax.NamedType) -> DataType:
        found = self._types.get(named.name)
        if found is None:
            if named.name not in _DATA_TYPES:
                raise Pdl2Error(
                    "is not a data type known here (INTEGER, REAL, BOOLEAN, POSITION, JOINTPOS)", named.place
                )
            found = DataType(_DATA_TYPES[named.name])
        if named.size is None:
            return found
        size = self._constant(named.size)
        if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= MAX_ARRAY:
            raise Pdl2Error(f"the size of an array is an integer in 1..{MAX_ARRAY}", named.size.place)
        if found.size is not None:
            raise Pdl2Error("is an array already; arrays of arrays are not read here", named.place)
        return DataType(found.name, size)

    def _variables(self, declaration: syntax.VariableDeclaration) -> None:
        data_type, initial = self._data_type(declaration.type), declaration.initial
        if initial is not None:
            if data_type.size is not None:
                raise Pdl2Error("an array has no initial value here; assign its elements", initial.place)
            require(initial, self._constants, *_assignable(data_type.name), constant=True)
        value = None if initial is None else self._constant(initial)
        for word in declaration.words:
            name = self._new(word)
            self.scope.variables[name] = data_type
            if value is not None:
                self.scope.initial[name] = value


def _assignable(data_type: str) -> tuple[str, ...]:
    return NUMBERS if data_type == "REAL" else (data_type,)


def _check_block(block: syntax.Block, scope: Scope) -> None:
    for statement in block:
        match statement:
            case syntax.Assignment():
                target = statement.target
                if isinstance(target, syntax.System):
                    _check_setting(target, statement.value, scope)
                else:
                    _check_variable(target, scope)
                    require(statement.value, scope, *_assignable(type_of(target, scope)))
            case syntax.MoveStatement():
                _check_move(statement, scope)
            case syntax.DelayStatement():
                require(statement.milliseconds, scope, *NUMBERS)
            case syntax.ForLoop():
                for expression in (statement.variable, statement.first, statement.last, statement.step):
                    if expression is not None:
                        require(expression, scope, "INTEGER")
                _check_variable(statement.variable, scope)
                _check_block(statement.block, scope)
            case syntax.Conditional():
                require(statement.condition, scope, "BOOLEAN")
                _check_block(statement.then, scope)
                _check_block(statement.otherwise, scope)


def _check_variable(target: syntax.Name | syntax.Element, scope: Scope) -> None:
    if target.name in scope.constants or target.name in PREDEFINED:
        raise Pdl2Error("is a constant and cannot be assigned", target.place)


def _check_setting(target: syntax.System, value: syntax.Expression, scope: Scope) -> None:
    variable = SYSTEM_VARIABLES.get(target.name)
    if variable is None:
        raise Pdl2Error("is not a system variable of the motion subset read here", target.place)
    if variable.choices is not None and isinstance(value, syntax.Name) and value.name in PREDEFINED:
        if refusal := variable.refusal(PREDEFINED[value.name]):
            raise Pdl2Error(f"{target.name} {refusal}", value.place)
        return
    require(value, scope, *(_assignable(variable.kind) if variable.choices is None else ("predefined",)))


def _check_move(statement: syntax.MoveStatement, scope: Scope) -> None:
    require(statement.target, scope, "POS", "JOINTPOS")
    if statement.via is not None:
        require(statement.via, scope, "POS", "JOINTPOS")
        if statement.trajectory in ("LINEAR", "JOINT"):
            raise Pdl2Error(f"VIA belongs to a CIRCULAR move, not to {statement.trajectory}", statement.via.place)
    elif statement.trajectory == "CIRCULAR":
        raise Pdl2Error("a CIRCULAR move needs VIA and a point", statement.place)
    given: set[str] = set()
    for setting in statement.settings:
        _check_setting(setting, setting.value, scope)
        if setting.name in given:
            raise Pdl2Error("is set twice in this move", setting.place)
        given.add(setting.name)
