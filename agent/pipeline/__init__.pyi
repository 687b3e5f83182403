from .calibrate import run_calibration as run_calibration
from .checked_logs import (
    check_one_machine as check_one_machine,
    check_plausible as check_plausible,
    load_arm as load_arm,
    read_logs as read_logs,
)
from .compare import compare_runs as compare_runs
from .gap.diagnose import diagnose_files as diagnose_files, diagnose_recording as diagnose_recording
from .gap.diagnosis_question import (
    BUDGET as BUDGET,
    GapQuestion as GapQuestion,
    budget_of as budget_of,
    planning_time as planning_time,
)
from .gap.printed_diagnosis import diagnosis_text as diagnosis_text, planned_text as planned_text
from .gap.set_point_files import plan_of_file as plan_of_file
from .identify import (
    MAP_OR_PRESET as MAP_OR_PRESET,
    FitQuestion as FitQuestion,
    check_structure as check_structure,
    estimate_files as estimate_files,
    fit_files as fit_files,
    fit_logs as fit_logs,
    import_files as import_files,
    validate_files as validate_files,
    validation_text as validation_text,
)
from .job import Outcome as Outcome
from .learn import learn_files as learn_files
from .planning.plan_files import PlanFiles as PlanFiles, plan_recipe as plan_recipe
from .rebuilt_report import rebuild_report as rebuild_report
from .recalibrate import run_recalibration as run_recalibration
from .reports import write_index as write_index
from .result import conditions as conditions
from .setup.check import check_recipe as check_recipe
from .setup.doctor import examine_installation as examine_installation
from .setup.init import write_recipe as write_recipe
from .setup.schedule import install as install, make_schedule as make_schedule, next_steps as next_steps
