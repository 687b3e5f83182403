"""Motions of one joint each: their model states what it errs by on motions of all joints, and judges no more."""

import dataclasses

import numpy as np
import pytest

from agent.diagnosis import NextKind, diagnose
from agent.estimation import FilterSettings, estimate, motions
from agent.robot import Dynamics
from agent.validation import validate
from agent.validation.torque import filtered_columns
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record


@pytest.fixture(scope="module")
def alone():
    """A plant, the model of its motions of one joint each, and healthy motions of all joints."""
    robot = make_arm("RRR")
    plant = Plant(robot, seed=3)
    single = [record(plant, f"only_{k}", 20 + k, 0.5 * np.eye(robot.dof)[k]) for k in range(robot.dof)]
    return plant, estimate(robot, single), [record(plant, f"all_{k}", 40 + k, 0.5) for k in range(2)]


def test_model_states_its_error_on_motions_of_all_joints(alone):
    """Stiction hides torque of joints that stand still, so their rows say little of what couples joints."""
    _, model, healthy = alone
    error = np.array(validate(model, healthy).overall.rmse)
    stated = []
    for log in healthy:
        for motion in motions(log, FilterSettings(model.cutoff, model.order)):
            interval = model.prediction_interval(filtered_columns(model, motion), motion.qd[motion.kept])
            stated.append(interval / 1.96)
    stated = np.sqrt(np.mean(np.concatenate(stated) ** 2, axis=0))
    assert np.all(error < 1.2 * stated)
    assert "folds of segments" in model.text()
    assert model.too_little_motion, "single values are not known from such motions"


def test_healthy_arm_has_no_gap_and_a_push_shows(alone):
    """15 N down at the tip of an arm whose model errs by 0.2 N·m."""
    plant, model, healthy = alone
    log, dynamics, step = healthy[0], Dynamics(plant.robot), 1e-6
    lift = np.stack(
        [
            (dynamics.tip_pose(log.position + d)[:, 2, 3] - dynamics.tip_pose(log.position - d)[:, 2, 3]) / (2 * step)
            for d in step * np.eye(plant.robot.dof)
        ],
        axis=1,
    )
    push = 15.0 * np.sin(np.pi * np.clip((log.t - 6.0) / 1.2, 0, 1))[:, None] ** 2
    pushed = dataclasses.replace(log, effort=log.effort + push * lift)
    assert diagnose(plant.robot, healthy, model).verdict == "no_gap"
    result = diagnose(plant.robot, [pushed, healthy[1]], model)
    assert result.verdict == "explained"
    assert [cause.effect for cause in result.document.causes] == ["contact"]


def test_motion_that_the_fit_leaves_open_is_not_judged(alone):
    plant, model, _ = alone
    result = diagnose(plant.robot, [record(plant, "far", 42, 1.8)], model)
    assert (result.verdict, result.document.causes) == ("unknown", ())
    assert result.document.next_experiment.kind == NextKind.TOGETHER
    assert any("leave the torque in these logs open" in warning for warning in result.warnings)
