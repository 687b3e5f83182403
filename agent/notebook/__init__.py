"""The functions behind `import agent as ca`, and results that print themselves in a notebook."""

from agent.notebook.functions import (
    calibrate,
    diagnose,
    drivers,
    effects,
    estimate,
    export,
    load_recipe,
    load_robot,
    plan,
    read_logs,
    report,
    validate,
)
from agent.notebook.results import Calibration, GapDiagnosis, Logs, Model, PlannedLoop, TorqueValidation
