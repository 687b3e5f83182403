"""From logs to an identified model: filtering, regression, friction, uncertainty."""

from agent.estimation.workflow import ESTIMATORS, EstimationSettings, Estimator, estimate, methods
from agent.estimation.filtering import FilterSettings
from agent.model.data import ModelEffect
from agent.model.identified import EFFECTS, IdentifiedModel, condition_text

__all__ = [
    "EFFECTS",
    "ESTIMATORS",
    "EstimationSettings",
    "Estimator",
    "FilterSettings",
    "IdentifiedModel",
    "ModelEffect",
    "condition_text",
    "estimate",
    "methods",
]
