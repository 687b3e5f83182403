"""Torque prediction on unseen motions."""

from agent.validation.torque import Prediction, predict_log, summary, validate

__all__ = ["Prediction", "predict_log", "summary", "validate"]
