"""The syntax tree of a program. Names are in lower case: PDL2 knows no other difference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from agent.motion.pdl2.errors import Pdl2Error, TextPosition

#: Deeper expressions and blocks are refused: reading and running them would recurse that deep.
MAX_EXPRESSION_DEPTH = 100
MAX_BLOCK_DEPTH = 32
#: INTEGER has 32 bits.
MAX_INTEGER = 2**31 - 1


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
    """Whatever stands at a place of the text."""

    place: TextPosition


@dataclass(frozen=True)
class Literal(Node):
    value: int | float | str


@dataclass(frozen=True)
class Name(Node):
    """A variable, a constant of the program or a predefined constant."""

    name: str


@dataclass(frozen=True)
class Element(Node):
    """One element of an array."""

    name: str
    index: Expression


@dataclass(frozen=True)
class System(Node):
    """A system variable; `name` in capitals."""

    name: str


@dataclass(frozen=True)
class Unary(Node):
    operator: str
    operand: Expression


@dataclass(frozen=True)
class Binary(Node):
    operator: str
    left: Expression
    right: Expression


@dataclass(frozen=True)
class PosLiteral(Node):
    fields: tuple[Expression, ...]


@dataclass(frozen=True)
class JointLiteral(Node):
    fields: tuple[Expression, ...]


Expression = Literal | Name | Element | System | Unary | Binary | PosLiteral | JointLiteral
Target = Name | Element | System


@dataclass(frozen=True)
class Assignment(Node):
    target: Target
    value: Expression


@dataclass(frozen=True)
class Setting(Node):
    """`$NAME = value` of a WITH clause."""

    name: str
    value: Expression


@dataclass(frozen=True)
class MoveStatement(Node):
    """`trajectory` is LINEAR, JOINT, CIRCULAR or empty, where `$MOVE_TYPE` says."""

    fly: bool
    trajectory: str
    target: Expression
    via: Expression | None
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class DelayStatement(Node):
    milliseconds: Expression


@dataclass(frozen=True)
class ForLoop(Node):
    variable: Name
    first: Expression
    last: Expression
    step: Expression | None
    down: bool
    block: Block


@dataclass(frozen=True)
class Conditional(Node):
    condition: Expression
    then: Block
    otherwise: Block


StatementNode = Assignment | MoveStatement | DelayStatement | ForLoop | Conditional
Block = tuple[StatementNode, ...]


@dataclass(frozen=True)
class NamedType(Node):
    """A data type by its name in lower case, or `size` of them where it is an array."""

    name: str
    size: Expression | None = None


@dataclass(frozen=True)
class ConstantDeclaration(Node):
    name: str
    value: Expression


@dataclass(frozen=True)
class TypeDeclaration(Node):
    name: str
    type: NamedType


@dataclass(frozen=True)
class VariableDeclaration(Node):
    """Variables of one type, each with the initial value where there is one."""

    names: tuple[TextPosition, ...]
    type: NamedType
    initial: Expression | None


Declaration = ConstantDeclaration | TypeDeclaration | VariableDeclaration


@dataclass(frozen=True)
class Attribute(Node):
    name: str
    value: Literal | None


@dataclass(frozen=True)
class ProgramTree(Node):
    """A whole program as it was written."""

    name: str
    attributes: tuple[Attribute, ...]
    declarations: tuple[Declaration, ...]
    cycle: bool
    block: Block
    end: TextPosition


def children(node: Expression) -> tuple[Expression, ...]:
    """The expressions directly inside an expression."""
    if isinstance(node, Element):
        return (node.index,)
    if isinstance(node, Unary):
        return (node.operand,)
    if isinstance(node, Binary):
        return (node.left, node.right)
    if isinstance(node, PosLiteral | JointLiteral):
        return node.fields
    return ()


def check_expression_depth(expression: Expression) -> None:
    """Raises Pdl2Error where an expression is nested too deep; itself it does not recurse."""
    level: list[Expression] = [expression]
    for _ in range(MAX_EXPRESSION_DEPTH):
        level = [child for node in level for child in children(node)]
        if not level:
            return
    raise Pdl2Error(f"the expression is nested deeper than {MAX_EXPRESSION_DEPTH} operations", level[0].place)


def check_block_depth(program: ProgramTree) -> None:
    """Raises Pdl2Error where FOR and IF are nested too deep; itself it does not recurse."""
    level: list[StatementNode] = list(program.block)
    for _ in range(MAX_BLOCK_DEPTH):
        inner: list[StatementNode] = []
        for node in level:
            if isinstance(node, ForLoop):
                inner += node.block
            elif isinstance(node, Conditional):
                inner += node.then + node.otherwise
        if not inner:
            return
        level = inner
    raise Pdl2Error(f"FOR and IF are nested deeper than {MAX_BLOCK_DEPTH}", level[0].place)
