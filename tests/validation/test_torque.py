"""Torque prediction on unseen motions."""

import json
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.estimation import EstimationSettings, FilterSettings, estimate, motions
from agent.model import ModelEffect
from agent.pipeline import validation_text
from agent.robot import load_robot
from agent.validation import flipped_joints, pooled_rmse, predict_log, predicts, same_scale, summary, validate
from tests.estimation.conftest import _log


@pytest.fixture(scope="module")
def case():
    """The NS16, a rough model of it, and two logs: one moving, one stationary for half of the time."""
    robot = load_robot("comau_ns16")
    rng = np.random.default_rng(0)
    t = np.arange(4000) / 500
    frequency, phase = rng.uniform(0.2, 0.8, (2, 1, 6)) * [[[1]], [[6]]]
    logs = []
    for name, stop in (("moving.mcap", np.inf), ("resting.mcap", 4.0)):
        time = np.minimum(t, stop)[:, None]
        q = 0.3 * np.sin(2 * np.pi * frequency * time + phase)
        qd = np.gradient(q, t, axis=0)
        torque = 300 * np.cos(q) + 40 * np.sign(np.round(qd, 9)) + 30 * np.gradient(qd, t, axis=0)
        logs.append(_log(robot, t, q, torque + rng.normal(size=q.shape), name))
    return robot, estimate(robot, logs[:1], EstimationSettings.create(method="weighted")), logs


def on_joint(log, joint, change):
    """The log with the torque of one joint changed."""
    effort = log.effort.copy()
    effort[:, joint] = change(effort[:, joint])
    return replace(log, effort=effort)


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
    model = replace(model, cutoff=20.0, order=4)
    result = validate(model, logs[1:])
    motion = next(motions(logs[1], FilterSettings(20.0, 4), reduce=False))
    measured = motion.low_pass(motion.torque)
    error = measured - motion.low_pass(model.predict(motion.q, motion.qd, motion.qdd))
    entry = result.logs[0]
    assert entry.samples == len(measured)
    assert np.allclose(entry.rmse, np.sqrt(np.mean(error**2, axis=0)))
    assert np.allclose(entry.normalised_rmse, np.array(entry.rmse) / robot.nominal_torque)
    assert np.allclose(entry.relative_error, np.linalg.norm(error, axis=0) / np.linalg.norm(measured, axis=0))
    assert entry.relative_error_all_joints == pytest.approx(np.linalg.norm(error) / np.linalg.norm(measured))


def test_the_torque_of_a_joint_that_its_brake_holds_is_no_error(case):
    """It is reported as zero; the arm's weight rests on the brake."""
    _, model, (moving, resting) = case
    position = resting.position.copy()
    position[:, 1] = 0.5
    parked = on_joint(replace(resting, position=position, velocity=None), 1, lambda torque: 0 * torque)
    driven = on_joint(parked, 1, lambda torque: torque + 1e-3 * np.sin(np.arange(len(torque))))
    assert validate(model, [driven]).overall.rmse[1] > 100
    entry = validate(model, [parked]).overall
    assert (entry.rmse[1], entry.relative_error[1]) == (0.0, None)
    assert validate(model, [moving, parked]).overall.rmse[1] == pytest.approx(validate(model, [moving]).overall.rmse[1])


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
    assert np.allclose(resting.rmse(), np.sqrt(np.mean(resting.error**2, axis=0)))


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


@pytest.mark.parametrize("silent", [[2], [0, 1, 2, 3, 4, 5]])
def test_undefined_figures_are_null(case, silent):
    """Without a nominal torque, or of joints without torque."""
    robot, model, logs = case
    bare = replace(robot, joints=tuple(replace(joint, nominal_motor_torque=None) for joint in robot.joints))
    prediction = predict_log(replace(model, robot=bare), logs[0])
    measured = prediction.measured * ~np.isin(np.arange(6), silent)
    result = summary([replace(prediction, measured=measured)])
    assert result.overall.normalised_rmse == (None,) * 6
    assert [value is None for value in result.overall.relative_error] == [joint in silent for joint in range(6)]
    assert (result.overall.relative_error_all_joints is None) == (
        "all joints: - of measured torque" in validation_text(result)
    )
    assert (result.overall.relative_error_all_joints is None) == (len(silent) == 6)
    assert np.all(np.isfinite(result.overall.rmse))


def test_reports_why_a_log_cannot_be_validated(case):
    """Torque of one joint that is zero throughout has no relative error; that of all joints is none."""
    _, model, logs = case
    found = validate(model, [on_joint(logs[0], 2, np.zeros_like)]).overall.relative_error
    assert [value is None for value in found] == [joint == 2 for joint in range(6)]
    for change, message in (
        ({"effort": np.zeros_like(logs[0].effort)}, "the torque is zero throughout"),
        ({"effort": None}, r"moving\.mcap: no torque"),
        ({"joint_names": ("a",)}, r"moving\.mcap: its joints are"),
    ):
        with pytest.raises(InputError, match=message):
            validate(model, [replace(logs[0], **change)])
    with pytest.raises(InputError, match="cut-off of 400 Hz"):
        validate(model, logs, 400.0)


def test_a_model_predicts_what_errs_little_as_its_torque_varies_or_as_the_model_usually_does(case):
    """A constant error leaves the variation of the torque as it is."""
    _, model, (log, _) = case
    found = predict_log(model, log)
    size = np.std(found.measured[:, 2])
    usual, careless = (replace(model, held_out_rmse=np.full(6, part * size)) for part in (0.0, 0.25))
    assert np.median(np.abs(found.error[:, 2])) < 0.07 * size
    for expects, good, bad in ((usual, 0.28, 0.42), (careless, 0.42, 0.57)):
        little, much = (on_joint(log, 2, lambda torque, share=share: torque + share * size) for share in (good, bad))
        told = [predicts(expects, logs) for logs in ([little], [log, little, little], [much], [log, much, much])]
        assert told == [True, True, False, False]
    assert not predicts(model, [replace(log, effort=None)])


