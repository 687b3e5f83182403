"""Logs too short to tell a mistake in them from chance."""

from __future__ import annotations

import numpy as np
import pytest

from agent.data_quality.rigid_fit import FOLDS, Bodies, FitSamples, RigidFit, overfitted


@pytest.mark.parametrize(("count", "expected"), [(16, True), (400, False)])
def test_a_fit_that_cannot_predict_held_out_data_blames_no_joint(arm, multisine, count, expected):
    robot = arm(7, seed=1)
    bodies = Bodies(robot)
    q, qd, qdd = multisine(7, np.linspace(0, 1 + count / 10, count), seed=1)
    rng = np.random.default_rng(1)
    fold = np.arange(count) * FOLDS // count
    q += 1.5 * rng.normal(size=(FOLDS, 7))[fold]  # every part of the log is elsewhere
    samples = FitSamples(q, qd, qdd, np.zeros_like(q), np.sign(qd), fold, float(count))
    torque = bodies.columns(samples) @ rng.normal(size=14 * 7)
    torque += 0.1 * np.std(torque, axis=0) * rng.normal(size=q.shape)
    samples = FitSamples(q, qd, qdd, torque, samples.direction, fold, float(count))
    assert overfitted(RigidFit(bodies, samples), torque) is expected
