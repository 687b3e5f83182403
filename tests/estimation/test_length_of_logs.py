"""Logs too short to tell a mistake in them from chance, and logs of any length in bounded memory."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core import Console, RejectedError
from agent.data_quality.rigid_fit import FOLDS, FitSamples, RigidFit
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.pipeline import FitQuestion, fit_logs
from agent.recording import read_log, scratch, write_log
from agent.robot import Dynamics


@pytest.mark.parametrize(("count", "expected"), [(16, True), (400, False)])
def test_a_fit_that_cannot_predict_held_out_data_blames_no_joint(arm, multisine, count, expected):
    robot = arm(7, seed=1)
    q, qd, qdd = multisine(7, np.linspace(0, 1 + count / 10, count), seed=1)
    rng = np.random.default_rng(1)
    fold = np.arange(count) * FOLDS // count
    q += 1.5 * rng.normal(size=(FOLDS, 7))[fold]  # every part of the log is elsewhere
    samples = FitSamples(q, qd, qdd, np.zeros_like(q), np.sign(qd), fold, float(count))
    torque = RigidFit(Dynamics(robot), samples).columns @ rng.normal(size=14 * 7)
    torque += 0.1 * np.std(torque, axis=0) * rng.normal(size=q.shape)
    samples = FitSamples(q, qd, qdd, torque, samples.direction, fold, float(count))
    assert RigidFit(Dynamics(robot), samples).says_something() is not expected


@pytest.mark.parametrize(
    ("motion", "still", "enough"), [(0.55, 0.0, False), (0.1, 4.0, False), (2.5, 0.0, True), (2.5, 4.0, True)]
)
def test_a_model_of_too_little_motion_is_made_by_force_alone(arm, multisine, make_log, tmp_path, motion, still, enough):
    robot, t = arm(2), np.arange(round(500 * (motion + still))) / 500
    since = t - still / 2
    q, *moving = multisine(2, np.clip(since, 0.0, motion))
    qd, qdd = (np.where((since >= 0) & (since <= motion), values.T, 0.0).T for values in moving)
    noise = 0.01 * np.random.default_rng(0).normal(size=q.shape)
    torque = Dynamics(robot).inverse_dynamics(q, qd, qdd) + 3 * np.sign(qd) + qd + noise
    logs, out = [make_log(robot, t, q, torque)], tmp_path / "model.json"
    if not enough:
        with pytest.raises(RejectedError, match=r"a\.mcap: too little motion: .* postures .* parameters need"):
            fit_logs(robot, logs, FitQuestion(method="weighted"), Console(-1))
    fit_logs(robot, logs, FitQuestion(method="weighted", force=not enough), Console(-1))[0].save(out)
    assert IdentifiedModel.load(out).robot.name == robot.name


def test_a_model_is_the_same_from_memory_and_from_disk(arm, multisine, make_log, tmp_path, monkeypatch):
    robot = arm(2)
    t = np.arange(6000) / 500
    q, qd, _ = multisine(2, t)
    torque = 3 * np.sign(qd) + qd + np.random.default_rng(0).normal(size=q.shape)
    write_log(tmp_path / "long.mcap", make_log(robot, t, q, torque, reference_position=q))
    settings = EstimationSettings.create(method="weighted")
    models = []
    for in_memory in (2**30, 0):
        monkeypatch.setattr(scratch, "_IN_MEMORY", in_memory)
        models.append(estimate(robot, [read_log(tmp_path / "long.mcap", robot)], settings))
    assert np.array_equal(models[0].values, models[1].values)
    assert np.array_equal(models[0].covariance, models[1].covariance)
