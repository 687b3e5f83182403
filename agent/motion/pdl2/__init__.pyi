from .evaluation import Memory as Memory, Value as Value, evaluate as evaluate, subscript as subscript
from .reader import Program as Program, parse_program as parse_program
from .syntax import (
    Assignment as Assignment,
    Block as Block,
    Constant as Constant,
    DelayStatement as DelayStatement,
    Element as Element,
    Expression as Expression,
    ForLoop as ForLoop,
    Joints as Joints,
    MoveStatement as MoveStatement,
    Pdl2Error as Pdl2Error,
    Pos as Pos,
    System as System,
)
from .writer import write_loop_program as write_loop_program, write_program as write_program
