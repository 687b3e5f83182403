"""The value of an expression whose data types were checked before."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from agent.motion.pdl2 import tree
from agent.motion.pdl2.errors import Pdl2Error, TextPosition, shortened
from agent.motion.pdl2.variables import PREDEFINED, read

Value = bool | int | float | str | tree.Constant | tree.Pos | tree.Joints

_FLAG = re.compile(r"[SEWAB]|T[1-4]:-?[0-9]{1,3}", re.IGNORECASE | re.ASCII)
_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {"+": operator.add, "-": operator.sub, "*": operator.mul}
_COMPARISON: dict[str, Callable[[Any, Any], Any]] = {
    "=": operator.eq,
    "<>": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


class Memory(NamedTuple):
    """Constants and variables by name, array elements by (name, index), system variables that were assigned."""

    constants: Mapping[str, Value]
    variables: Mapping[str | tuple[str, int], Value]
    system: Mapping[str, Value]
    sizes: Mapping[str, int] = {}


def evaluate(node: tree.Expression, memory: Memory) -> Value:
    """The value.

    Raises:
        Pdl2Error: a variable that was not assigned, a subscript out of its array, an overflow, a division by zero.
    """
    if isinstance(node, tree.Literal):
        return node.value
    if isinstance(node, tree.Name):
        if node.name in PREDEFINED:
            return PREDEFINED[node.name]
        if node.name in memory.constants:
            return memory.constants[node.name]
        return _assigned(memory.variables.get(node.name), node.place, node.place.word)
    if isinstance(node, tree.Element):
        index = subscript(node, memory)
        return _assigned(memory.variables.get((node.name, index)), node.place, f"{node.place.word}[{index}]")
    if isinstance(node, tree.System):
        return read(node.name, memory.system)  # type: ignore[arg-type]
    if isinstance(node, tree.PosLiteral):
        configuration = ""
        if len(node.fields) == 7:
            configuration = str(evaluate(node.fields[6], memory))
            check_configuration(configuration, node.fields[6].place)
        return tree.Pos(_coordinates(node.fields[:6], memory), configuration)
    if isinstance(node, tree.JointLiteral):
        return tree.Joints(_coordinates(node.fields, memory))
    if isinstance(node, tree.Unary):
        value = evaluate(node.operand, memory)
        if node.operator == "NOT":
            return not value
        return _in_range(-value if node.operator == "-" else value, node.place)  # type: ignore[operator,arg-type]
    return _binary(node, memory)


def subscript(node: tree.Element, memory: Memory) -> int:
    """The index of an array element, from 1."""
    index = int(evaluate(node.index, memory))  # type: ignore[arg-type]
    if not 1 <= index <= memory.sizes[node.name]:
        size = memory.sizes[node.name]
        raise Pdl2Error(f"the subscript of {node.place.word} is {index}; its elements are 1..{size}", node.index.place)
    return index


def check_configuration(configuration: str, place: TextPosition) -> None:
    """Raises Pdl2Error where a configuration string has other flags than S, E, W, A, B and turns T1:n to T4:n."""
    seen: set[str] = set()
    for flag in configuration.split():
        name = flag.upper().split(":")[0]
        if _FLAG.fullmatch(flag) is None or name in seen:
            raise Pdl2Error(f"{shortened(flag)} is no configuration flag or given twice (S E W T1:n T2:n T3:n)", place)
        seen.add(name)


def _assigned(value: Value | None, place: TextPosition, name: str) -> Value:
    if value is None:
        raise Pdl2Error(f"{name} has no value yet", place)
    return value


def _coordinates(fields: tuple[tree.Expression, ...], memory: Memory) -> tuple[float, ...]:
    return tuple(float(evaluate(field, memory)) for field in fields)  # type: ignore[arg-type]


def _binary(node: tree.Binary, memory: Memory) -> Value:
    left, right = evaluate(node.left, memory), evaluate(node.right, memory)
    if node.operator in ("AND", "OR"):
        return bool(left and right) if node.operator == "AND" else bool(left or right)
    if node.operator in _COMPARISON:
        return bool(_COMPARISON[node.operator](left, right))
    if node.operator in ("/", "DIV", "MOD"):
        return _in_range(_quotient(node, left, right), node.place)  # type: ignore[arg-type]
    return _in_range(_ARITHMETIC[node.operator](left, right), node.place)


def _quotient(node: tree.Binary, left: float, right: float) -> float:
    if right == 0:
        raise Pdl2Error("divides by zero", node.place)
    if node.operator == "/":
        return left / right
    quotient = abs(int(left)) // abs(int(right)) * (1 if (left < 0) == (right < 0) else -1)
    return quotient if node.operator == "DIV" else int(left) - quotient * int(right)


def _in_range(value: int | float, place: TextPosition) -> int | float:
    if isinstance(value, int) and abs(value) > tree.MAX_INTEGER:
        raise Pdl2Error(f"the result is beyond the integers of {tree.MAX_INTEGER}", place)
    if not math.isfinite(value):
        raise Pdl2Error("the result is beyond the numbers", place)
    return value
