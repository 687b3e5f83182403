"""URScript: read by the grammar in urscript.lark and run as a generator of requests to the controller.

What a request gives is sent back into the generator. `None` stands for one turn of a loop, so that a loop without end
can be found.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

from lark import Lark, UnexpectedInput, UnexpectedToken

from fake_controller.ur.law import UrMove

Run = Generator["Request | Go | None", Any, Any]
Node = Any  # a tree of lark, whose children have no types
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "%": operator.mod,
    "==": operator.eq, "!=": operator.ne, "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
    "xor": lambda a, b: bool(a) != bool(b),
}  # fmt: skip
_DEEPEST = 100  # calls within calls


class ScriptError(Exception):
    """A script that cannot be compiled or run further, with its line and column (from 1)."""

    def __init__(self, message: str, line: int, column: int = 1) -> None:
        super().__init__(message)
        self.line, self.column = line, column


class Pose(list[float]):
    """p[x, y, z, rx, ry, rz], which is another type than a list."""


@dataclass
class Request:
    """Something to do for a script, at `line`: `act` is given the controller and the thread that asks.

    `early`: without an answer, and done as the blend begins where a blended move stands before it.
    """

    act: Callable[[Any, Any], Any]
    early: bool = False
    line: int = field(default=0, init=False)


@dataclass
class Go:
    """A move."""

    move: UrMove
    line: int = field(default=0, init=False)


def command(act: Callable[[Any], object]) -> Request:
    """Something to do with the controller, without an answer."""
    return Request(lambda cell, _: act(cell), early=True)


def question(ask: Callable[[], Any]) -> Request:
    """Something whose answer is needed."""
    return Request(lambda *_: ask())


def pause(seconds: float) -> Request:
    """Sleep, at least to the end of the cycle."""
    return Request(lambda cell, thread: cell.sleep(thread, seconds))


class _Scope:
    """Variables and routines of a routine that runs, `depth` calls deep, in those around its definition."""

    def __init__(self, parent: _Scope | None, depth: int) -> None:
        self.values: dict[str, Any] = {}
        self.routines: dict[str, Node] = {}
        self.parent, self.depth = parent, depth

    def owner(self, name: str, of: str = "values") -> _Scope | None:
        scope: _Scope | None = self
        while scope is not None and name not in getattr(scope, of):
            scope = scope.parent
        return scope

    @property
    def outermost(self) -> _Scope:
        return self if self.parent is None else self.parent.outermost


class Script:
    """A compiled script.

    Args:
        text: one `def`, or statements without any.
        functions: what the controller knows, by name.

    Raises:
        ScriptError: not a script, or a call of something that nobody knows.
    """

    def __init__(self, text: str, functions: Mapping[str, Callable[..., Any]]) -> None:
        self._functions = functions
        try:
            tree: Node = _grammar().parse(text)
        except UnexpectedInput as error:
            what = error.token if isinstance(error, UnexpectedToken) else ""
            raise ScriptError(f"compile_error_syntax_error:{what}:", max(error.line, 1), max(error.column, 1)) from None
        (self._main,) = tree.children
        self.name = "unnamed"
        statements = self._main.children
        if len(statements) == 1 and statements[0].data == "routine":
            _, name, *_, self._main = statements[0].children
            self.name = str(name)
        known = {*functions, *(str(routine.children[1]) for routine in tree.find_data("routine"))}
        for call in tree.find_data("call"):
            name = call.children[1]
            if name not in known:
                raise ScriptError(f"compile_error_name_not_found:{name}:", name.line, name.column)

    def run(self) -> Run:
        """The main program."""
        yield from self._block(self._main, _Scope(None, 0))

    # Statements give None, or a word and a value where they leave their block

    def _block(self, block: Node, scope: _Scope) -> Run:
        for statement in block.children:
            outcome = yield from getattr(self, f"_{statement.data}")(statement, scope)
            if outcome is not None:
                return outcome
        return None

    def _routine(self, node: Node, scope: _Scope) -> Run:
        scope.routines[str(node.children[1])] = node
        yield from ()

    def _branch(self, node: Node, scope: _Scope) -> Run:
        *pairs, otherwise = node.children
        for condition, block in zip(pairs[::2], pairs[1::2], strict=True):
            if (yield from self._value(condition, scope)):
                return (yield from self._block(block, scope))
        return None if otherwise is None else (yield from self._block(otherwise, scope))

    def _loop(self, node: Node, scope: _Scope) -> Run:
        condition, block = node.children
        while (yield from self._value(condition, scope)):
            yield None
            outcome = yield from self._block(block, scope)
            if outcome is not None and outcome[0] == "break":
                break
            if outcome is not None and outcome[0] == "return":
                return outcome
        return None

    def _leave(self, node: Node, scope: _Scope) -> Run:
        (value,) = node.children
        return "return", None if value is None else (yield from self._value(value, scope))

    def _jump(self, node: Node, scope: _Scope) -> Run:
        yield from ()
        return str(node.children[0]), None

    def _halt(self, node: Node, scope: _Scope) -> Run:
        yield _at(Request(lambda cell, _: cell.halt()), node)

    def _end_thread(self, node: Node, scope: _Scope) -> Run:
        word, expression = node.children
        handle = yield from self._value(expression, scope)
        while not (yield _at(Request(lambda cell, _: cell.end_thread(handle, kill=word == "kill")), node)):
            yield pause(0.0)

    def _assignment(self, node: Node, scope: _Scope) -> Run:
        where, name, expression = node.children
        value = yield from self._value(expression, scope)
        owner = {"global": scope.outermost, "local": scope}.get(where) or scope.owner(name) or scope
        owner.values[str(name)] = type(value)(value) if isinstance(value, list) else value

    def _item_assignment(self, node: Node, scope: _Scope) -> Run:
        name, index, expression = node.children
        at, value = (yield from self._value(index, scope)), (yield from self._value(expression, scope))
        self._variable(name, scope)[at] = value

    def _action(self, node: Node, scope: _Scope) -> Run:
        yield from self._value(node.children[0], scope)

    def _nothing(self, node: Node, scope: _Scope) -> Run:
        yield from ()

    # Expressions

    def _value(self, node: Node, scope: _Scope) -> Run:
        children = node.children
        match node.data:
            case "number":
                return float(children[0]) if set(children[0]) & set(".eE") else int(children[0])
            case "string":
                return str(children[0])[1:-1]
            case "truth":
                return children[0] == "True"
            case "variable":
                return self._variable(children[0], scope)
            case "call":
                return (yield from self._call(node, scope))
            case "list":
                return (yield from self._values(children[0].children, scope))
        try:
            return (yield from self._computed(node, scope))
        except (LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise ScriptError(f"runtime_error: {error}", node.meta.line, node.meta.column) from None

    def _computed(self, node: Node, scope: _Scope) -> Run:
        if node.data == "index":
            of, items = node.children
            values = yield from self._values(items.children, scope)
            if of.data == "variable" and of.children[0] == "p" and len(values) == 6:
                return Pose(values)
            return (yield from self._value(of, scope))[values[0]]
        if node.data == "unary":
            sign, operand = node.children
            value = yield from self._value(operand, scope)
            return not value if sign == "not" else -value if sign == "-" else value
        left, sign, right = node.children
        first = yield from self._value(left, scope)
        if sign in ("and", "or") and bool(first) == (sign == "or"):
            return bool(first)
        second = yield from self._value(right, scope)
        if sign in ("and", "or"):
            return bool(second)
        if sign in "+-*/%" and isinstance(first, list | str):
            raise TypeError("a number is expected")
        return _OPERATORS[sign](first, second)

    def _values(self, nodes: list[Any], scope: _Scope) -> Run:
        values = []
        for node in nodes:
            values.append((yield from self._value(node, scope)))
        return values

    def _variable(self, name: Any, scope: _Scope) -> Any:
        owner = scope.owner(name)
        if owner is None:
            raise ScriptError(f"runtime_error: the variable {name} has no value", name.line, name.column)
        return owner.values[name]

    def _call(self, node: Node, scope: _Scope) -> Run:
        run, name, *arguments = node.children
        values, named = [], {}
        for argument in filter(None, arguments):
            key, expression = argument.children
            value = yield from self._value(expression, scope)
            if key is None:
                values.append(value)
            else:
                named[str(key)] = value
        owner = scope.owner(name, "routines")
        if owner is not None:
            body = self._called(owner.routines[name], _Scope(owner, scope.depth + 1), values, named, name)
            return (yield _at(Request(lambda cell, _: cell.start_thread(body)), node)) if run else (yield from body)
        try:
            result = self._functions[name](*values, **named)
        except (LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise ScriptError(f"runtime_error: {name}: {error}", name.line, name.column) from None
        return (yield _at(result, node)) if isinstance(result, Request | Go) else result

    def _called(self, routine: Node, scope: _Scope, values: list[Any], named: dict[str, Any], name: Any) -> Run:
        _, _, *parameters, block = routine.children
        parameters = [parameter.children for parameter in parameters if parameter is not None]
        scope.values = {**dict(zip((str(key) for key, _ in parameters), values, strict=False)), **named}
        for key, default in parameters:
            if key not in scope.values and default is not None:
                scope.values[str(key)] = yield from self._value(default, scope)
        if len(scope.values) != len(parameters) or len(values) > len(parameters) or scope.depth > _DEEPEST:
            raise ScriptError(f"runtime_error: {name} cannot be called like that", name.line, name.column)
        outcome = yield from self._block(block, scope)
        return None if outcome is None else outcome[1]


def _at(request: Request | Go, node: Node) -> Request | Go:
    request.line = node.meta.line
    return request


@cache
def _grammar() -> Any:
    text = (files("fake_controller.ur") / "urscript.lark").read_text(encoding="utf-8")
    return Lark(text, parser="lalr", propagate_positions=True, maybe_placeholders=True)
