"""Positions that a recorder rounds make torque of an acceleration that never was: it is no gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.diagnosis import diagnose
from agent.diagnosis.rows.rounding import rounding_noise, rounding_step
from agent.model import NominalModel
from agent.validation import predict_log
from fake_controller.plant import Plant
from tests.small_arms import record

STEP = 1e-4


@pytest.fixture(scope="module")
def recorded(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]


def rounded(log):
    return replace(log, position=STEP * np.round(log.position / STEP), velocity=None)


def test_predicts_the_size_of_rounding_noise(recorded, model):
    log = recorded[0]
    fine, coarse = (predict_log(model, one, 30.0).predicted for one in (replace(log, velocity=None), rounded(log)))
    happened = np.sqrt(np.mean((coarse - fine) ** 2, axis=0))
    expected = rounding_noise(NominalModel(model), [rounded(log)], 30.0)
    assert expected == pytest.approx(happened, rel=0.5)


def test_rounding_is_not_a_gap_for_a_model_of_finer_logs(arm, model, recorded):
    rated = replace(arm, joints=tuple(replace(joint, nominal_motor_torque=0.6) for joint in arm.joints))
    result = diagnose(rated, [rounded(log) for log in recorded], replace(model, robot=rated)).result
    assert (result["verdict"], result["causes"]) == ("no_gap", [])


@given(st.floats(1e-6, 1e-2), st.floats(-3, 3), st.integers(0, 100))
def test_finds_the_rounding_step(step, offset, seed):
    counts = np.cumsum(np.random.default_rng(seed).integers(-3, 4, 500))
    assert rounding_step(offset + step * counts) == pytest.approx(step, rel=1e-3)
    assert rounding_step(np.random.default_rng(seed).normal(size=500)) == 0.0
