"""Motions of one joint each: what is held out of them is motion that the others speak about."""

import dataclasses

import numpy as np
import pytest

from agent.diagnosis import diagnose
from agent.estimation import estimate
from agent.robot import Dynamics
from agent.validation import validate
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record


@pytest.fixture(scope="module")
def alone():
    """An arm, its model from motions of one joint each, and a healthy motion of all joints."""
    robot = make_arm("RRRR")
    plant = Plant(robot, seed=3)
    single = [record(plant, f"only_{k}", 20 + k, 1.5 * np.eye(robot.dof)[k]) for k in range(robot.dof)]
    return robot, estimate(robot, single), [record(plant, f"all_{k}", 40 + k) for k in range(2)]


def test_error_held_out_of_single_joints_is_that_of_other_motions(alone):
    _, model, healthy = alone
    error = np.array(validate(model, healthy).overall.rmse)
    assert model.group_rmse is not None
    assert np.all(error < 2.0 * model.group_rmse[0])
    assert np.all(model.group_rmse[0] < 2.0 * error)
    assert "folds of segments" in model.text()
    assert model.too_little_motion, "single values are not known from such motions"


def test_push_shows_with_a_model_from_single_joints(alone):
    """40 N down at the tip of an arm whose model errs by less than 0.5 N·m."""
    robot, model, healthy = alone
    log, dynamics, step = healthy[0], Dynamics(robot), 1e-6
    lift = np.stack(
        [
            (dynamics.tip_pose(log.position + d)[:, 2, 3] - dynamics.tip_pose(log.position - d)[:, 2, 3]) / (2 * step)
            for d in step * np.eye(robot.dof)
        ],
        axis=1,
    )
    push = 40.0 * np.sin(np.pi * np.clip((log.t - 6.0) / 1.2, 0, 1))[:, None] ** 2
    pushed = dataclasses.replace(log, effort=log.effort + push * lift)
    assert diagnose(robot, healthy, model).verdict == "no_gap"
    found = diagnose(robot, [pushed, healthy[1]], model)
    assert found.verdict == "explained"
    assert [cause.effect for cause in found.document.causes] == ["contact"]
