"""Sections of a run's report; the paper's estimator next to the one that was used."""

from types import SimpleNamespace

import numpy as np
import pytest

from agent.estimation import EstimationSettings, estimate
from agent.pages import Page, Section, render
from agent.pages.calibration.paper_estimator import paper_section
from agent.pages.calibration.parameters import correlation, correlation_section
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


def test_the_papers_estimator_stands_next_to_ours(logs):
    robot, (fitted, unseen) = logs
    model = estimate(robot, [fitted], EstimationSettings.create(method="weighted", cutoff=20))
    predictions = [predict_log(model, unseen)]
    section = paper_section(model, fitted, predictions)
    rows = section.parts[0].rows
    assert [row[0] for row in rows] == list(robot.joint_names)
    paper = estimate(robot, [fitted], EstimationSettings.create(method="paper", cutoff=20))
    theirs = predict_log(paper, unseen).rmse(moving=True)
    assert [float(row[2]) for row in rows] == pytest.approx(theirs, rel=0.01)
    assert [float(row[1]) for row in rows] == pytest.approx(predictions[0].rmse(moving=True), rel=0.01)
    ratio = theirs / predictions[0].rmse(moving=True)
    assert [float(row[4]) for row in rows] == pytest.approx(ratio, abs=0.006)
    assert np.ptp(ratio) > 0.1 or np.all(np.abs(ratio - 1) > 0.1), "else an inverted ratio would look the same"
    assert paper_section(paper, fitted, predictions) is None
    assert "paper over this" in render(Page("t", "h", "plain", [section]))


def test_correlations_keep_their_sign():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 6))
    covariance = root @ root.T
    covariance[3] = covariance[:, 3] = 0.0
    found = correlation(covariance)
    deviation = np.sqrt(np.diag(covariance)[:3])
    assert found[:3, :3] * np.outer(deviation, deviation) == pytest.approx(covariance[:3, :3])
    assert found.min() < -0.1
    assert not found[3].any(), "a parameter without variance is correlated with nothing"


def test_the_strongest_pairs_are_listed_with_their_sign():
    covariance = np.array([[4.0, -1.96, 0.2], [-1.96, 1.0, 0.0], [0.2, 0.0, 1.0]])
    section = correlation_section(SimpleNamespace(covariance=covariance, names=("m_1", "f0_1", "f1_1")))
    assert section.parts[1].rows[:2] == [("m_1", "f0_1", "-0.980"), ("m_1", "f1_1", "+0.100")]
    assert section.text[0].startswith("1 of 3 pairs")
    assert section.parts[0].rows[1][1].title == "f0_1, m_1: -0.98"


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
