"""Torque that is late in the very logs that the model is fitted to."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.diagnosis import diagnose
from agent.estimation import FilterSettings, observe, torque_delay, with_torque_in_time
from agent.robot import rigid_bodies
from fake_controller.plant import Plant
from tests.small_arms import record

MOTIONS = (("one", 11), ("two", 12), ("three", 13))


@pytest.fixture(scope="module")
def logs(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, *motion) for motion in MOTIONS]


def late(log, delay):
    """The log with its torque recorded a delay [s] later."""
    return replace(log, effort=np.stack([np.interp(log.t - delay, log.t, x) for x in log.effort.T], axis=1))


def delay_of(arm, logs):
    return torque_delay(observe(rigid_bodies(arm), logs, FilterSettings()))


@settings(max_examples=8, deadline=None)
@given(delay=st.floats(-0.02, 0.02))
def test_torque_that_comes_later_has_that_much_more_delay(arm, logs, delay):
    """As friction reverses, most of a delay is not to be seen: only motion far from reversals tells it."""
    assert delay_of(arm, [late(log, delay) for log in logs]) == pytest.approx(delay, abs=2e-4 + 0.03 * abs(delay))


def test_torque_in_time_stays_as_it_is(arm, logs):
    assert with_torque_in_time(arm, logs, None) is None


def test_late_torque_comes_back_in_time(arm, logs):
    in_time = with_torque_in_time(arm, [late(log, 0.01) for log in logs], None)
    assert in_time is not None
    assert abs(delay_of(arm, in_time)) < 5e-4


@pytest.mark.parametrize("delay", [-0.005, 0.015])
def test_a_model_of_late_torque_does_not_hide_the_delay(arm, delay):
    plant = Plant(arm, seed=3, effects=[{"effect": "time_delay", "parameters": {"delay": delay}}])
    (cause,) = diagnose(arm, [record(plant, *motion) for motion in MOTIONS]).document.causes
    assert cause.effect == "time_delay"
    assert cause.parameters["delay"] == pytest.approx(delay, rel=0.1)