def test_what_a_joint_does_while_it_stands_says_nothing_of_its_channel(case):
    robot, model, (log, resting) = case
    late = resting.between(3.0, 8.0)
    assert predicts(model, [on_joint(late, 2, lambda torque: torque + 1000.0 * (late.t > 4.0))])
    assert not predicts(model, [on_joint(late, 2, lambda torque: torque + 1000.0)])
    held = replace(log, position=np.where(np.arange(6) == 2, 0.1, log.position))
    assert robot.joint_names[2] not in flipped_joints(model, replace(held, effort=-log.effort))
    everything = replace(log, position=0 * log.position, effort=-log.effort)
    assert not predicts(model, [everything])
    assert flipped_joints(model, everything) == []


@pytest.mark.parametrize(
    ("path", "told"),
    [
        (lambda t: 0.006 * np.sin(3 * t), True),
        (lambda t: 0.004 * np.sin(3 * t), False),
        (lambda t: 0.002 * t, False),
    ],
    ids=["moves", "travels less than a hundredth of a radian", "creeps"],
)
def test_a_joint_tells_of_its_channel_by_how_far_and_how_fast_it_moves(case, path, told):
    robot, model, (log, _) = case
    position = np.where(np.arange(6) == 2, 0.1 + path(log.t[:, None]), log.position)
    velocity = np.gradient(position, log.t, axis=0)
    torque = model.predict(position, velocity, np.gradient(velocity, log.t, axis=0))
    turned = on_joint(replace(log, position=position, effort=torque), 2, np.negative)
    assert flipped_joints(model, turned) == ([robot.joint_names[2]] if told else [])
    assert predicts(model, [turned]) is not told


def test_a_joint_whose_torque_is_of_the_other_sign_is_named(case):
    robot, model, (log, _) = case
    nothing, size = replace(model, values=0 * model.values), np.arange(len(log.t)) % 500 < 50
    assert flipped_joints(model, log) == flipped_joints(model, replace(log, effort=None)) == []
    for joint, name in ((1, robot.joint_names[1]), (4, robot.joint_names[4])):
        assert flipped_joints(model, on_joint(log, joint, np.negative)) == [name]
        assert flipped_joints(model, on_joint(log, joint, lambda torque: -5 * torque)) == []
        assert name not in flipped_joints(nothing, on_joint(log, joint, lambda torque: 1e3 * size)), "rare spikes"
        spikes = 8 * size * np.median(np.abs(log.effort[:, joint]))
        assert name not in flipped_joints(model, on_joint(log, joint, lambda torque, more=spikes: more - torque))


def test_torque_is_of_another_unit_from_a_factor_of_four_where_most_is_carried(case):
    _, model, (log, _) = case
    most = int(np.argmax(np.median(np.abs(predict_log(model, log).predicted), axis=0)))
    for factor in (3.5, 4.5):
        for scale in (factor, 1 / factor):
            assert same_scale(model, [on_joint(log, most, lambda torque, scale=scale: scale * torque)]) is (factor < 4)
    assert same_scale(model, [on_joint(log, (most + 1) % 6, lambda torque: 100 * torque)])
    assert not same_scale(model, [replace(log, effort=None)])


def test_a_prediction_has_the_motion_and_what_gravity_acceleration_and_speed_take_of_it(case):
    _, model, (log, _) = case
    effect, log = ModelEffect("torque_offset", ("joint_2",), {"offset": 7.0}), log.between(0.0, 3.0)
    found = predict_log(replace(model, effects=(effect,)), log)
    q, qd, qdd = found.position, found.velocity, found.acceleration
    rows = np.rint(found.time * log.sample_rate).astype(int)
    close = np.testing.assert_allclose
    close(q, log.position[rows], atol=2e-3)
    close(qd, np.gradient(log.position, log.t, axis=0)[rows], atol=0.02)
    close(qdd, np.gradient(qd, found.time, axis=0), atol=0.3)
    still, base = np.zeros_like(q), model.base_values
    gravity = model.rigid.torque(q, still, still, base)
    expected = {"gravity": gravity, "effects": np.tile([0, 7.0, 0, 0, 0, 0], (len(q), 1))}
    expected |= {"inertia": model.rigid.torque(q, still, qdd, base) - gravity}
    expected |= {"Coriolis": model.rigid.torque(q, qd, still, base) - gravity}
    for name, part in expected.items():
        size = np.sqrt(np.mean(part**2, axis=0)).max()
        close(found.parts[name][200:-200], part[200:-200], atol=0.05 * size, err_msg=name)
    close(np.sum(list(found.parts.values()), axis=0), found.predicted, atol=1e-6)
    bare = predict_log(model, log)
    again = bare.by(found.model)
    close(bare.by(replace(model, values=2 * model.values)).friction, 2 * bare.friction, atol=1e-9)
    assert again.model is found.model
    for name, other in (("predicted", found), ("half_width", found), ("friction", bare), ("measured", bare)):
        close(getattr(again, name), getattr(other, name), atol=1e-9)


def test_bounds_are_those_of_the_model_along_the_filtered_motion(case):
    """Twice the deviations of everything are twice the width."""
    _, model, (log, _) = case
    wider = replace(model, covariance=4 * model.covariance, group_rmse=2 * model.group_rmse)
    one, other = (predict_log(each, log.between(0.0, 2.0)).half_width for each in (model, wider))
    np.testing.assert_allclose(other, 2 * one, rtol=1e-6)
