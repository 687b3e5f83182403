"""A drive that is warm before the first of several logs ends: the others cannot tell that it was ever cold."""

from collections.abc import Callable

import numpy as np
import pytest

from agent.diagnosis import Diagnosis, diagnose
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.recording.log import Log
from agent.robot import RobotDescription
from tests.estimation.conftest import _arm, _links, _log, _multisine

RATE = 250.0  # Hz
COULOMB, VISCOUS = 5.0, 4.0  # N·m, N·m·s/rad
WAY = 3.0  # rad


def _recorded(robot: RobotDescription, seed: int, factor: Callable[[np.ndarray], np.ndarray | float]) -> Log:
    """A motion in which the second joint's friction is larger by a factor of the way (S,) [rad] that it went."""
    time = np.arange(0, 16, 1 / RATE)
    q, qd, qdd = _multisine(2, time, seed)
    rubs = COULOMB * np.sign(qd) + VISCOUS * qd
    rubs[:, 1] *= factor(np.cumsum(np.abs(qd[:, 1])) / RATE)
    noise = 0.1 * np.random.default_rng(seed).normal(size=q.shape)
    return _log(robot, time, q, _links(robot, q, qd, qdd) + rubs + noise, f"{seed}.mcap")


def _as_it_was(way: np.ndarray) -> float:
    return 1.0


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return _arm(2)


@pytest.fixture(scope="module")
def model(robot) -> IdentifiedModel:
    return estimate(
        robot, [_recorded(robot, seed, _as_it_was) for seed in (1, 2)], EstimationSettings.create(cutoff=15)
    )


def _diagnosed(robot: RobotDescription, model: IdentifiedModel, first: Callable[..., np.ndarray | float]) -> Diagnosis:
    return diagnose(robot, [_recorded(robot, seed, first if seed == 3 else _as_it_was) for seed in (3, 4, 5)], model)


def test_names_a_drive_that_warms_up_with_the_distance_travelled(robot, model):
    answer = _diagnosed(robot, model, lambda way: 1 + 0.8 * np.exp(-way / WAY)).document
    assert answer.verdict == "explained"
    (cause,) = answer.causes
    assert (cause.effect, cause.joints) == ("thermal_friction", (robot.joint_names[1],))
    assert cause.parameters["way"] == pytest.approx(WAY, rel=0.2)
    assert cause.parameters["coulomb_drift"] == pytest.approx(0.8 * COULOMB, rel=0.2)


def test_different_friction_throughout_the_first_log_is_not_warm_up(robot, model):
    answer = _diagnosed(robot, model, lambda way: 1.5).document
    assert all(cause.effect != "thermal_friction" for cause in answer.causes)
