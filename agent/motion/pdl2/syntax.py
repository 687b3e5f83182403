"""Text to syntax tree, by the grammar in grammar.lark. The parser generator is imported when a program is read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from agent.core import InputError

if TYPE_CHECKING:
    from lark import Lark, Token, UnexpectedToken

#: Longer programs are refused unread.
MAX_CHARACTERS = 1_000_000
MAX_NAME, MAX_REAL = 32, 64
#: Deeper expressions and blocks are refused: reading and running them would recurse that deep.
MAX_EXPRESSION_DEPTH, MAX_BLOCK_DEPTH = 100, 32
#: INTEGER has 32 bits.
MAX_INTEGER = 2**31 - 1

#: Words of PDL2 outside the motion subset; a message names them as such.
OUTSIDE_SUBSET = re.compile(
    r"""ABORT|ABOUT|ACTIVATE|ALONG|AND|ARM|ATTACH|AUX|AWAY|BREAK|BY|BYPASS|CALL|CANCEL|CASE|CLOSE|CONDITION|CONNECT
    |DEACTIVATE|DECODE|DETACH|DISABLE|DISCONNECT|ELSE|ELSIF|ENABLE|ENCODE|ENDCONDITION|ENDIF|ENDNODE|ENDRECORD|ENDSELECT|ENDTRY
    |ENDWHILE|ERROR|EVENT|EXECS|EXIT|EXPORTED|FROM|GOTO|HALT|HAND|IF|IMPORT|LOCK|NEAR|NODE|NOT|OPEN|OR|PATH|PAUSE|PULSE|PURGE
    |READ|RECORD|RELATIVE|RELAX|REPEAT|RESUME|RETURN|ROUTINE|SEGMENT|SELECT|SEMAPHORE|SIGNAL|SYNCMOVE|SYNCMOVEFLY|THEN|TIL
    |TIME|TRY|UNLOCK|UNPAUSE|UNTIL|VECTOR|WAIT|WHEN|WHILE|WRITE|XOR|XTNDPOS""",
    re.VERBOSE | re.IGNORECASE,
)
_OUTSIDE = "is a word of PDL2, but not of the motion subset read here"
#: What may stand before a statement or a declaration on its line.
_OPENING = {"BEGIN", "CYCLE", "DO", "CONST", "TYPE", "VAR"}
_LINE_END = re.compile(r"\r\n?")
_LAST_WORD = re.compile(r"(\w+)$")


class TextPosition(NamedTuple):
    """Position of a word in a program: line and column count from 1."""

    line: int
    column: int
    word: str


class Pdl2Error(InputError):
    """A program that cannot be read or run: `line`, `column` (from 1) and `word` say where, `reason` says why."""

    def __init__(self, reason: str, position: TextPosition, path: str = ""):
        self.reason = reason
        self.position = position
        self.line, self.column, self.word = position
        where = f"{path or 'program'}:{position.line}:{position.column}"
        super().__init__(f"{where}: {shortened(position.word)}: {reason}" if position.word else f"{where}: {reason}")

    def within(self, path: str) -> Pdl2Error:
        """The same error, naming the file."""
        return type(self)(self.reason, self.position, path)


def shortened(word: str) -> str:
    """A word quoted for a message, cut where it is long."""
    return repr(word if len(word) <= 40 else word[:37] + "...")


class Constant(NamedTuple):
    """A predefined constant such as FLY_CART, by its name in capitals."""

    name: str


@dataclass(frozen=True)
class Pos:
    """The value of a POS: x, y, z [mm], a, e, r [deg] and the configuration string."""

    fields: tuple[float, ...]
    configuration: str


@dataclass(frozen=True)
class Joints:
    """The value of a JOINTPOS: degrees (mm on a prismatic joint)."""

    fields: tuple[float, ...]


@dataclass(frozen=True)
class Node:
    """A piece of the text, by the word that begins or names it. PDL2 ignores the case of letters: `name` is in small
    ones."""

    word: Token

    @property
    def position(self) -> TextPosition:
        return position_of(self.word)

    @property
    def name(self) -> str:
        return self.word.lower()


@dataclass(frozen=True)
class Nested(Node):
    """An expression or a statement, which may contain others: no deeper than `most`, as reading and running recurse."""

    most: ClassVar[int]
    too_deep: ClassVar[str]

    def __post_init__(self) -> None:
        inner = [part for part in self.parts() if part.most == self.most]
        depth = 1 + max((vars(part)["depth"] for part in inner), default=0)
        if depth > self.most:
            raise Pdl2Error(f"{self.too_deep} {self.most}", self.position)
        self.__dict__["depth"] = depth

    def parts(self) -> list[Nested]:
        """Expressions and statements directly inside this one."""
        values = (value if isinstance(value, tuple) else (value,) for value in vars(self).values())
        return [part for value in values for part in value if isinstance(part, Nested)]


@dataclass(frozen=True)
class Expression(Nested):
    """An expression."""

    most = MAX_EXPRESSION_DEPTH
    too_deep = "an expression is nested deeper than"


@dataclass(frozen=True)
class StatementNode(Nested):
    """A statement."""

    most = MAX_BLOCK_DEPTH
    too_deep = "FOR is nested deeper than"


Block = tuple[StatementNode, ...]


@dataclass(frozen=True)
class Literal(Expression):
    value: int | float | str


@dataclass(frozen=True)
class Name(Expression):
    """A variable, a constant of the program or a predefined constant."""


@dataclass(frozen=True)
class Element(Expression):
    """One element of an array."""

    index: Expression


@dataclass(frozen=True)
class System(Expression):
    """A system variable; its name is in capitals, without the arm that published programs put before it."""

    @property
    def name(self) -> str:
        return self.word.upper().replace("$ARM_DATA[1].", "$")


@dataclass(frozen=True)
class Operation(Expression):
    """An operator in capitals with one operand or two."""

    operator: str
    operands: tuple[Expression, ...]


@dataclass(frozen=True)
class PosLiteral(Expression):
    fields: tuple[Expression, ...]


@dataclass(frozen=True)
class JointLiteral(Expression):
    fields: tuple[Expression, ...]


@dataclass(frozen=True)
class Assignment(StatementNode):
    target: Name | Element | System
    value: Expression


@dataclass(frozen=True)
class Setting(System):
    """`$NAME = value` of a WITH clause."""

    value: Expression


@dataclass(frozen=True)
class MoveStatement(StatementNode):
    """`trajectory` is LINEAR, JOINT, CIRCULAR or empty, where `$MOVE_TYPE` says."""

    trajectory: str
    target: Expression
    via: Expression | None
    settings: tuple[Setting, ...]

    @property
    def fly(self) -> bool:
        return self.name == "movefly"


@dataclass(frozen=True)
class DelayStatement(StatementNode):
    milliseconds: Expression


@dataclass(frozen=True)
class ForLoop(StatementNode):
    variable: Name
    first: Expression
    down: bool
    last: Expression
    step: Expression | None
    block: Block


@dataclass(frozen=True)
class NamedType(Node):
    """A data type, or `size` of them where it is an array."""

    size: Expression | None = None


@dataclass(frozen=True)
class Declaration(Node):
    """One line of a section. `words` are the names it declares: a constant has a value and no type, a data type of the
    program's own a type, and variables a type and perhaps an initial value."""

    section: str
    words: tuple[Token, ...]
    type: NamedType | None = None
    value: Expression | None = None


