"""What can be known of a program before it runs: names, data types, constants and the shape of each move."""

from __future__ import annotations

from dataclasses import dataclass

from agent.motion.pdl2 import tree
from agent.motion.pdl2.errors import Pdl2Error, TextPosition
from agent.motion.pdl2.evaluation import Memory, Value, check_configuration, evaluate
from agent.motion.pdl2.variables import PREDEFINED, SYSTEM_VARIABLES

MAX_ARRAY = 65535
MAX_JOINTS = 10

_DATA_TYPES = {
    "integer": "INTEGER",
    "real": "REAL",
    "boolean": "BOOLEAN",
    "position": "POS",
    "pos": "POS",
    "jointpos": "JOINTPOS",
}
_ATTRIBUTES = {"HOLD": None, "NOHOLD": None, "EZ": None, "PROG_ARM": (1, 1), "PRIORITY": (1, 3), "STACK": (1, 65535)}
_VALUE_TYPES = (
    (bool, "BOOLEAN"),  # before int, which bool is too
    (int, "INTEGER"),
    (float, "REAL"),
    (str, "STRING"),
    (tree.Pos, "POS"),
    (tree.Joints, "JOINTPOS"),
)
_NUMBERS = ("INTEGER", "REAL")


@dataclass(frozen=True)
class DataType:
    """INTEGER, REAL, BOOLEAN, STRING, POS, JOINTPOS or predefined; with `size`, an array of them."""

    name: str
    size: int | None = None

    def __str__(self) -> str:
        return self.name if self.size is None else f"ARRAY[{self.size}] OF {self.name}"


@dataclass(frozen=True)
class Scope:
    """The names a program declares: data types of its variables, values of its constants, initial values."""

    variables: dict[str, DataType]
    constants: dict[str, Value]
    initial: dict[str, Value]


def check(program: tree.ProgramTree) -> Scope:
    """Check a whole program.

    Raises:
        Pdl2Error: at the first word that is undeclared, of the wrong data type or out of its range.
    """
    _check_header(program)
    scope = Scope({}, {}, {})
    types: dict[str, DataType] = {}
    for declaration in program.declarations:
        if isinstance(declaration, tree.ConstantDeclaration):
            _require_new(declaration.place, scope, types)
            scope.constants[declaration.name] = _constant(declaration.value, scope)
        elif isinstance(declaration, tree.TypeDeclaration):
            _require_new(declaration.place, scope, types)
            types[declaration.name] = _data_type(declaration.type, scope, types)
        else:
            _declare_variables(declaration, scope, types)
    _Checker(scope).block(program.block)
    return scope


def _check_header(program: tree.ProgramTree) -> None:
    given: set[str] = set()
    for attribute in program.attributes:
        if attribute.name not in _ATTRIBUTES or attribute.name in given:
            known = ", ".join(_ATTRIBUTES)
            raise Pdl2Error(f"is given twice or is not an attribute known here ({known})", attribute.place)
        given.add(attribute.name)
        allowed = _ATTRIBUTES[attribute.name]
        if (allowed is None) != (attribute.value is None):
            raise Pdl2Error("takes no value" if allowed is None else "takes '=' and an integer", attribute.place)
        if allowed and attribute.value and not allowed[0] <= int(attribute.value.value) <= allowed[1]:
            raise Pdl2Error(f"{attribute.name} is in {allowed[0]}..{allowed[1]} here", attribute.value.place)
    if {"HOLD", "NOHOLD"} <= given:
        raise Pdl2Error("a program is HOLD or NOHOLD, not both", program.attributes[-1].place)
    if "NOHOLD" in given:
        place = next(attribute.place for attribute in program.attributes if attribute.name == "NOHOLD")
        raise Pdl2Error("a NOHOLD program cannot move the arm; write HOLD", place)
    if program.end.word.lower() != program.name.lower():
        raise Pdl2Error(f"END names the program, which is {program.name}", program.end)


def _require_new(place: TextPosition, scope: Scope, types: dict[str, DataType]) -> None:
    name = place.word.lower()
    if name in PREDEFINED or name in _DATA_TYPES:
        raise Pdl2Error("is a predefined word and cannot be declared", place)
    if name in scope.constants or name in scope.variables or name in types:
        raise Pdl2Error("is declared twice", place)


def _constant(expression: tree.Expression, scope: Scope) -> Value:
    """The value of an expression that may refer to constants only."""
    checker = _Checker(Scope({}, scope.constants, {}), constant=True)
    checker.type_of(expression)
    return evaluate(expression, Memory(scope.constants, {}, {}))


