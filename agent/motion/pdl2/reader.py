"""From text to a program that is known to be sound as far as that can be known without moving."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.motion.pdl2.checker import check
from agent.motion.pdl2.errors import Pdl2Error
from agent.motion.pdl2.interpreter import Program, StepLimitError

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: A program has no inputs: what it does in its first steps it always does, so that much is tried when it is read.
TRIAL_STEPS = 5000


def parse_program(text: str, path: str = "", robot: RobotDescription | None = None) -> Program:
    """Read and check a program of the motion subset; `path` is named in messages.

    With `robot`, a JOINTPOS must have its number of joints, and its prismatic joints are in mm.

    Raises:
        Pdl2Error: text outside the subset, an undeclared name, a data type that does not fit, and whatever the first
            5000 steps of the program would meet when it runs (positions not assigned, values out of range).
    """
    from agent.motion.pdl2.parser import parse_tree

    try:
        tree = parse_tree(text)
        program = Program(tree.name, path, tree.cycle, tree, check(tree), robot)
    except Pdl2Error as error:
        raise error.within(path) from None
    try:
        for _ in program.run(limit=TRIAL_STEPS):
            pass
    except StepLimitError:
        pass
    return program


def job_text(
    text: str, path: str = "", robot: RobotDescription | None = None, listing: str = ""
) -> tuple[str, dict[str, int]]:
    """A program for the places it goes to: as it is where it is of the motion subset, else what moves in it.

    `listing` is the text of the variable file beside it (`agent.motion.pdl2.listing`): what variables hold at first.
    Also returns how often each word that does not move was passed over (`agent.motion.pdl2.sieve`).

    Raises:
        Pdl2Error: something moves that is not understood.
    """
    from agent.motion.pdl2.listing import read_listing
    from agent.motion.pdl2.sieve import sieve, without_setting

    listed = read_listing(listing)
    try:
        # With a listing the text alone does not say what the variables hold at first.
        if not listed:
            parse_program(text, path, robot)
            return text, {}
    except Pdl2Error:
        pass
    try:
        kept, passed = sieve(text, listed)
    except Pdl2Error as error:
        raise error.within(path) from None
    while True:
        try:
            parse_program(kept, path, robot)
        except Pdl2Error as error:
            shorter, word = without_setting(kept, error.place)
            if shorter == kept:
                return kept, passed  # whoever runs it is told where it stops
            kept, passed = shorter, {**passed, word: passed.get(word, 0) + 1}
        else:
            return kept, passed
