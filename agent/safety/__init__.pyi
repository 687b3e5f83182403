from .authorisation import Authorisation as Authorisation, load_authorisation as load_authorisation
from .first_run import (
    FILE as FILE,
    FIRST_SPEED as FIRST_SPEED,
    CheckedPrograms as CheckedPrograms,
    slow_text as slow_text,
)
from .guard import GuardedLink as GuardedLink, Permission as Permission, Surroundings as Surroundings
from .planned_program import PlannedProgram as PlannedProgram, is_standstill as is_standstill, pauses as pauses
from .preconditions import (
    check_frames as check_frames,
    check_identity as check_identity,
    check_period as check_period,
    check_throughput as check_throughput,
    frames_text as frames_text,
)
