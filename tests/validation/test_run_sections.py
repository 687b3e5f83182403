"""Sections of a run's report; the paper's estimator next to the one that was used."""

import numpy as np
import pytest

from agent.estimation import EstimationSettings, estimate
from agent.pages import Page, Section, render
from agent.robot import load_robot
from agent.validation import predict_log
from tests.estimation.conftest import _log


@pytest.fixture(scope="module")
def logs():
    """Two motions of the NS16's links with friction that also has a Stribeck term."""
    from agent.robot.dynamics import Dynamics

    robot = load_robot("comau_ns16")
    dynamics, t = Dynamics(robot), np.arange(2500) / 500
    made = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        rate, phase = rng.uniform(1.5, 5, 6), rng.uniform(0, 6, 6)
        angle = rate * t[:, None] + phase
        q = 0.25 * np.sin(angle) + [0, 0.2, -1.2, 0, 0.8, 0]
        qd, qdd = 0.25 * rate * np.cos(angle), -0.25 * rate**2 * np.sin(angle)
        friction = np.tanh(qd / 0.01) * (4 + 8 * np.exp(-np.abs(qd) / 0.2)) + 6 * qd
        torque = dynamics.inverse_dynamics(q, qd, qdd) + friction + rng.normal(size=q.shape)
        made.append(_log(robot, t, q, torque, f"motion_{seed}.mcap"))
    return robot, made


def test_a_page_leaves_out_a_section_with_nothing_to_show():
    assert render(Page("t", "h", "plain", [Section("Held out", ["worst: joint_3"]), None])).count("<section") == 1


def test_the_friction_curve_shows_steady_sliding(logs):
    from agent.pages.calibration.friction import friction_curve

    robot, (fitted, _) = logs
    model = estimate(robot, [fitted], EstimationSettings.create(method="paper", cutoff=20))
    speed = np.array([-1.0, -0.2, 0.0, 0.2, 1.0])
    b, n = len(model.independent), robot.dof
    for axle in range(n):
        level = {term.form: model.values[b + k] for k, term in enumerate(model.terms) if term.axle == axle}
        expected = (
            level["coulomb"] * np.sign(speed) + level["viscous"] * speed + level["quadratic"] * speed * abs(speed)
        )
        curve, half = friction_curve(model, axle, speed)
        np.testing.assert_allclose(curve, expected)
        assert np.all(half >= 0)


def test_the_parts_of_a_prediction_sum_to_it(logs):
    robot, (fitted, unseen) = logs
    model = estimate(robot, [fitted], EstimationSettings.create(method="weighted", cutoff=20))
    prediction = predict_log(model, unseen)
    parts = prediction.parts
    assert list(parts) == ["gravity", "inertia", "Coriolis", "friction"]
    total = np.sum(list(parts.values()), axis=0)
    np.testing.assert_allclose(total, prediction.predicted, atol=1e-6 * np.abs(prediction.predicted).max())


def test_curves_of_joints_differ_without_their_colours():
    from agent.pages import joint_series

    series = joint_series([f"joint_{k}" for k in range(1, 8)], np.zeros((2, 7)))
    assert len({one.dash for one in series}) == 7