def _data_type(named: tree.NamedType, scope: Scope, types: dict[str, DataType]) -> DataType:
    if named.name in types:
        found = types[named.name]
    elif named.name in _DATA_TYPES:
        found = DataType(_DATA_TYPES[named.name])
    else:
        raise Pdl2Error("is not a data type known here (INTEGER, REAL, BOOLEAN, POSITION, JOINTPOS)", named.place)
    if named.size is None:
        return found
    size = _constant(named.size, scope)
    if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= MAX_ARRAY:
        raise Pdl2Error(f"the size of an array is an integer in 1..{MAX_ARRAY}", named.size.place)
    if found.size is not None:
        raise Pdl2Error("is an array already; arrays of arrays are not read here", named.place)
    return DataType(found.name, size)


def _declare_variables(declaration: tree.VariableDeclaration, scope: Scope, types: dict[str, DataType]) -> None:
    data_type = _data_type(declaration.type, scope, types)
    value = None
    if declaration.initial is not None:
        if data_type.size is not None:
            raise Pdl2Error("an array has no initial value here; assign its elements", declaration.initial.place)
        _Checker(Scope({}, scope.constants, {}), constant=True).assignable(data_type.name, declaration.initial)
        value = _constant(declaration.initial, scope)
    for place in declaration.names:
        _require_new(place, scope, types)
        scope.variables[place.word.lower()] = data_type
        if value is not None:
            scope.initial[place.word.lower()] = value