@dataclass(frozen=True)
class Attribute(Node):
    value: Literal | None


@dataclass(frozen=True)
class ProgramTree(Node):
    """A whole program as it was written; `end` is the name after END."""

    attributes: tuple[Attribute, ...]
    declarations: tuple[Declaration, ...]
    cycle: bool
    block: Block
    end: Token


def parse_tree(text: str) -> ProgramTree:
    """The syntax tree of a program.

    Raises:
        Pdl2Error: where the text is too long, or not a program of the motion subset.
    """
    from lark import UnexpectedCharacters, UnexpectedToken

    if len(text) > MAX_CHARACTERS:
        raise Pdl2Error(f"the program has {len(text)} characters; {MAX_CHARACTERS} are allowed", TextPosition(1, 1, ""))
    text = _LINE_END.sub("\n", text.removeprefix("\ufeff"))
    try:
        program: ProgramTree = _lark().parse(text)  # type: ignore[assignment]  # what the rules make of it
    except UnexpectedToken as error:
        raise _unexpected_token(error) from None
    except UnexpectedCharacters as error:
        reason = "the string is not closed on its line" if error.char == "'" else "this character has no meaning here"
        raise Pdl2Error(reason, TextPosition(error.line, error.column, error.char)) from None
    _check_lines(program, text.split("\n"))
    return program


