"""Logs of any length in bounded memory: what lies on disk gives the same model."""

from __future__ import annotations

import numpy as np

from agent.estimation import estimate
from agent.estimation.workflow import EstimationSettings
from agent.recording import read_log, scratch, write_log


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
