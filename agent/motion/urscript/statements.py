"""URScript text to nested statements.

An expression of URScript is one of Python too, poses (`p[…]`) included, so Python's own parser reads it; nothing is
executed. Blocks end with `end`.
"""

from __future__ import annotations

import ast
import re
from collections import deque
from dataclasses import dataclass, field
from functools import lru_cache

from agent.core import InputError

_OPENS = re.compile(r"(def|thread|sec|while|if)\b\s*(.*?)\s*:?$")
_BRANCH = re.compile(r"(elif|else)\b\s*(.*?)\s*:?$")
_CLOSES = re.compile(r"(end|elif|else)\b")
_ASSIGNMENT = re.compile(r"(?:(global|local)\s+)?(\w+)\s*=(?!=)\s*(.+)$")
_COMMENT = re.compile(r"""("[^"]*")|#.*""")
#: Name and parameters of a routine.
HEADER = re.compile(r"(\w+)\s*\((.*)\)$")
#: Blocks and calls within each other, and parts of an expression.
DEEPEST = 50


class UrScriptError(InputError):
    """A text that is not the motion subset of URScript; names path and line."""


@dataclass
class ScriptLine:
    """One statement: its `word` (a block's, `set NAME`, `do`), text and line number, and the lines in its block.

    `scope` is what an assignment says of its variable: `global`, `local`, or nothing.
    """

    word: str
    text: str
    number: int
    block: list[ScriptLine] = field(default_factory=list)
    otherwise: list[ScriptLine] = field(default_factory=list)
    scope: str = ""


def rows_of(text: str) -> list[tuple[int, str]]:
    """Line numbers and code of a text, without comments, empty lines and indentation.

    Lines end with a line feed, as they do for the controller: other characters that Python counts as ends do not count.
    """
    return [
        (number, stripped)
        for number, row in enumerate(text.split("\n"), 1)
        if (stripped := _COMMENT.sub(lambda match: match[1] or "", row).strip())
    ]


def nested(rows: deque[tuple[int, str]], path: str, depth: int = 0) -> list[ScriptLine]:
    """Statements up to a row that ends a block; takes their rows away.

    Raises:
        UrScriptError: a block without an end, or too many within each other.
    """
    lines: list[ScriptLine] = []
    if depth > DEEPEST:
        raise UrScriptError(f"{path}:{rows[0][0]}: more than {DEEPEST} blocks within each other")
    while rows and not _CLOSES.match(rows[0][1]):
        number, text = rows[0]
        opens, assigned = _OPENS.match(text), _ASSIGNMENT.match(text)
        if opens is None:
            if assigned:
                lines.append(ScriptLine(f"set {assigned[2]}", assigned[3], number, scope=assigned[1] or ""))
            else:
                lines.append(ScriptLine("do", text, number))
            rows.popleft()
            continue
        line = last = ScriptLine(opens[1], opens[2], number)
        rows.popleft()
        line.block = nested(rows, path, depth + 1)
        branches = line.word == "if"
        while rows and branches and (branch := _BRANCH.match(rows[0][1])):
            other = ScriptLine("if", branch[2] or "True", rows.popleft()[0])
            other.block = nested(rows, path, depth + 1)
            last.otherwise, last, branches = [other], other, branch[1] == "elif"
        if not rows or _BRANCH.match(rows[0][1]):
            raise UrScriptError(f"{path}:{number}: `{text}` has no `end`")
        lines.append(line)
        rows.popleft()
    return lines


@lru_cache(maxsize=4096)
def parsed(text: str) -> ast.expr:
    """The tree of one expression.

    Raises:
        ValueError: not one, or one of too many parts within each other.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ValueError("is no statement that is understood") from None
    level: list[ast.AST] = [tree]
    for _ in range(DEEPEST):
        level = [part for node in level for part in ast.iter_child_nodes(node)]
    if level:
        raise ValueError(f"more than {DEEPEST} parts of an expression within each other")
    return tree
