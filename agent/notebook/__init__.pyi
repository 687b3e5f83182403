from .functions import (
    calibrate as calibrate,
    diagnose as diagnose,
    drivers as drivers,
    effects as effects,
    estimate as estimate,
    export as export,
    load_recipe as load_recipe,
    load_robot as load_robot,
    plan as plan,
    read_logs as read_logs,
    report as report,
    validate as validate,
)
from .results import (
    Calibration as Calibration,
    GapDiagnosis as GapDiagnosis,
    Logs as Logs,
    Model as Model,
    PlannedLoop as PlannedLoop,
    TorqueValidation as TorqueValidation,
)
