"""Torque constants that a known mass at the flange asks for."""

from dataclasses import replace

import numpy as np
import pytest

from agent.core import InputError
from agent.estimation import estimate
from agent.model import PAYLOAD
from agent.pipeline.checked_logs import check_one_machine
from agent.validation import torque_scales
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record

BALL = {"mass": 5.0, "centre": (0.3, 0.0, 0.05), "radius": 0.01}
SCALES = np.array([1.0, 1.2, 0.85])


@pytest.fixture(scope="module")
def scales():
    """Of an arm whose torque is measured with wrong constants: bare twice, then with the mass."""
    arm = make_arm("RRR")
    arm = replace(arm, joints=tuple(replace(joint, torque_constant=0.1) for joint in arm.joints))
    loaded = Plant(arm, seed=3, effects=[{"effect": "payload", "parameters": BALL}])
    logs = [record(Plant(arm, seed=3), "one", 11), record(Plant(arm, seed=3), "two", 12), record(loaded, "three", 13)]
    *bare, heavy = (replace(log, effort=log.effort * SCALES) for log in logs)
    heavy.metadata[PAYLOAD] = "5 kg, 300 mm, 0 mm, 50 mm"
    return torque_scales(estimate(arm, bare), [*bare, heavy])


@pytest.mark.parametrize("joint", [1, 2])
def test_finds_the_torque_scale_of_a_joint_that_lifts_the_mass(scales, joint):
    one = scales[joint]
    assert one.known
    assert one.scale == pytest.approx(SCALES[joint], rel=0.03)
    assert one.constant == pytest.approx(0.1 / SCALES[joint], rel=0.03)
    assert one.interval < 0.1
    assert f"torque_constant {one.constant:.4g} N·m/A, described 0.1" in one.text()


def test_a_joint_not_loaded_by_the_mass_has_no_torque_scale(scales):
    one = replace(scales[0], interval=2 * scales[0].scale)
    assert "does not load it enough" in one.text()


def test_refuses_to_fit_logs_with_a_mass_alone():
    arm = make_arm("R")
    log = record(Plant(arm, seed=3), "one", 11)
    log.metadata[PAYLOAD] = "1 kg, 0 mm, 0 mm, 0 mm"
    with pytest.raises(InputError, match="with logs of the bare arm"):
        check_one_machine([log], None, allow_mixed=False)
