from .authorisation import Authorisation as Authorisation, load_authorisation as load_authorisation
from .cell import Cell as Cell, position_ranges as position_ranges
from .checked import FILE as FILE, CheckedPrograms as CheckedPrograms
from .clearance import CellReport as CellReport
from .first_run import FIRST_SPEED as FIRST_SPEED, slow_version as slow_version
from .frames import check_frames as check_frames, frames_text as frames_text
from .guard import GuardedLink as GuardedLink
from .motion import PlannedProgram as PlannedProgram, is_there as is_there, pauses as pauses
from .preconditions import (
    check_identity as check_identity,
    check_period as check_period,
    check_throughput as check_throughput,
)
