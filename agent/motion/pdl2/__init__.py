"""PDL2, the language of COMAU's controllers: the motion subset, read, run and written.

The package imports its parser generator only when a program is read.
"""

from agent.motion.pdl2.errors import Pdl2Error, TextPosition
from agent.motion.pdl2.frames import pos_to_pose, pose_to_pos
from agent.motion.pdl2.interpreter import MAX_STEPS, Program
from agent.motion.pdl2.listing import listing_beside
from agent.motion.pdl2.reader import job_text, parse_program
from agent.motion.pdl2.writer import write_loop_program, write_program

__all__ = [
    "MAX_STEPS",
    "Pdl2Error",
    "Program",
    "TextPosition",
    "job_text",
    "listing_beside",
    "parse_program",
    "pos_to_pose",
    "pose_to_pos",
    "write_loop_program",
    "write_program",
]