def position_of(token: Token) -> TextPosition:
    """Where a token stands."""
    return TextPosition(token.line or 0, token.column or 0, str(token))


def _check_lines(program: ProgramTree, lines: list[str]) -> None:
    """One statement or declaration a line, or separated by a semicolon."""
    positions = [declaration.position for declaration in program.declarations]
    pending: list[Nested] = list(program.block)
    while pending:
        node = pending.pop()
        positions.append(node.position)
        pending += [part for part in node.parts() if isinstance(part, StatementNode)]
    for position in sorted(positions):
        before = lines[position.line - 1][: position.column - 1].rstrip()
        word = _LAST_WORD.search(before)
        if before and not before.endswith(";") and (word is None or word[1].upper() not in _OPENING):
            raise Pdl2Error("starts on a line of its own, or after a semicolon", position)


@cache
def _lark() -> Lark:
    from lark import Lark

    def called(make: Callable[..., Any]) -> Callable[[list[Any]], Any]:
        return lambda children: make(*children)

    return Lark(
        (files("agent.motion.pdl2") / "grammar.lark").read_text(encoding="utf-8"),
        parser="lalr",
        lexer="basic",  # a contextual lexer would take a reserved word for a name wherever only a name is possible
        start="program",
        maybe_placeholders=False,
        g_regex_flags=re.ASCII,
        # Called by the parser as rules are completed, so deep nesting costs no recursion.
        transformer=SimpleNamespace(**{rule: called(make) for rule, make in _RULES.items()}),
        lexer_callbacks={"NAME": _check_name},
    )


def _check_name(token: Token) -> Token:
    if OUTSIDE_SUBSET.fullmatch(token):
        raise Pdl2Error(_OUTSIDE, position_of(token))
    if len(token) > MAX_NAME:
        raise Pdl2Error(f"the name is longer than {MAX_NAME} characters", position_of(token))
    return token


def _unexpected_token(error: UnexpectedToken) -> Pdl2Error:
    token = error.token
    before: Any = error.state.value_stack[-1] if error.state and error.state.value_stack else None
    if getattr(before, "type", "") == "NAME" and {"_ASSIGN", "_LSQB"} >= set(error.expected):
        return Pdl2Error("is not a statement of the motion subset read here", position_of(before))
    if token.type == "$END":
        last = TextPosition(max(token.line or 1, 1), max(token.column or 1, 1), "")
        return Pdl2Error(f"the program ends too early; {_expected(error.expected)}", last)
    if OUTSIDE_SUBSET.fullmatch(token):
        return Pdl2Error(_OUTSIDE, position_of(token))
    return Pdl2Error(f"does not belong here; {_expected(error.expected)}", position_of(token))


def _expected(terminals: Iterable[str]) -> str:
    patterns = {name: str(_lark().get_terminal(name).pattern.value) for name in terminals if name not in _WORDS}
    words = sorted({_WORDS.get(name) or shortened(patterns[name]) for name in terminals})
    if len(words) > 12:
        words = [*words[:11], "…"]
    return f"expected: {' '.join(words)}"


