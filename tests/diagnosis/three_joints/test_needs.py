"""A joint that did not move through what an effect needs gets none, and the result says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis import diagnose
from agent.diagnosis.rows.dataset import assemble
from agent.model import CATALOGUE
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
