"""Text to syntax tree, by the grammar in grammar.lark."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import Any

from lark import Lark, Token, Transformer, UnexpectedCharacters, UnexpectedToken, v_args

from agent.motion.pdl2 import tree
from agent.motion.pdl2.errors import Pdl2Error, TextPosition, shortened

#: Longer programs are refused unread.
MAX_CHARACTERS = 1_000_000
MAX_NAME = 32
MAX_REAL = 64

#: Words of PDL2 that the motion subset leaves out; known by name so that the message can say so.
OUTSIDE_SUBSET = re.compile(
    r"""ABORT|ABOUT|ACTIVATE|ALONG|ARM|ATTACH|AUX|AWAY|BREAK|BY|BYPASS|CALL|CANCEL|CASE|CLOSE|CONDITION|CONNECT
    |DEACTIVATE|DECODE|DETACH|DISABLE|DISCONNECT|ELSIF|ENABLE|ENCODE|ENDCONDITION|ENDNODE|ENDRECORD|ENDSELECT|ENDTRY
    |ENDWHILE|ERROR|EVENT|EXECS|EXIT|EXPORTED|FROM|GOTO|HALT|HAND|IMPORT|LOCK|NEAR|NODE|OPEN|PATH|PAUSE|PULSE|PURGE
    |READ|RECORD|RELATIVE|RELAX|REPEAT|RESUME|RETURN|ROUTINE|SEGMENT|SELECT|SEMAPHORE|SIGNAL|SYNCMOVE|SYNCMOVEFLY|TIL
    |TIME|TRY|UNLOCK|UNPAUSE|UNTIL|VECTOR|WAIT|WHEN|WHILE|WRITE|XOR|XTNDPOS""",
    re.VERBOSE | re.IGNORECASE,
)

_OUTSIDE = "is a word of PDL2, but not of the motion subset read here"

#: What may stand before a statement or a declaration on its line.
_OPENING = {"BEGIN", "CYCLE", "DO", "THEN", "ELSE", "CONST", "TYPE", "VAR"}
_LINE_END = re.compile(r"\r\n?")
_LAST_WORD = re.compile(r"(\w+)$")


def parse_tree(text: str) -> tree.ProgramTree:
    """The syntax tree of a program.

    Raises:
        Pdl2Error: where the text is too long, or not a program of the motion subset.
    """
    if len(text) > MAX_CHARACTERS:
        raise Pdl2Error(f"the program has {len(text)} characters; {MAX_CHARACTERS} are allowed", TextPosition(1, 1, ""))
    text = _LINE_END.sub("\n", text.removeprefix("\ufeff"))
    try:
        program: tree.ProgramTree = _lark().parse(text)  # type: ignore[assignment]  # what _TreeBuilder makes of it
    except UnexpectedToken as error:
        raise _unexpected_token(error) from None
    except UnexpectedCharacters as error:
        place = TextPosition(error.line, error.column, error.char)
        if error.char == "'":
            raise Pdl2Error("the string is not closed on its line", place) from None
        raise Pdl2Error("this character has no meaning here", place) from None
    tree.check_block_depth(program)
    _check_lines(program, text.split("\n"))
    return program


def place_of(token: Token) -> TextPosition:
    """Where a token stands."""
    return TextPosition(token.line or 0, token.column or 0, str(token))


def _check_lines(program: tree.ProgramTree, lines: list[str]) -> None:
    """One statement or declaration a line, or separated by a semicolon."""
    pending: list[tree.StatementNode] = list(program.block)
    places = [declaration.place for declaration in program.declarations]
    while pending:
        node = pending.pop()
        places.append(node.place)
        if isinstance(node, tree.ForLoop):
            pending += node.block
        elif isinstance(node, tree.Conditional):
            pending += node.then + node.otherwise
    for place in sorted(places):
        before = lines[place.line - 1][: place.column - 1].rstrip()
        word = _LAST_WORD.search(before)
        if before and not before.endswith(";") and (word is None or word[1].upper() not in _OPENING):
            raise Pdl2Error("starts on a line of its own, or after a semicolon", place)


@cache
def _lark() -> Lark:
    return Lark(
        (files("agent.motion.pdl2") / "grammar.lark").read_text(encoding="utf-8"),
        parser="lalr",
        lexer="basic",  # a contextual lexer would take a reserved word for a name wherever only a name is possible
        start="program",
        maybe_placeholders=False,
        g_regex_flags=re.ASCII,
        transformer=_TreeBuilder(),
        lexer_callbacks={"NAME": _check_name},
    )


def _check_name(token: Token) -> Token:
    if OUTSIDE_SUBSET.fullmatch(token):
        raise Pdl2Error(_OUTSIDE, place_of(token))
    if len(token) > MAX_NAME:
        raise Pdl2Error(f"the name is longer than {MAX_NAME} characters", place_of(token))
    return token


def _unexpected_token(error: UnexpectedToken) -> Pdl2Error:
    token = error.token
    before = error.state.value_stack[-1] if error.state and error.state.value_stack else None
    if isinstance(before, Token) and before.type == "NAME" and {"_ASSIGN", "_LSQB"} >= set(error.expected):
        return Pdl2Error("is not a statement of the motion subset read here", place_of(before))
    if token.type == "$END":
        last = TextPosition(max(token.line or 1, 1), max(token.column or 1, 1), "")
        return Pdl2Error(f"the program ends too early; {_expected(error)}", last)
    if OUTSIDE_SUBSET.fullmatch(token):
        return Pdl2Error(_OUTSIDE, place_of(token))
    return Pdl2Error(f"does not belong here; {_expected(error)}", place_of(token))


def _expected(error: UnexpectedToken) -> str:
    words = sorted({_WORDS.get(name) or shortened(_literal(name)) for name in error.expected})
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
    "COMPARISON": "< or >",
    "SIGN": "+ or -",
    "$END": "the end of the text",
}


def _literal(terminal: str) -> str:
    return str(_lark().get_terminal(terminal).pattern.value)


def _number(token: Token) -> int:
    if len(token) > 10 or int(token) > tree.MAX_INTEGER:
        raise Pdl2Error(f"the integer is larger than {tree.MAX_INTEGER}", place_of(token))
    return int(token)


def _system_name(token: Token) -> str:
    """In capitals; a field of the arm's data by the short name that a program of this arm has for it."""
    return token.upper().replace("$ARM_DATA[1].", "$")


