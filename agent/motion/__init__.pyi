from .dialect import Dialect as Dialect
from .fly.fly_parameters import FlyParameters as FlyParameters
from .fly.interpolator import FlyInterpolator as FlyInterpolator
from .interpolator import Interpolator as Interpolator, MotionError as MotionError, Trajectory as Trajectory
from .joint_trajectory.interpolator import parted as parted
from .learned_law import (
    LearnedLaw as LearnedLaw,
    is_file_name as is_file_name,
    load_law as load_law,
    robot_digest as robot_digest,
)
from .learning import Learner as Learner, RecordedMove as RecordedMove
from .orl import ARM as ARM, CONTROLLER as CONTROLLER, LIBRARY as LIBRARY
from .path_settings import (
    FlyTrajectory as FlyTrajectory,
    FlyType as FlyType,
    OrientationType as OrientationType,
    SpeedOption as SpeedOption,
)
from .pdl2.settings import Pdl2Settings as Pdl2Settings, Termination as Termination
from .pdl2.variables import pose_to_pos as pose_to_pos
from .pdl2.via_points import via_points as via_points
from .program import (
    CartesianTarget as CartesianTarget,
    Delay as Delay,
    Frame as Frame,
    JointTarget as JointTarget,
    LoopProgram as LoopProgram,
    MotionSettings as MotionSettings,
    Move as Move,
    MoveType as MoveType,
    Statement as Statement,
    Target as Target,
    left_open as left_open,
    loop_moves as loop_moves,
    stop_to_stop as stop_to_stop,
    tool_frame as tool_frame,
    way_key as way_key,
    with_frames as with_frames,
)
from .regions import ViaRegions as ViaRegions
from .registry import (
    ENTRY_POINTS as ENTRY_POINTS,
    create_dialect as create_dialect,
    create_interpolator as create_interpolator,
    dialect_of as dialect_of,
    dialects as dialects,
    interpolator_names as interpolator_names,
)
from .rotation import pose_of as pose_of