class _Checker:
    def __init__(self, scope: Scope, constant: bool = False):
        self.scope = scope
        self.constant = constant

    def block(self, block: tree.Block) -> None:
        for statement in block:
            if isinstance(statement, tree.Assignment):
                self.assignment(statement)
            elif isinstance(statement, tree.MoveStatement):
                self.move(statement)
            elif isinstance(statement, tree.DelayStatement):
                self.require(statement.milliseconds, *_NUMBERS)
            elif isinstance(statement, tree.ForLoop):
                for_types = [statement.variable, statement.first, statement.last]
                for expression in [*for_types, *([statement.step] if statement.step else [])]:
                    self.require(expression, "INTEGER")
                self.variable(statement.variable)
                self.block(statement.block)
            else:
                self.require(statement.condition, "BOOLEAN")
                self.block(statement.then)
                self.block(statement.otherwise)

    def assignment(self, statement: tree.Assignment) -> None:
        target = statement.target
        if isinstance(target, tree.System):
            self.system(target.place, target.name, statement.value)
            return
        self.variable(target)
        self.assignable(self.type_of(target), statement.value)

    def variable(self, target: tree.Name | tree.Element) -> None:
        if target.name in self.scope.constants or target.name in PREDEFINED:
            raise Pdl2Error("is a constant and cannot be assigned", target.place)

    def assignable(self, wanted: str, value: tree.Expression) -> None:
        self.require(value, *(_NUMBERS if wanted == "REAL" else (wanted,)))

    def system(self, place: TextPosition, name: str, value: tree.Expression) -> None:
        variable = SYSTEM_VARIABLES.get(name)
        if variable is None:
            raise Pdl2Error("is not a system variable of the motion subset read here", place)
        if variable.choices is None:
            self.assignable(variable.kind, value)
            return
        self.type_of(value)
        if isinstance(value, tree.Name) and value.name in PREDEFINED:
            refusal = variable.refusal(PREDEFINED[value.name])
            if refusal:
                raise Pdl2Error(f"{name} {refusal}", value.place)
        else:
            self.require(value, "predefined")

    def move(self, statement: tree.MoveStatement) -> None:
        self.require(statement.target, "POS", "JOINTPOS")
        if statement.via is not None:
            self.require(statement.via, "POS", "JOINTPOS")
            if statement.trajectory in ("LINEAR", "JOINT"):
                raise Pdl2Error(f"VIA belongs to a CIRCULAR move, not to {statement.trajectory}", statement.via.place)
        elif statement.trajectory == "CIRCULAR":
            raise Pdl2Error("a CIRCULAR move needs VIA and a point", statement.place)
        given: set[str] = set()
        for setting in statement.settings:
            self.system(setting.place, setting.name, setting.value)
            if setting.name in given:
                raise Pdl2Error("is set twice in this move", setting.place)
            given.add(setting.name)

    def require(self, expression: tree.Expression, *wanted: str) -> None:
        found = self.type_of(expression)
        if found not in wanted:
            article = "predefined constant" if found == "predefined" else found
            raise Pdl2Error(f"is {article} where {' or '.join(wanted)} is needed", expression.place)

    def type_of(self, expression: tree.Expression) -> str:
        """The data type of a whole expression; arrays only by their elements."""
        tree.check_expression_depth(expression)
        return self._type(expression)

    def _type(self, node: tree.Expression) -> str:
        if isinstance(node, tree.Literal):
            return _value_type(node.value)
        if isinstance(node, tree.Name):
            return self._name(node)
        if isinstance(node, tree.Element):
            return self._element(node)
        if isinstance(node, tree.System):
            return self._system(node)
        if isinstance(node, tree.PosLiteral):
            return self._pos(node)
        if isinstance(node, tree.JointLiteral):
            if len(node.fields) > MAX_JOINTS:
                raise Pdl2Error(f"a JOINTPOS has at most {MAX_JOINTS} joints, not {len(node.fields)}", node.place)
            for field in node.fields:
                self._operand(field, "a JOINTPOS", _NUMBERS)
            return "JOINTPOS"
        return self._operation(node)

    def _name(self, node: tree.Name) -> str:
        if node.name in PREDEFINED:
            return _value_type(PREDEFINED[node.name])
        if node.name in self.scope.constants:
            return _value_type(self.scope.constants[node.name])
        data_type = self._declared(node)
        if data_type.size is not None:
            raise Pdl2Error(f"is {data_type}; name one element as {node.place.word}[i]", node.place)
        return data_type.name

    def _element(self, node: tree.Element) -> str:
        data_type = self._declared(tree.Name(node.place, node.name))
        if data_type.size is None:
            raise Pdl2Error(f"is {data_type}, not an array", node.place)
        self._operand(node.index, "a subscript", ("INTEGER",))
        return data_type.name

    def _declared(self, node: tree.Name) -> DataType:
        data_type = self.scope.variables.get(node.name)
        if data_type is None:
            raise Pdl2Error("is not a constant known here" if self.constant else "is not declared", node.place)
        return data_type

    def _system(self, node: tree.System) -> str:
        if node.name not in SYSTEM_VARIABLES:
            raise Pdl2Error("is not a system variable of the motion subset read here", node.place)
        if self.constant:
            raise Pdl2Error("is a variable where a constant is needed", node.place)
        return SYSTEM_VARIABLES[node.name].kind

    def _pos(self, node: tree.PosLiteral) -> str:
        if len(node.fields) not in (6, 7):
            raise Pdl2Error(
                f"POS has 6 fields (x, y, z, a, e, r) or 7 (and the configuration string), not {len(node.fields)}",
                node.place,
            )
        for field in node.fields[:6]:
            self._operand(field, "a coordinate of POS", _NUMBERS)
        for flags in node.fields[6:]:
            self._operand(flags, "the configuration of POS", ("STRING",))
            if isinstance(flags, tree.Literal):
                check_configuration(str(flags.value), flags.place)
        return "POS"

    def _operation(self, node: tree.Unary | tree.Binary) -> str:
        if isinstance(node, tree.Unary):
            return self._operand(node.operand, node.operator, ("BOOLEAN",) if node.operator == "NOT" else _NUMBERS)
        operator = node.operator
        wanted: tuple[str, ...] = _NUMBERS
        if operator in ("AND", "OR"):
            wanted = ("BOOLEAN",)
        elif operator in ("DIV", "MOD"):
            wanted = ("INTEGER",)
        elif operator in ("=", "<>"):
            wanted = (*_NUMBERS, "BOOLEAN", "predefined")
        left = self._operand(node.left, operator, wanted)
        right = self._operand(node.right, operator, wanted)
        if operator in ("=", "<>", "<", ">", "<=", ">="):
            if left != right and not {left, right} <= set(_NUMBERS):
                raise Pdl2Error(f"compares {left} with {right}", node.place)
            return "BOOLEAN"
        if operator == "/" or "REAL" in (left, right):
            return "REAL"
        return left

    def _operand(self, node: tree.Expression, what: str, wanted: tuple[str, ...]) -> str:
        found = self._type(node)
        if found not in wanted:
            raise Pdl2Error(f"is {found}; {what} takes {' or '.join(wanted)}", node.place)
        return found


def _value_type(value: object) -> str:
    return next((name for kind, name in _VALUE_TYPES if isinstance(value, kind)), "predefined")