#: What may follow the target of a move: its VIA, an ADVANCE (where it stands), a WITH.
_Clause = tree.Expression | TextPosition | tree.Setting


@v_args(inline=True)
class _TreeBuilder(Transformer[Token, tree.ProgramTree]):
    """Called by the parser as rules are completed, so deep nesting costs no recursion."""

    def program(self, name: Token, attributes: tuple[tree.Attribute, ...], *rest: Any) -> tree.ProgramTree:
        *sections, (cycle, block, end) = rest
        return tree.ProgramTree(
            place=place_of(name),
            name=str(name),
            attributes=attributes,
            declarations=tuple(declaration for section in sections for declaration in section),
            cycle=cycle,
            block=block,
            end=end,
        )

    def attributes(self, *items: tree.Attribute) -> tuple[tree.Attribute, ...]:
        return items

    def attribute(self, name: Token, value: Token | None = None) -> tree.Attribute:
        literal = None if value is None else tree.Literal(place_of(value), _number(value))
        return tree.Attribute(place_of(name), name.upper(), literal)

    def section(self, *declarations: tree.Declaration) -> tuple[tree.Declaration, ...]:
        return declarations

    def constant(self, name: Token, value: tree.Expression) -> tree.ConstantDeclaration:
        return tree.ConstantDeclaration(place_of(name), name.lower(), value)

    def alias(self, name: Token, type_: tree.NamedType) -> tree.TypeDeclaration:
        return tree.TypeDeclaration(place_of(name), name.lower(), type_)

    def variables(
        self, names: tuple[TextPosition, ...], type_: tree.NamedType, initial: tree.Expression | None
    ) -> tree.VariableDeclaration:
        return tree.VariableDeclaration(names[0], names, type_, initial)

    def names(self, *names: Token) -> tuple[TextPosition, ...]:
        return tuple(place_of(name) for name in names)

    def initial(self, value: tree.Expression | None = None) -> tree.Expression | None:
        return value

    def named_type(self, name: Token, _arm: bool) -> tree.NamedType:
        return tree.NamedType(place_of(name), name.lower())

    def array_type(self, _array: Token, size: tree.Expression, name: Token, _arm: bool) -> tree.NamedType:
        return tree.NamedType(place_of(name), name.lower(), size)

    def for_arm(self, *words: Token) -> bool:
        if words and int(words[-1]) != 1:
            raise Pdl2Error("is another arm; programs of arm 1 are read here", place_of(words[-1]))
        return bool(words)

    def body(self, _begin: Token, *rest: Any) -> tuple[bool, tree.Block, TextPosition]:
        *cycle, block, _end, name = rest
        return bool(cycle), block, place_of(name)

    def block(self, *statements: tree.StatementNode) -> tree.Block:
        return statements

    def assignment(self, target: tree.Target, value: tree.Expression) -> tree.Assignment:
        return tree.Assignment(target.place, target, value)

    def for_loop(
        self,
        keyword: Token,
        variable: Token,
        first: tree.Expression,
        direction: str,
        last: tree.Expression,
        step: tree.Expression | None,
        block: tree.Block,
    ) -> tree.ForLoop:
        name = tree.Name(place_of(variable), variable.lower())
        return tree.ForLoop(place_of(keyword), name, first, last, step, direction == "DOWNTO", block)

    def direction(self, token: Token) -> str:
        return token.upper()

    def step(self, value: tree.Expression | None = None) -> tree.Expression | None:
        return value

    def conditional(
        self, keyword: Token, condition: tree.Expression, then: tree.Block, otherwise: tree.Block = ()
    ) -> tree.Conditional:
        return tree.Conditional(place_of(keyword), condition, then, otherwise)

    def delay(self, keyword: Token, value: tree.Expression) -> tree.DelayStatement:
        return tree.DelayStatement(place_of(keyword), value)

    def move(
        self, keyword: Token, trajectory: str, _to: Token, target: tree.Expression, clauses: list[_Clause]
    ) -> tree.MoveStatement:
        vias = [clause for clause in clauses if not isinstance(clause, TextPosition | tree.Setting)]
        advances = [clause for clause in clauses if isinstance(clause, TextPosition)]
        if len(vias) > 1:
            raise Pdl2Error("VIA is given twice in this move", vias[0].place)
        if len(advances) > 1:
            raise Pdl2Error("ADVANCE is given twice in this move", advances[0])
        return tree.MoveStatement(
            place=place_of(keyword),
            fly=keyword.upper() == "MOVEFLY",
            trajectory=trajectory,
            target=target,
            via=vias[0] if vias else None,
            settings=tuple(clause for clause in reversed(clauses) if isinstance(clause, tree.Setting)),
        )

    def trajectory(self, token: str = "") -> str:
        return token.upper()

    # Clauses of a move are collected from the last to the first, in one list.
    def tail_end(self) -> list[_Clause]:
        return []

    def via(self, _via: Token, target: tree.Expression, clauses: list[_Clause]) -> list[_Clause]:
        clauses.append(target)
        return clauses

    def advance(self, keyword: Token, clauses: list[_Clause]) -> list[_Clause]:
        clauses.append(place_of(keyword))
        return clauses

    def with_setting(self, setting: tree.Setting, clauses: list[_Clause]) -> list[_Clause]:
        clauses.append(setting)
        return clauses

    def setting(self, name: Token, value: tree.Expression) -> tree.Setting:
        return tree.Setting(place_of(name), _system_name(name), value)

    def binary(self, left: tree.Expression, operator: Token, right: tree.Expression) -> tree.Binary:
        return tree.Binary(place_of(operator), operator.upper(), left, right)

    def comparison(self, left: tree.Expression, *rest: Any) -> tree.Binary:
        operator = str(rest[0]) if len(rest) == 2 else "="
        place = place_of(rest[0]) if len(rest) == 2 else left.place
        return tree.Binary(place, operator, left, rest[-1])

    def unary(self, operator: Token, operand: tree.Expression) -> tree.Unary:
        return tree.Unary(place_of(operator), operator.upper(), operand)

    def integer(self, token: Token) -> tree.Literal:
        return tree.Literal(place_of(token), _number(token))

    def real(self, token: Token) -> tree.Literal:
        value = float(token) if len(token) <= MAX_REAL else float("inf")
        if value == float("inf"):
            raise Pdl2Error("the number is too large or too long", place_of(token))
        return tree.Literal(place_of(token), value)

    def string(self, token: Token) -> tree.Literal:
        return tree.Literal(place_of(token), token[1:-1].replace("''", "'"))

    def name(self, token: Token) -> tree.Name:
        return tree.Name(place_of(token), token.lower())

    def element(self, name: Token, index: tree.Expression) -> tree.Element:
        return tree.Element(place_of(name), name.lower(), index)

    def system(self, token: Token) -> tree.System:
        return tree.System(place_of(token), _system_name(token))

    def pos(self, keyword: Token, *fields: tree.Expression) -> tree.PosLiteral:
        return tree.PosLiteral(place_of(keyword), fields)

    def joints(self, brace: Token, *fields: tree.Expression) -> tree.JointLiteral:
        return tree.JointLiteral(place_of(brace), fields)
