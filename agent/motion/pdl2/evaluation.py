"""The value of an expression, and whether its data types fit.

A program is checked before it runs by evaluating every expression with a specimen of each variable's data type
(`Memory.checking`). So one set of rules says what an expression means and what is wrong with it.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from agent.motion.pdl2 import syntax
from agent.motion.pdl2.syntax import Pdl2Error, TextPosition, shortened
from agent.motion.pdl2.variables import PREDEFINED, SYSTEM_VARIABLES, SystemVariable, read

MAX_JOINTS = 10

Value = bool | int | float | str | syntax.Constant | syntax.Pos | syntax.Joints

NUMBERS = ("INTEGER", "REAL")
_TYPES = (
    (bool, "BOOLEAN"),  # before int, which bool is too
    (int, "INTEGER"),
    (float, "REAL"),
    (str, "STRING"),
    (syntax.Pos, "POS"),
    (syntax.Joints, "JOINTPOS"),
    (syntax.Constant, "predefined"),
)
#: A value of each data type, which stands for all of them while a program is checked.
_SPECIMENS: dict[str, Value] = {
    "BOOLEAN": True,
    "INTEGER": 1,
    "REAL": 1.0,
    "POS": syntax.Pos((0.0,) * 6, ""),
    "JOINTPOS": syntax.Joints((0.0,)),
    "predefined": syntax.Constant(""),
}
_FLAG = re.compile(r"[SEWAB]|T[1-4]:-?[0-9]{1,3}", re.IGNORECASE | re.ASCII)


def _quotient(left: int, right: int) -> int:
    """Rounded towards zero."""
    return abs(left) // abs(right) * (1 if (left < 0) == (right < 0) else -1)


#: Operators of two operands: the data types that they take, and what they do.
_OPERATORS: dict[str, tuple[tuple[str, ...], Callable[[Any, Any], Any]]] = {
    "+": (NUMBERS, operator.add),
    "-": (NUMBERS, operator.sub),
    "*": (NUMBERS, operator.mul),
    "/": (NUMBERS, operator.truediv),
    "DIV": (("INTEGER",), _quotient),
    "MOD": (("INTEGER",), lambda left, right: left - _quotient(left, right) * right),
}


@dataclass(frozen=True)
class DataType:
    """INTEGER, REAL, BOOLEAN, POS or JOINTPOS; with `size`, an array of them."""

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
    """Constants and variables by name, array elements by (name, index), system variables that were assigned, and the
    data types of the variables (None: only constants may be referred to). While `checking`, no value is looked at."""

    constants: Mapping[str, Value]
    variables: Mapping[str | tuple[str, int], Value]
    system: Mapping[str, Value]
    types: Mapping[str, DataType] | None = None
    checking: bool = False


def evaluate(node: syntax.Expression, memory: Memory, *wanted: str) -> Value:
    """The value of a whole expression, of one of the data types `wanted` where some are named.

    Raises:
        Pdl2Error: an undeclared name, a data type that does not fit, a variable that was not assigned, a subscript out
            of its array, an overflow, a division by zero.
    """
    value = _value(node, memory)
    type_ = _type(value)
    if wanted and type_ not in wanted:
        article = "predefined constant" if type_ == "predefined" else type_
        raise Pdl2Error(f"is {article} where {' or '.join(wanted)} is needed", node.position)
    return value


def assignable(data_type: str) -> tuple[str, ...]:
    """Data types of the values that a variable of this type takes."""
    return NUMBERS if data_type == "REAL" else (data_type,)


def subscript(node: syntax.Element, memory: Memory) -> int:
    """The index of an array element, from 1."""
    data_type = _declared(node, memory)
    if data_type.size is None:
        raise Pdl2Error(f"is {data_type}, not an array", node.position)
    index: Any = _operand(node.index, memory, "a subscript", ("INTEGER",))
    if not (memory.checking or 1 <= index <= data_type.size):
        reason = f"the subscript of {node.word} is {index}; its elements are 1..{data_type.size}"
        raise Pdl2Error(reason, node.index.position)
    return int(index)


def assigned_value(target: syntax.Name | syntax.Element, value: syntax.Expression, memory: Memory) -> Value:
    """The value for a variable; an INTEGER becomes REAL where the variable is.

    Raises:
        Pdl2Error: a constant as the target, a data type that does not fit, and as `evaluate`.
    """
    check_variable(target, memory)
    if isinstance(target, syntax.Element):
        subscript(target, memory)
    data_type = _declared(target, memory)
    if data_type.size is not None and isinstance(target, syntax.Name):
        raise Pdl2Error(f"is {data_type}; name one element as {target.word}[i]", target.position)
    evaluated: Any = evaluate(value, memory, *assignable(data_type.name))
    return float(evaluated) if data_type.name == "REAL" else evaluated


def setting_value(target: syntax.System, value: syntax.Expression, memory: Memory) -> Value:
    """The value for a system variable, in its range.

    Raises:
        Pdl2Error: an unknown variable, a data type or a value that it does not take, and as `evaluate`.
    """
    variable = _system(target)
    if variable.choices is not None and isinstance(value, syntax.Name) and value.name in PREDEFINED:
        if refusal := variable.refusal(PREDEFINED[value.name]):
            raise Pdl2Error(f"{target.name} {refusal}", value.position)
        return PREDEFINED[value.name]
    evaluated = evaluate(value, memory, *assignable(variable.kind))
    if not memory.checking and (refusal := variable.refusal(evaluated)):  # type: ignore[arg-type]  # none is of joints
        raise Pdl2Error(refusal, target.position)
    return evaluated


def check_variable(target: syntax.Name | syntax.Element, memory: Memory) -> None:
    """Raise Pdl2Error if a constant is used where a variable is required."""
    if target.name in memory.constants or target.name in PREDEFINED:
        raise Pdl2Error("is a constant and cannot be assigned", target.position)


def _value(node: syntax.Expression, memory: Memory) -> Value:
    match node:
        case syntax.Literal():
            return node.value
        case syntax.Name():
            known = PREDEFINED.get(node.name, memory.constants.get(node.name))
            if known is not None:
                return known
            data_type = _declared(node, memory)
            if data_type.size is not None:
                raise Pdl2Error(f"is {data_type}; name one element as {node.word}[i]", node.position)
            return _stored_value(node, data_type, memory, node.name, node.word)
        case syntax.Element():
            index = subscript(node, memory)
            return _stored_value(node, _declared(node, memory), memory, (node.name, index), f"{node.word}[{index}]")
        case syntax.System():
            kind = _system(node).kind
            if memory.types is None:
                raise Pdl2Error("is a variable where a constant is needed", node.position)
            return _SPECIMENS[kind] if memory.checking else read(node.name, memory.system)  # type: ignore[arg-type]
        case syntax.PosLiteral():
            return _pos(node, memory)
        case syntax.JointLiteral():
            if len(node.fields) > MAX_JOINTS:
                raise Pdl2Error(f"a JOINTPOS has at most {MAX_JOINTS} joints, not {len(node.fields)}", node.position)
            return syntax.Joints(_numbers(node.fields, memory, "a JOINTPOS"))
        case syntax.Operation():
            return _operated(node, memory)
    raise AssertionError(node)


def _type(value: object) -> str:
    return next(name for kind, name in _TYPES if isinstance(value, kind))


def _declared(node: syntax.Name | syntax.Element, memory: Memory) -> DataType:
    data_type = None if memory.types is None else memory.types.get(node.name)
    if data_type is None:
        raise Pdl2Error("is not a constant known here" if memory.types is None else "is not declared", node.position)
    return data_type


def _stored_value(
    node: syntax.Expression, data_type: DataType, memory: Memory, key: str | tuple[str, int], word: str
) -> Value:
    """The value of a variable or an array element."""
    value = _SPECIMENS[data_type.name] if memory.checking else memory.variables.get(key)
    if value is None:
        raise Pdl2Error(f"{word} has no value yet", node.position)
    return value


def _system(node: syntax.System) -> SystemVariable:
    if node.name not in SYSTEM_VARIABLES:
        raise Pdl2Error("is not a system variable of the motion subset read here", node.position)
    return SYSTEM_VARIABLES[node.name]


def _operand(part: syntax.Expression, memory: Memory, what: str, wanted: tuple[str, ...]) -> Value:
    value = _value(part, memory)
    if _type(value) not in wanted:
        raise Pdl2Error(f"is {_type(value)}; {what} takes {' or '.join(wanted)}", part.position)
    return value


def _numbers(fields: tuple[syntax.Expression, ...], memory: Memory, what: str) -> tuple[float, ...]:
    return tuple(float(_operand(field, memory, what, NUMBERS)) for field in fields)  # type: ignore[arg-type]


def _pos(node: syntax.PosLiteral, memory: Memory) -> syntax.Pos:
    count = len(node.fields)
    if count not in (6, 7):
        reason = f"POS has 6 fields (x, y, z, a, e, r) or 7 (and the configuration string), not {count}"
        raise Pdl2Error(reason, node.position)
    fields = _numbers(node.fields[:6], memory, "a coordinate of POS")
    configuration = ""
    for flags in node.fields[6:]:
        configuration = str(_operand(flags, memory, "the configuration of POS", ("STRING",)))
        _check_configuration(configuration, flags.position)
    return syntax.Pos(fields, configuration)


def _check_configuration(configuration: str, position: TextPosition) -> None:
    """Raises Pdl2Error where a configuration string has other flags than S, E, W, A, B and turns T1:n to T4:n."""
    names: set[str] = set()
    for flag in configuration.split():
        name = flag.upper().split(":")[0]
        if _FLAG.fullmatch(flag) is None or name in names:
            raise Pdl2Error(
                f"{shortened(flag)} is no configuration flag or given twice (S E W T1:n T2:n T3:n)", position
            )
        names.add(name)


def _operated(node: syntax.Operation, memory: Memory) -> Value:
    word = node.operator
    if len(node.operands) == 1:
        value: Any = _operand(node.operands[0], memory, word, NUMBERS)
        return _in_range(-value if word == "-" else value, node)
    takes, operate = _OPERATORS[word]
    left, right = (_operand(part, memory, word, takes) for part in node.operands)
    if memory.checking:
        return _SPECIMENS["REAL" if word == "/" or "REAL" in (_type(left), _type(right)) else "INTEGER"]
    if word in ("/", "DIV", "MOD") and right == 0:
        raise Pdl2Error("divides by zero", node.position)
    return _in_range(operate(left, right), node)


def _in_range(value: Any, node: syntax.Expression) -> Value:
    if isinstance(value, int) and abs(value) > syntax.MAX_INTEGER:
        raise Pdl2Error(f"the result is beyond the integers of {syntax.MAX_INTEGER}", node.position)
    if not math.isfinite(value):
        raise Pdl2Error("the result is beyond the numbers", node.position)
    return value
