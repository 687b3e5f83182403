"""What logs leave open: a joint that moves too little, a range that was never fitted, positions that are rounded."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.diagnosis import diagnose
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.rounding import rounding_noise, rounding_step
from agent.estimation import beyond_fit
from agent.model import CATALOGUE, IdentifiedModel, NominalModel
from agent.validation import predict_log
from fake_controller.plant import Plant
from tests.small_arms import record

PARKED = (1.0, 1.0, 0.001)


@pytest.fixture(scope="module")
def parked(arm):
    """Two logs in which the last joint moves by 2 mrad."""
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed, PARKED) for name, seed in (("one", 21), ("two", 22))]


@pytest.mark.parametrize("torque", ["of its angle", "of its speed"])
def test_a_stationary_joint_has_no_cause(parked, arm, model, torque):
    logs = []
    for log in parked:
        effort = log.effort.copy()
        moved = log.position[:, 2] - log.position[0, 2] if torque == "of its angle" else log.velocity[:, 2]
        effort[:, 2] += 8.0 * moved / np.abs(moved).max()
        logs.append(replace(log, effort=effort))
    result = diagnose(arm, logs, model).result
    assert not [cause for cause in result["causes"] if "joint_3" in cause["joints"]]
    why = {(entry["effect"], entry["joint"]): entry["why"] for entry in result["not_testable"]}
    of_joints = [name for name, effect in CATALOGUE.items() if effect.scope == "joint"]
    assert {why[name, "joint_3"] for name in of_joints} == {"joint_3 never moves in these logs"}


def test_a_spring_needs_more_than_a_few_degrees_of_travel(arm, model):
    plant = Plant(arm, seed=3)
    logs = [record(plant, name, seed, (1.0, 1.0, 0.06)) for name, seed in (("one", 21), ("two", 22))]
    missing = {(e["effect"], e["joint"]): e["why"] for e in diagnose(arm, logs, model).result["not_testable"]}
    assert "0.2 rad (or 0.1 m) it takes" in missing["gravity_spring", "joint_3"]
    assert "0.2 rad (or 0.1 m) it takes" in missing["dress_pack", "joint_3"]
    assert "it takes" not in missing.get(("friction_change", "joint_3"), "")


def test_massless_links_have_no_resonance(arm, model, parked, monkeypatch):
    fit = assemble(arm, model, parked, None).fit
    for signals in fit.signals:
        monkeypatch.setitem(signals.__dict__, "mass", np.zeros((len(signals.time), arm.dof, arm.dof)))
    with np.errstate(all="raise"):
        assert [CATALOGUE[name].settings(fit, (0,)) for name in ("joint_elasticity", "backlash")] == [[], []]


@pytest.mark.parametrize("cause", ["of its angle", "a push"])
def test_torque_that_follows_a_short_travel_is_not_a_push(arm, model, cause):
    """A hose that grips late on a joint that turns by little; a push there is still one."""
    plant, logs = Plant(arm, seed=3), []
    for name, seed in (("one", 21), ("two", 22)):
        log = replace(record(plant, name, seed, (0.06, 1.0, 1.0)), cycle_starts=())
        way = log.position[:, 0] - np.median(log.position[:, 0])
        torque = 8.0 * np.clip(way / np.abs(way).max() - 0.5, 0, None)
        if cause == "a push":
            torque = 4.0 * np.clip(np.minimum(log.t - 3.2, 4.0 - log.t) / 0.05, 0, 1)
        effort = log.effort.copy()
        effort[:, 0] += torque
        logs.append(replace(log, effort=effort))
    result = diagnose(arm, logs, model).result
    assert [entry["effect"] for entry in result["causes"]] == ([] if cause == "of its angle" else ["contact"])
    assert result["verdict"] != "no_gap"


def test_a_finer_search_for_a_ripple_keeps_to_two_periods(arm, model):
    """Order by order a ripple would come to one slow wave, which any torque over the angle looks like."""
    logs = [record(Plant(arm, seed=3), name, seed, (0.06, 1.0, 1.0)) for name, seed in (("one", 21), ("two", 22))]
    fit, ripple = assemble(arm, model, logs, None).fit, CATALOGUE["torque_ripple"]
    travel = max(float(log.position[:, 0].max()) for log in logs) - min(float(log.position[:, 0].min()) for log in logs)
    assert all(ripple.shown(fit, (0,), settings) for settings in ripple.settings(fit, (0,)))
    for periods in (0.5, 1.8, 2.2, 5.0):
        order = 2 * np.pi * periods / travel
        assert ripple.shown(fit, (0,), {"order": order, "harmonics": 1.0}) == (periods > 2)
    refined = Search(fit, tuple({*CATALOGUE} - {"torque_ripple"})).run()
    for candidate in (candidate for block in refined.evidence.pool.blocks for candidate in block.candidates):
        assert ripple.shown(fit, candidate.joints, candidate.settings)


USUAL, WIDE = (0.5, 0.5, 0.5), (0.5, 0.5, 3.0)


@pytest.fixture(scope="module")
def logs(arm):
    plant = Plant(arm, seed=3)
    return {share: [record(plant, f"{seed}", seed, share) for seed in (21, 22)] for share in (USUAL, WIDE)}


def test_warns_if_logs_leave_the_fitted_range(arm, model, logs):
    assert not [text for text in diagnose(arm, logs[USUAL], model).warnings if "fitted" in text]
    faster, further = (text for text in diagnose(arm, logs[WIDE], model).warnings if "fitted" in text)
    assert "go faster" in faster
    assert "joint_3 at up to" in faster
    assert "where the model was never fitted" in further
    assert "joint_3 between" in further
    assert "joint_1" not in faster + further


def test_the_fitted_range_is_saved_and_never_guessed(model, logs, tmp_path):
    model.save(tmp_path / "model.json")
    loaded = IdentifiedModel.load(tmp_path / "model.json")
    predicted = [predict_log(loaded, log) for log in logs[WIDE]]
    motions = [(each.position, each.velocity) for each in predicted]
    assert len(list(beyond_fit(loaded, motions))) == 2
    del loaded.provenance["range"]
    assert not list(beyond_fit(loaded, motions))


def test_reports_a_large_error_of_the_model_itself(arm, model, logs):
    assert not [text for text in diagnose(arm, logs[USUAL], model).warnings if "the model errs by" in text]
    size = np.sqrt(np.mean(logs[USUAL][0].effort ** 2, axis=0))
    (said,) = (
        text
        for text in diagnose(arm, logs[USUAL], replace(model, held_out_rmse=0.4 * size)).warnings
        if "the model errs by" in text
    )
    assert "smaller gaps do not show" in said


STEP = 1e-4


@pytest.fixture(scope="module")
def recorded(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]


def rounded(log):
    return replace(log, position=STEP * np.round(log.position / STEP), velocity=None)


def test_predicts_the_size_of_rounding_noise(recorded, model):
    log = recorded[0]
    fine, coarse = (predict_log(model, one, 30.0).predicted for one in (replace(log, velocity=None), rounded(log)))
    happened = np.sqrt(np.mean((coarse - fine) ** 2, axis=0))
    expected = rounding_noise(NominalModel(model), [rounded(log)], 30.0)
    assert expected == pytest.approx(happened, rel=0.5)


def test_rounding_is_not_a_gap_for_a_model_of_finer_logs(arm, model, recorded):
    rated = replace(arm, joints=tuple(replace(joint, nominal_motor_torque=0.6) for joint in arm.joints))
    result = diagnose(rated, [rounded(log) for log in recorded], replace(model, robot=rated)).result
    assert (result["verdict"], result["causes"]) == ("no_gap", [])


@given(st.floats(1e-6, 1e-2), st.floats(-3, 3), st.integers(0, 100))
def test_finds_the_rounding_step(step, offset, seed):
    counts = np.cumsum(np.random.default_rng(seed).integers(-3, 4, 500))
    assert rounding_step(offset + step * counts) == pytest.approx(step, rel=1e-3)
    assert rounding_step(np.random.default_rng(seed).normal(size=500)) == 0.0
