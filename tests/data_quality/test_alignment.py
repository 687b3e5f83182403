"""How far the channels of a log lag each other, whatever the filter that delays them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from agent.data_quality.alignment import alignment, late_velocity
from agent.data_quality.faults import Recordings
from fake_controller.plant import Plant
from tests.small_arms import PERIOD, make_arm, record


@pytest.fixture(scope="module")
def arm():
    return make_arm("RP")


@pytest.fixture(scope="module")
def log(arm):
    return record(Plant(arm, seed=3), "one", 21)


def first_order(rows: np.ndarray, lag: float) -> np.ndarray:
    """A recorder's first-order filter, whose delay at low frequency is its time constant."""
    pole = np.exp(-PERIOD / lag)
    return lfilter([1 - pole], [1, -pole], rows, axis=0)


@pytest.mark.parametrize("lag", [0.008, 0.03])
def test_finds_the_lag_of_a_filtered_velocity(arm, log, lag):
    late = replace(log, velocity=first_order(log.velocity, lag))
    assert alignment(late).velocity == pytest.approx(lag, abs=2e-3)
    (finding,) = late_velocity(Recordings(arm, [log, late]))
    assert not finding.refuses
    assert "lags its position" in finding.text


def test_a_velocity_in_time_is_not_mentioned(arm, log):
    assert abs(alignment(log).velocity) < PERIOD, "a controller differentiates backwards, which is half a sample"
    assert list(late_velocity(Recordings(arm, [log, replace(log, velocity=None)]))) == []


def test_finds_how_far_the_position_lags_its_set_points(log):
    steps = 10
    early = np.vstack([log.position[steps:], np.repeat(log.position[-1:], steps, axis=0)])
    found = alignment(replace(log, reference_position=early))
    assert found.position == pytest.approx(steps * PERIOD, abs=2e-3)
    assert alignment(replace(log, reference_position=None)).position is None
