"""From logs to an identified model: filtering, regression, friction, uncertainty."""

from agent.estimation.estimate import METHODS, EstimationSettings, estimate
from agent.estimation.filtering import FilterSettings
from agent.model.identified import EFFECTS, IdentifiedModel, ModelEffect, condition_text

__all__ = [
    "EFFECTS",
    "METHODS",
    "EstimationSettings",
    "FilterSettings",
    "IdentifiedModel",
    "ModelEffect",
    "condition_text",
    "estimate",
]