_WORDS = {
    "NAME": "a name",
    "SYSTEM_VARIABLE": "a system variable",
    "INTEGER_LITERAL": "a number",
    "REAL_LITERAL": "a number",
    "STRING_LITERAL": "a string",
    "OPERATOR": "* or /",
    "SIGN": "+ or -",
    "$END": "the end of the text",
}


def _integer(word: Token) -> Literal:
    if len(word) > 10 or int(word) > MAX_INTEGER:
        raise Pdl2Error(f"the integer is larger than {MAX_INTEGER}", position_of(word))
    return Literal(word, int(word))


def _real(word: Token) -> Literal:
    value = float(word) if len(word) <= MAX_REAL else float("inf")
    if value == float("inf"):
        raise Pdl2Error("the number is too large or too long", position_of(word))
    return Literal(word, value)


def _for_arm(*words: Token) -> None:
    if words and int(words[-1]) != 1:
        raise Pdl2Error("is another arm; programs of arm 1 are read here", position_of(words[-1]))


def _program(name: Token, attributes: tuple[Attribute, ...], *parts: Any) -> ProgramTree:
    *sections, (cycle, block, end) = parts
    return ProgramTree(name, attributes, tuple(entry for section in sections for entry in section), cycle, block, end)


def _move(word: Token, trajectory: str, _to: Token, target: Expression, clauses: list[Any]) -> MoveStatement:
    """Clauses are collected from the last to the first: settings, a VIA as an expression, an ADVANCE as its word."""
    settings = tuple(clause for clause in reversed(clauses) if isinstance(clause, Setting))
    advances = [position_of(clause) for clause in clauses if not isinstance(clause, Node)]
    vias: list[Any] = [clause for clause in clauses if isinstance(clause, Node) and not isinstance(clause, Setting)]
    if len(vias) > 1:
        raise Pdl2Error("VIA is given twice in this move", vias[0].position)
    if len(advances) > 1:
        raise Pdl2Error("ADVANCE is given twice in this move", advances[0])
    return MoveStatement(word, trajectory, target, vias[0] if vias else None, settings)


def _with(clause: Any, clauses: list[Any]) -> list[Any]:
    clauses.append(clause)
    return clauses


def _all(*items: Any) -> tuple[Any, ...]:
    return items


def _optional(item: Any = None) -> Any:
    return item


#: What each rule of the grammar makes of its words and of what its parts have made.
_RULES: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(("attributes", "section", "names", "block"), _all),
    **dict.fromkeys(("initial", "step"), _optional),
    "program": _program,
    "attribute": lambda word, value=None: Attribute(word, None if value is None else _integer(value)),
    "constant": lambda word, value: Declaration(word, "CONST", (word,), None, value),
    "alias": lambda word, named: Declaration(word, "TYPE", (word,), named),
    "variables": lambda words, named, initial: Declaration(words[0], "VAR", words, named, initial),
    "named_type": lambda word, _arm: NamedType(word),
    "array_type": lambda _array, size, word, _arm: NamedType(word, size),
    "for_arm": _for_arm,
    "body": lambda _begin, *parts: (len(parts) == 4, parts[-3], parts[-1]),
    "assignment": lambda target, value: Assignment(target.word, target, value),
    "for_loop": lambda word, variable, *parts: ForLoop(word, Name(variable), *parts),
    "direction": lambda word: word.upper() == "DOWNTO",
    "delay": DelayStatement,
    "move": _move,
    "trajectory": lambda word="": word.upper(),
    "tail_end": list,
    "via": lambda _via, target, clauses: _with(target, clauses),
    "advance": _with,
    "with_setting": _with,
    "setting": Setting,
    "binary": lambda left, word, right: Operation(word, word.upper(), (left, right)),
    "unary": lambda word, operand: Operation(word, word.upper(), (operand,)),
    "integer": _integer,
    "real": _real,
    "string": lambda word: Literal(word, word[1:-1].replace("''", "'")),
    "name": Name,
    "element": Element,
    "system": System,
    "pos": lambda word, *fields: PosLiteral(word, fields),
    "joints": lambda word, *fields: JointLiteral(word, fields),
}
