"""What a program that runs has to begin with, and what none of its statements may be.

A program goes on when nobody is there any more, unless its watchdog is in effect. So the watchdog and the permit to
move are its first statements, and nothing that could run before them, replace them or switch them off is understood.
Every statement is checked, whether it is reached or not: the controller may reach what a reader thinks is not.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import chain

from agent.motion.urscript.statements import HEADER, ScriptLine, UrScriptError, parsed, rows_of

#: Functions that move nothing and say nothing of the moves.
STILL = re.compile(r"popup|rtde_set_watchdog|set_\w*digital_out|stop[jl]|sync|textmsg|write_output_\w+_register")
#: Functions that compute or ask, whose value may be unknown here.
_ASKS = re.compile(
    r"(get|is|read_input|read_output|str|to)_\w+|a?(cos|sin|tan)|atan2|sqrt|d2r|r2d|pose_(trans|inv)|abs|floor|ceil"
)
_TCP, _PAYLOAD = ("set_tcp",), ("set_payload", "set_target_payload")
_MOVES = re.compile(r"move[jlpc]|sleep|set_tcp|set_(target_)?payload")
_WORDS = re.compile(
    "p|True|False|def|thread|sec|while|if|elif|else|end|return|break|continue|halt|run|kill|join|global|local|and|or|not"
    "|xor|pass|enter_critical|exit_critical"
)
_TOKEN = re.compile(
    r"""\s+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])|[A-Za-z_]\w*(?!["'])|"[^"\\]*"(?!\s*")|[=!<>]=|[-+*/%<>=(),:\[\]]""",
    re.ASCII,
)
_FOLDER = re.compile(r'\$ \d+ "[^"]*"(?: "[^"]*")*')  # PolyScope's tree of the program
_OPENS = re.compile(r"(def|thread|sec|while|if|elif|else)\b")
_WATCHDOG = "rtde_set_watchdog"
_REGISTER = "write_output_integer_register"
#: The watchdog's least and highest frequency [Hz]: the driver's, and four times that.
_LEAST, _MOST = 2.0, 8.0
_BEGINS = (
    f'`{_REGISTER}(25, N)`, `{_WATCHDOG}("input_int_register_24", 2, "stop")`, then set_tcp and the payload, '
    f"`while read_input_integer_register(25) != N:`, `sync()`, `end`, `{_REGISTER}(25, 0)`, with a number N of its own"
)


def check_text(text: str, path: str) -> None:
    """A text of tokens that mean the same to this reader and to the controller.

    Raises:
        UrScriptError: names path and line.
    """
    for number, row in enumerate(text.split("\n"), 1):
        if (
            wrong := next((character for character in row if not (character.isprintable() or character == "\t")), None)
        ) is not None:
            raise UrScriptError(f"{path}:{number}: the character {wrong!r} may end a line or hide one; take it out")
    for number, code in rows_of(text):
        end = 0
        while _FOLDER.fullmatch(code) is None and end < len(code):
            if (token := _TOKEN.match(code, end)) is None:
                raise UrScriptError(f"{path}:{number}: `{code[end : end + 20]}` is no statement that is understood")
            end = token.end()
        if _OPENS.match(code) and not code.endswith(":"):
            raise UrScriptError(f"{path}:{number}: `{code[:60]}`: a `:` is expected at the end of the line")
        if re.match(r"end\b", code) and code != "end":
            raise UrScriptError(f"{path}:{number}: `{code[:60]}`: `end` stands in a line of its own")


def check_margin(text: str, path: str) -> None:
    """The first line and the last one begin at the left edge, and no other: there the controller ends a program.

    Raises:
        UrScriptError: names path and line.
    """
    rows, source = rows_of(text), text.split("\n")
    at_margin = [number for number, _ in rows if not source[number - 1].startswith((" ", "\t"))]
    if at_margin != (edges := [rows[0][0], rows[-1][0]]):
        raise UrScriptError(
            f"{path}:{min(set(at_margin) ^ set(edges))}: `def NAME():` and the last `end` begin at the left edge, and "
            "no line between them does: the controller takes the program for ended there"
        )


def check_statements(lines: list[ScriptLine], path: str) -> None:
    """Every statement is one that is understood, whether it is reached or not.

    Raises:
        UrScriptError: names path and line.
    """
    defined = [line for line in _all(lines) if line.word == "def"]
    routines = {header[1] for line in defined if (header := HEADER.match(line.text))}
    if len(routines) < len(defined):
        raise UrScriptError(f"{path}:{defined[-1].number}: each function needs a name of its own")
    for line in _all(lines):
        try:
            _check(line, routines)
        except ValueError as error:
            raise UrScriptError(f"{path}:{line.number}: `{line.text[:60]}`: {error}") from None


def check_preamble(lines: list[ScriptLine], path: str) -> None:
    """The watchdog and the permit are the first statements, once, and nothing later touches them.

    Raises:
        UrScriptError: they are not; names path and line.
    """
    at = 0

    def take(text: str) -> bool:
        nonlocal at
        matches = (
            at < len(lines) and lines[at].word == "do" and ast.dump(parsed(lines[at].text)) == ast.dump(parsed(text))
        )
        at += matches
        return matches

    number = _literal(lines[0], _REGISTER, 1) if lines else None
    has_start = isinstance(number, int) and 0 < number < 2**31 and take(f"{_REGISTER}(25, {number})")
    take(f"{_REGISTER}(24, -1)")
    frequency = _literal(lines[at], _WATCHDOG, 1) if has_start and at < len(lines) else None
    watched = (
        isinstance(frequency, int | float)
        and _LEAST <= frequency <= _MOST
        and take(f'{_WATCHDOG}("input_int_register_24", {frequency}, "stop")')
    )
    for names in (_TCP, _PAYLOAD):
        at += watched and at < len(lines) and _called(lines[at]) in names
    permit = lines[at] if at < len(lines) else None
    waits_first = (
        watched
        and permit is not None
        and permit.word == "while"
        and ast.dump(parsed(permit.text)) == ast.dump(parsed(f"read_input_integer_register(25) != {number}"))
        and [(entry.word, entry.text) for entry in permit.block] == [("do", "sync()")]
    )
    at += 1
    if not (waits_first and take(f"{_REGISTER}(25, 0)")):
        wrong = lines[min(at, len(lines) - 1)].number if lines else 1
        raise UrScriptError(
            f"{path}:{wrong}: the program would move on when nobody is there any more, or without a permit: its first "
            f"statements have to be {_BEGINS}"
        )
    for line in _all(lines[at:]):
        if _called(line) == _WATCHDOG:
            raise UrScriptError(f"{path}:{line.number}: the watchdog is set once, in the first statements")
        if _called(line) in (*_TCP, *_PAYLOAD):
            raise UrScriptError(
                f"{path}:{line.number}: TCP and payload are set once, in the first statements: with another payload "
                "than it carries the arm sags or jumps"
            )
        if _called(line) == _REGISTER and _literal(line, _REGISTER, 0) in (None, 25):
            raise UrScriptError(f"{path}:{line.number}: output register 25 belongs to the driver; write another one")


def waits(line: ScriptLine) -> bool:
    """Whether the body of a loop does nothing but wait."""
    return all(called.word == "do" and re.fullmatch(f"{STILL.pattern}|sleep", _called(called)) for called in line.block)


def _all(lines: list[ScriptLine]) -> Iterator[ScriptLine]:
    for line in lines:
        yield line
        yield from _all(line.block)
        yield from _all(line.otherwise)


def _check(line: ScriptLine, routines: set[str]) -> None:
    """Raises:
    ValueError: what is not understood.
    """
    if line.word in ("thread", "sec"):
        raise ValueError("what runs beside the program is not understood")
    if line.word == "def":
        header = HEADER.match(line.text)
        if header is None:
            raise ValueError("a function needs a name and parentheses")
        parameters = [argument.partition("=") for argument in header[2].split(",")] if header[2].strip() else []
        for name in (header[1], *(argument[0].strip() for argument in parameters)):
            _check_name(name)
        for argument in parameters:
            _check_expression(parsed(argument[2] or "0"))
    elif line.word.startswith("set "):
        if line.word[4:] in routines:
            raise ValueError(f"{line.word[4:]} is the name of a function")
        _check_name(line.word[4:])
        _check_expression(parsed(line.text))
    elif line.word in ("while", "if"):
        _check_expression(parsed(line.text))
    else:
        tree = parsed(line.text)
        if not (isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name)):
            raise ValueError("is no statement that is understood")
        name = tree.func.id
        if not (STILL.fullmatch(name) or _MOVES.fullmatch(name) or name in routines):
            raise ValueError(f"the function {name} is not understood")
        for value in _arguments(tree):
            _check_expression(value)


def _check_name(name: str) -> None:
    known = any(pattern.fullmatch(name) for pattern in (STILL, _ASKS, _MOVES, _WORDS))
    if known or not re.fullmatch(r"[A-Za-z_]\w*", name):
        raise ValueError(f"{name} means something else already; choose another name")


def _check_expression(tree: ast.expr) -> None:
    """Nothing in an expression acts: it consists of values, and of functions that compute or ask."""
    match tree:
        case ast.Constant(value=bool() | int() | float() | str()) | ast.Name():
            return
        case ast.List(elts=parts) | ast.BoolOp(values=parts):
            inner = parts
        case ast.Subscript(value=value, slice=index):
            inner = [value, *(index.elts if isinstance(index, ast.Tuple) else [index])]
        case ast.UnaryOp(operand=operand):
            inner = [operand]
        case ast.BinOp(left=left, right=right) | ast.Compare(left=left, ops=[_], comparators=[right]):
            inner = [left, right]
        case ast.Call(func=ast.Name(id=name)) if _ASKS.fullmatch(name):
            inner = _arguments(tree)
        case ast.Call(func=ast.Name(id=name)):
            raise ValueError(f"the function {name} is not understood within an expression")
        case _:
            raise ValueError("is no expression that is understood")
    for part in inner:
        _check_expression(part)


def _arguments(call: ast.Call) -> list[ast.expr]:
    return list(chain(call.args, (keyword.value for keyword in call.keywords)))


def _called(line: ScriptLine) -> str:
    """The function that a statement calls; empty if it is no call."""
    tree = parsed(line.text) if line.word == "do" else None
    return tree.func.id if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) else ""


def _literal(line: ScriptLine, name: str, index: int) -> object:
    """The number that stands as an argument of a call of `name`; None if there is none."""
    tree = parsed(line.text) if _called(line) == name else None
    if not (isinstance(tree, ast.Call) and len(tree.args) > index and isinstance(tree.args[index], ast.Constant)):
        return None
    return tree.args[index].value  # type: ignore[attr-defined]
