"""A model's parameters move no further than the uncertainty stored in it, however many rows would have them move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from agent.diagnosis.stored_uncertainty import held_to_uncertainty
from scipy.special import chdtri

from agent.diagnosis import diagnose
from agent.diagnosis.dataset import assemble
from fake_controller.plant import Plant
from tests.small_arms import record


@pytest.fixture(scope="module")
def healthy(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]


def heavier(logs, joint, size):
    """The logs with gravity-like torque of an angle that the model's own columns nearly span."""
    return [
        replace(
            log,
            effort=log.effort + size * np.cos(log.position[:, [joint]]) * (np.arange(log.effort.shape[1]) == joint),
        )
        for log in logs
    ]


def distance(fit, precision):
    shift = fit.solve(np.ones(fit.cells, dtype=bool))[1]
    return shift @ precision @ shift


def test_a_healthy_arm_is_not_held(arm, model, healthy):
    assert held_to_uncertainty(assemble(arm, model, healthy, None).fit) is None


@pytest.mark.parametrize("size", [3.0, 10.0, 100.0])
def test_parameters_stay_where_a_thousandth_of_models_are_not(arm, model, healthy, size):
    fit = assemble(arm, model, heavier(healthy, 1, size), None).fit
    most = chdtri(len(fit.precision), 1e-3)
    assert distance(fit, fit.precision) > most
    held = held_to_uncertainty(fit)
    assert most / 10 < distance(held, fit.precision) <= most


def test_what_the_parameters_would_take_away_is_a_gap_all_the_same(arm, model, healthy):
    """Many rows would have the parameters take a spring that is dozens of their standard deviations away."""
    wider = replace(model, covariance=300 * model.covariance)
    size = 0.15 * np.std(healthy[0].effort[:, 1])
    sprung = [
        replace(log, effort=log.effort + size * np.sin(log.position[:, [1]]) * (np.arange(3) == 1)) for log in healthy
    ]
    found = diagnose(arm, sprung, wider).answer
    assert found.verdict != "no_gap"
    assert "joint_2" in found.causes[0].joints
