"""The sim-to-real gap: where it lies, which effect causes it, how far it shrinks."""

from agent.diagnosis.answer import Cause, DiagnosisResult
from agent.diagnosis.workflow import check_effects, diagnose
from agent.diagnosis.extension import extended_model
from agent.diagnosis.forward import Simulated, simulate, simulation_part
from agent.diagnosis.limits import DecisionLimits
from agent.diagnosis.result import Diagnosis
from agent.diagnosis.trial import Trial
from agent.model.effects import CATALOGUE, Effect

__all__ = [
    "CATALOGUE",
    "Cause",
    "DecisionLimits",
    "Diagnosis",
    "DiagnosisResult",
    "Effect",
    "Simulated",
    "Trial",
    "check_effects",
    "diagnose",
    "extended_model",
    "simulate",
    "simulation_part",
]
