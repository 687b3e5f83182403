from .approved import (
    approve as approve,
    approved_parts as approved_parts,
    check_approved as check_approved,
    differences as differences,
    problem as problem,
)
from .changes import Background as Background
from .current import (
    apply_previous as apply_previous,
    apply_run as apply_run,
    current_model as current_model,
    current_runs as current_runs,
    register_run as register_run,
)
from .folder import (
    RunFolder as RunFolder,
    check_output as check_output,
    make_folder as make_folder,
    write_json as write_json,
)
from .history import (
    History as History,
    find_run as find_run,
    history_json as history_json,
    history_table as history_table,
    last_accepted as last_accepted,
)
from .lock import robot_lock as robot_lock
from .loop_store import (
    FOLDER as FOLDER,
    StoredLoop as StoredLoop,
    find_loop as find_loop,
    keep_loop as keep_loop,
    run_key as run_key,
    stored_loops as stored_loops,
)
from .past_run import (
    PastRun as PastRun,
    named_causes as named_causes,
    read_object as read_object,
    read_run as read_run,
    readable as readable,
    too_early as too_early,
    wrong_clock as wrong_clock,
)
from .trends import (
    WINDOW as WINDOW,
    MachineRuns as MachineRuns,
    RunFigures as RunFigures,
    Trend as Trend,
    Watch as Watch,
    comparable_runs as comparable_runs,
    errors_by_joint as errors_by_joint,
    friction_trends as friction_trends,
    parameter_trends as parameter_trends,
    watch as watch,
)
from .warm_up import FEWEST as FEWEST
