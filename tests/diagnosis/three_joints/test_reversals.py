"""Friction whose level changes reverses over another travel too: that is one cause, and of its own name."""

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


def bristles(position: np.ndarray, level: np.ndarray, stiffness: float) -> np.ndarray:
    """Torque (S,) of bristles that slide at levels (S,): LuGre without its damping, exact over a step."""
    torque = np.zeros(len(position))
    for k, (step, most) in enumerate(zip(np.diff(position), level[1:], strict=True), 1):
        slides = np.sign(step) * most
        torque[k] = slides + (torque[k - 1] - slides) * np.exp(-abs(step) * stiffness / most)
    return torque


@pytest.mark.parametrize(("effect", "rise", "softer"), [("stribeck", 3.0, 1.0), ("presliding", 0.0, 6.0)])
def test_a_level_that_rises_as_the_sliding_slows_down_and_one_that_does_not(arm, model, healthy, effect, rise, softer):
    logs = []
    for log in healthy:
        q, speed = log.position[:, JOINT], np.abs(log.velocity[:, JOINT])
        level = LEVEL * (1 + rise * np.exp(-speed / 0.15))
        effort = log.effort.copy()
        effort[:, JOINT] += bristles(q, level, LEVEL / TRAVEL / softer)
        effort[:, JOINT] -= bristles(q, np.full(len(q), LEVEL), LEVEL / TRAVEL)
        logs.append(replace(log, effort=effort))
    result = diagnose(arm, logs, model).result
    assert [(cause["effect"], cause["joints"]) for cause in result["causes"]] == [(effect, ["joint_2"])]
    assert result["closure"] > 0.8
