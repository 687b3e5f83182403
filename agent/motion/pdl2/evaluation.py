"""Expressions: their data types, known before a program runs, and their values."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from agent.motion.pdl2 import syntax
from agent.motion.pdl2.errors import Pdl2Error, TextPosition, shortened
from agent.motion.pdl2.variables import PREDEFINED, SYSTEM_VARIABLES, read

MAX_JOINTS = 10

Value = bool | int | float | str | syntax.Constant | syntax.Pos | syntax.Joints

NUMBERS = ("INTEGER", "REAL")
_VALUE_TYPES = (
    (bool, "BOOLEAN"),  # before int, which bool is too
    (int, "INTEGER"),
    (float, "REAL"),
    (str, "STRING"),
    (syntax.Pos, "POS"),
    (syntax.Joints, "JOINTPOS"),
)
_FLAG = re.compile(r"[SEWAB]|T[1-4]:-?[0-9]{1,3}", re.IGNORECASE | re.ASCII)


def _quotient(left: int, right: int) -> int:
    """Rounded towards zero."""
    return abs(left) // abs(right) * (1 if (left < 0) == (right < 0) else -1)


#: Operators of two operands: the data types that they take, and what they do.
_OPERATORS: dict[str, tuple[tuple[str, ...], Callable[[Any, Any], Any]]] = {
    "AND": (("BOOLEAN",), lambda left, right: bool(left and right)),
    "OR": (("BOOLEAN",), lambda left, right: bool(left or right)),
    "=": ((*NUMBERS, "BOOLEAN", "predefined"), operator.eq),
    "<>": ((*NUMBERS, "BOOLEAN", "predefined"), operator.ne),
    "<": (NUMBERS, operator.lt),
    ">": (NUMBERS, operator.gt),
    "<=": (NUMBERS, operator.le),
    ">=": (NUMBERS, operator.ge),
    "+": (NUMBERS, operator.add),
    "-": (NUMBERS, operator.sub),
    "*": (NUMBERS, operator.mul),
    "/": (NUMBERS, operator.truediv),
    "DIV": (("INTEGER",), _quotient),
    "MOD": (("INTEGER",), lambda left, right: left - _quotient(left, right) * right),
}
_COMPARISONS = {"=", "<>", "<", ">", "<=", ">="}


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


class Memory(NamedTuple):
    """Constants and variables by name, array elements by (name, index), system variables that were assigned."""

    constants: Mapping[str, Value]
    variables: Mapping[str | tuple[str, int], Value]
    system: Mapping[str, Value]
    sizes: Mapping[str, int] = {}


def require(expression: syntax.Expression, scope: Scope, *wanted: str, constant: bool = False) -> None:
    """Check a whole expression; one that is `constant` refers to no variable.

    Raises:
        Pdl2Error: nested too deep, of another data type than one `wanted`, or something in it is.
    """
    found = type_of(expression, scope, constant)
    if found not in wanted:
        article = "predefined constant" if found == "predefined" else found
        raise Pdl2Error(f"is {article} where {' or '.join(wanted)} is needed", expression.place)


def type_of(expression: syntax.Expression, scope: Scope, constant: bool = False) -> str:
    """The data type of a whole expression; arrays only by their elements.

    Raises:
        Pdl2Error: nested too deep, or something in it is undeclared or of the wrong data type.
    """
    syntax.check_expression_depth(expression)
    return _Types(scope, constant).of(expression)


class _Types:
    def __init__(self, scope: Scope, constant: bool):
        self.scope, self.constant = scope, constant

    def of(self, node: syntax.Expression) -> str:
        match node:
            case syntax.Literal():
                return _value_type(node.value)
            case syntax.Name():
                return self._name(node)
            case syntax.Element():
                data_type = self._declared(node)
                if data_type.size is None:
                    raise Pdl2Error(f"is {data_type}, not an array", node.place)
                self._operand(node.index, "a subscript", ("INTEGER",))
                return data_type.name
            case syntax.System():
                if node.name not in SYSTEM_VARIABLES:
                    raise Pdl2Error("is not a system variable of the motion subset read here", node.place)
                if self.constant:
                    raise Pdl2Error("is a variable where a constant is needed", node.place)
                return SYSTEM_VARIABLES[node.name].kind
            case syntax.PosLiteral():
                return self._pos(node)
            case syntax.JointLiteral():
                if len(node.fields) > MAX_JOINTS:
                    raise Pdl2Error(f"a JOINTPOS has at most {MAX_JOINTS} joints, not {len(node.fields)}", node.place)
                for field in node.fields:
                    self._operand(field, "a JOINTPOS", NUMBERS)
                return "JOINTPOS"
        return self._operation(node)

    def _name(self, node: syntax.Name) -> str:
        known = PREDEFINED.get(node.name, self.scope.constants.get(node.name))
        if known is not None:
            return _value_type(known)
        data_type = self._declared(node)
        if data_type.size is not None:
            raise Pdl2Error(f"is {data_type}; name one element as {node.word}[i]", node.place)
        return data_type.name

    def _declared(self, node: syntax.Name | syntax.Element) -> DataType:
        data_type = self.scope.variables.get(node.name)
        if data_type is None:
            raise Pdl2Error("is not a constant known here" if self.constant else "is not declared", node.place)
        return data_type

    def _pos(self, node: syntax.PosLiteral) -> str:
        count = len(node.fields)
        if count not in (6, 7):
            reason = f"POS has 6 fields (x, y, z, a, e, r) or 7 (and the configuration string), not {count}"
            raise Pdl2Error(reason, node.place)
        for field in node.fields[:6]:
            self._operand(field, "a coordinate of POS", NUMBERS)
        for flags in node.fields[6:]:
            self._operand(flags, "the configuration of POS", ("STRING",))
            if isinstance(flags, syntax.Literal):
                _check_configuration(str(flags.value), flags.place)
        return "POS"

    def _operation(self, node: syntax.Operation) -> str:
        if len(node.operands) == 1:
            return self._operand(node.operands[0], node.operator, ("BOOLEAN",) if node.operator == "NOT" else NUMBERS)
        left, right = (self._operand(part, node.operator, _OPERATORS[node.operator][0]) for part in node.operands)
        if node.operator in _COMPARISONS:
            if left != right and not {left, right} <= set(NUMBERS):
                raise Pdl2Error(f"compares {left} with {right}", node.place)
            return "BOOLEAN"
        return "REAL" if node.operator == "/" or "REAL" in (left, right) else left

    def _operand(self, node: syntax.Expression, what: str, wanted: tuple[str, ...]) -> str:
        found = self.of(node)
        if found not in wanted:
            raise Pdl2Error(f"is {found}; {what} takes {' or '.join(wanted)}", node.place)
        return found


def _value_type(value: object) -> str:
    return next((name for kind, name in _VALUE_TYPES if isinstance(value, kind)), "predefined")


def evaluate(node: syntax.Expression, memory: Memory) -> Value:
    """The value of an expression whose data types were checked before.

    Raises:
        Pdl2Error: a variable that was not assigned, a subscript out of its array, an overflow, a division by zero.
    """
    match node:
        case syntax.Literal():
            return node.value
        case syntax.Name():
            known = PREDEFINED.get(node.name, memory.constants.get(node.name))
            return _assigned(memory.variables.get(node.name), node, node.word) if known is None else known
        case syntax.Element():
            index = subscript(node, memory)
            return _assigned(memory.variables.get((node.name, index)), node, f"{node.word}[{index}]")
        case syntax.System():
            return read(node.name, memory.system)  # type: ignore[arg-type]
        case syntax.PosLiteral():
            configuration = ""
            if len(node.fields) == 7:
                configuration = str(evaluate(node.fields[6], memory))
                _check_configuration(configuration, node.fields[6].place)
            return syntax.Pos(_coordinates(node.fields[:6], memory), configuration)
        case syntax.JointLiteral():
            return syntax.Joints(_coordinates(node.fields, memory))
    return _operated(node, memory)


def subscript(node: syntax.Element, memory: Memory) -> int:
    """The index of an array element, from 1."""
    index, size = int(evaluate(node.index, memory)), memory.sizes[node.name]  # type: ignore[arg-type]
    if not 1 <= index <= size:
        raise Pdl2Error(f"the subscript of {node.word} is {index}; its elements are 1..{size}", node.index.place)
    return index


def _check_configuration(configuration: str, place: TextPosition) -> None:
    """Raises Pdl2Error where a configuration string has other flags than S, E, W, A, B and turns T1:n to T4:n."""
    seen: set[str] = set()
    for flag in configuration.split():
        name = flag.upper().split(":")[0]
        if _FLAG.fullmatch(flag) is None or name in seen:
            raise Pdl2Error(f"{shortened(flag)} is no configuration flag or given twice (S E W T1:n T2:n T3:n)", place)
        seen.add(name)


def _assigned(value: Value | None, node: syntax.Node, name: str) -> Value:
    if value is None:
        raise Pdl2Error(f"{name} has no value yet", node.place)
    return value


def _coordinates(fields: tuple[syntax.Expression, ...], memory: Memory) -> tuple[float, ...]:
    return tuple(float(evaluate(field, memory)) for field in fields)  # type: ignore[arg-type]


def _operated(node: syntax.Operation, memory: Memory) -> Value:
    left, *others = (evaluate(operand, memory) for operand in node.operands)
    if node.operator == "NOT":
        return not left
    if not others:
        return _in_range(-left if node.operator == "-" else left, node)  # type: ignore[operator]
    if node.operator in ("/", "DIV", "MOD") and others[0] == 0:
        raise Pdl2Error("divides by zero", node.place)
    return _in_range(_OPERATORS[node.operator][1](left, others[0]), node)


def _in_range(value: Any, node: syntax.Node) -> Value:
    if isinstance(value, int) and abs(value) > syntax.MAX_INTEGER:
        raise Pdl2Error(f"the result is beyond the integers of {syntax.MAX_INTEGER}", node.place)
    if not math.isfinite(value):
        raise Pdl2Error("the result is beyond the numbers", node.place)
    return value
