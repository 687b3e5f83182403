"""Friction that reverses over another travel is one cause, and of its own name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis import diagnose
from fake_controller.plant import Plant
from tests.small_arms import record

JOINT, LEVEL, TRAVEL = 1, 8.0, 4e-3  # N·m of friction that is there before, and rad over which it reverses


@pytest.fixture(scope="module")
def healthy(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("a", 21), ("b", 22))]


def bristles(position: np.ndarray, level: float, stiffness: float) -> np.ndarray:
    """Torque (S,) of bristles that slide at a level: LuGre without its damping, exact over a step."""
    torque = np.zeros(len(position))
    for k, step in enumerate(np.diff(position), 1):
        slides = np.sign(step) * level
        torque[k] = slides + (torque[k - 1] - slides) * np.exp(-abs(step) * stiffness / level)
    return torque


def test_names_friction_with_a_longer_reversal_distance(arm, model, healthy):
    logs = []
    for log in healthy:
        q, effort = log.position[:, JOINT], log.effort.copy()
        effort[:, JOINT] += bristles(q, LEVEL, LEVEL / TRAVEL / 6.0) - bristles(q, LEVEL, LEVEL / TRAVEL)
        logs.append(replace(log, effort=effort))
    result = diagnose(arm, logs, model).result
    assert [(cause["effect"], cause["joints"]) for cause in result["causes"]] == [("presliding", ["joint_2"])]
    assert result["closure"] > 0.8
