from .alignment import Aligner as Aligner, moving_segments as moving_segments
from .controller import answering as answering
from .effort import check_effort as check_effort
from .mounted_mass import (
    PROGRAM_SHA256 as PROGRAM_SHA256,
    SCHEMA as SCHEMA,
    check_payload as check_payload,
    planned_load as planned_load,
    with_payload as with_payload,
)
from .planning import (
    APPROACH_SPEED as APPROACH_SPEED,
    check_cell as check_cell,
    plan_program as plan_program,
    torque_limits as torque_limits,
    trajectories as trajectories,
)
from .record import (
    MotionOfMany as MotionOfMany,
    Recording as Recording,
    RobotLink as RobotLink,
    open_link as open_link,
    record_program_file as record_program_file,
    report_losses as report_losses,
)
from .watch import record_watched as record_watched
