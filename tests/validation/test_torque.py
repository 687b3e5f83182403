"""Torque prediction on unseen motions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.estimation import EstimationSettings, estimate
from agent.estimation.filtering import FilterSettings, motions
from agent.pipeline import validation_text
from agent.recording.log import Log
from agent.robot import load_robot
from agent.validation import pooled_rmse, predict_log, summary, validate


def _log(robot, path, t, q, torque):
    return Log(path, robot.joint_names, t, q, None, torque, None, None, 500.0, 0.0, ((0, len(t)),))


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The NS16, a rough model of it, and two logs: one moving, one stationary for half of the time."""
    robot = load_robot("comau_ns16")
    rng = np.random.default_rng(0)
    folder = tmp_path_factory.mktemp("logs")
    t = np.arange(4000) / 500
    frequency, phase = rng.uniform(0.2, 0.8, (2, 1, 6)) * [[[1]], [[6]]]
    logs = []
    for name, stop in (("moving.mcap", np.inf), ("resting.mcap", 4.0)):
        time = np.minimum(t, stop)[:, None]
        q = 0.3 * np.sin(2 * np.pi * frequency * time + phase)
        qd = np.gradient(q, t, axis=0)
        torque = 300 * np.cos(q) + 40 * np.sign(np.round(qd, 9)) + 30 * np.gradient(qd, t, axis=0)
        logs.append(_log(robot, folder / name, t, q, torque + rng.normal(size=q.shape)))
    return robot, estimate(robot, logs[:1], EstimationSettings.create(method="weighted")), logs


def test_the_result_has_the_documented_keys(case):
    robot, model, logs = case
    result = json.loads(json.dumps(validate(model, logs, 20.0).to_dict(), allow_nan=False))
    assert set(result) == {"schema", "joints", "cutoff_hz", "logs", "overall"}
    assert result["schema"] == "validation/1"
    assert result["joints"] == list(robot.joint_names)
    assert result["cutoff_hz"] == 20.0
    figures = {"rmse", "normalised_rmse", "relative_error", "relative_error_all_joints"}
    assert [set(entry) for entry in result["logs"]] == [figures | {"log", "samples"}] * 2
    assert [entry["log"] for entry in result["logs"]] == ["moving.mcap", "resting.mcap"]
    assert set(result["overall"]) == figures


def test_figures_are_computed_from_filtered_signals(case):
    robot, model, logs = case
    result = validate(model, logs[1:])
    motion = next(motions(logs[1], FilterSettings(model.cutoff), reduce=False))
    measured = motion.low_pass(motion.torque)
    error = measured - motion.low_pass(model.predict(motion.q, motion.qd, motion.qdd))
    entry = result.logs[0]
    assert entry.samples == len(measured)
    assert np.allclose(entry.rmse, np.sqrt(np.mean(error**2, axis=0)))
    assert np.allclose(entry.normalised_rmse, np.array(entry.rmse) / robot.nominal_torque)
    assert np.allclose(entry.relative_error, np.linalg.norm(error, axis=0) / np.linalg.norm(measured, axis=0))
    assert entry.relative_error_all_joints == pytest.approx(np.linalg.norm(error) / np.linalg.norm(measured))


def test_every_sample_but_the_edges_counts_and_logs_are_pooled(case):
    _, model, logs = case
    result = validate(model, logs)
    samples = [entry.samples for entry in result.logs]
    assert min(samples) > 4000 - 2 * 500 * 0.25
    squares = [np.array(entry.rmse) ** 2 * entry.samples for entry in result.logs]
    assert np.allclose(np.array(result.overall.rmse) ** 2 * sum(samples), sum(squares))
    assert summary([predict_log(model, log) for log in logs]) == result


def test_moving_samples_exclude_standstill(case):
    _, model, logs = case
    moving, resting = (predict_log(model, log) for log in logs)
    assert moving.moving.mean() > 0.99
    assert 0.45 < resting.moving.mean() < 0.55
    assert np.all(resting.time[resting.moving] < 4.2)
    error = resting.error[resting.moving]
    assert np.allclose(resting.rmse(moving=True), np.sqrt(np.mean(error**2, axis=0)))


def test_the_gate_pools_the_moving_samples_of_all_motions(case):
    """Torque at standstill is anything within stiction, so an error there changes nothing."""
    _, model, logs = case
    predictions = [predict_log(model, log) for log in logs]
    error = np.concatenate([p.error[p.moving] for p in predictions])
    expected = np.sqrt(np.mean(error**2, axis=0))
    assert pooled_rmse(predictions) == pytest.approx(expected)
    stuck = [replace(p, measured=p.measured + 1000.0 * ~p.moving[:, None]) for p in predictions]
    assert pooled_rmse(stuck) == pytest.approx(expected)


def test_bounds_hold_most_of_an_unseen_motion(case):
    _, model, logs = case
    seen = predict_log(model, logs[1])
    assert seen.half_width.shape == seen.error.shape
    inside = np.mean(np.abs(seen.error[seen.moving]) < seen.half_width[seen.moving])
    assert inside > 0.85


def test_undefined_figures_are_null(case):
    robot, model, logs = case
    bare = replace(robot, joints=tuple(replace(joint, nominal_motor_torque=None) for joint in robot.joints))
    effort = logs[0].effort.copy()
    effort[:, 2] = 0.0
    result = validate(replace(model, robot=bare), [replace(logs[0], effort=effort)])
    assert result.overall.normalised_rmse == (None,) * 6
    assert [value is None for value in result.overall.relative_error] == [joint == 2 for joint in range(6)]
    assert np.all(np.isfinite(result.overall.rmse))


def test_figures_of_zero_torque_are_null(case):
    robot, model, logs = case
    bare = replace(robot, joints=tuple(replace(joint, nominal_motor_torque=None) for joint in robot.joints))
    prediction = predict_log(replace(model, robot=bare), logs[0])
    result = summary([replace(prediction, measured=np.zeros_like(prediction.measured))])
    assert result.overall.normalised_rmse == (None,) * 6
    assert result.overall.relative_error == (None,) * 6
    assert result.overall.relative_error_all_joints is None
    assert np.all(np.isfinite(result.overall.rmse))
    assert "all joints: - at" in validation_text(result)


def test_refuses_torque_that_is_always_zero(case):
    _, model, logs = case
    with pytest.raises(InputError, match="the torque is zero throughout"):
        validate(model, [replace(logs[0], effort=np.zeros_like(logs[0].effort))])


def test_reports_why_a_log_cannot_be_validated(case):
    _, model, logs = case
    with pytest.raises(InputError, match=r"moving\.mcap: no torque"):
        validate(model, [replace(logs[0], effort=None)])
    with pytest.raises(InputError, match=r"moving\.mcap: its joints are"):
        validate(model, [replace(logs[0], joint_names=("a",))])
    with pytest.raises(InputError, match="cut-off of 400 Hz"):
        validate(model, logs, 400.0)
