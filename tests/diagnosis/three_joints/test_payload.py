"""A weight at the flange, also where torque that is scaled wrongly makes its inertia, and where it was taken off."""

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis import diagnose
from agent.estimation import estimate
from agent.model import PAYLOAD as SAYS
from agent.model.effects import CATALOGUE
from agent.pages.diagnosis.page import about_diagnosis
from agent.robot import ParameterLayout
from agent.robot.dynamics import Dynamics
from fake_controller.plant import Plant
from tests.small_arms import record

MASS = 3.0  # kg
BALL = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
PAYLOAD = CATALOGUE["payload"]
CLAIMED = "6 kg, 0 mm, 0 mm, 60 mm"


@pytest.mark.parametrize(("inertia", "is_point"), [(0.0, False), (-0.06, True)])
def test_a_load_becomes_a_point_mass_instead_of_a_negative_inertia(arm, model, inertia, is_point):
    plant = Plant(arm, seed=3, effects=[{"effect": "payload", "parameters": {"mass": MASS}}])
    last = ParameterLayout.of(arm, rotors=False).link(arm.dof - 1)
    logs = []
    for name, seed in (("one", 21), ("two", 22)):
        log = record(plant, name, seed)
        acceleration = np.gradient(log.velocity, log.t, axis=0)
        ball = Dynamics(arm).regressor(log.position, log.velocity, acceleration)[:, :, last] @ (inertia * BALL)
        logs.append(replace(log, effort=log.effort + ball))
    found = diagnose(arm, logs, model)
    assert found.result["verdict"] in ("explained", "ambiguous")  # a link may have any inertia, a weight may not
    cause = found.result["causes"][0]
    assert cause["effect"] == "payload"
    parameters = cause["parameters"]
    assert parameters["mass"] == pytest.approx(MASS, rel=0.1)
    assert ("inertia" not in parameters) == is_point
    settings = {name: value for name, value in parameters.items() if name not in PAYLOAD.names(parameters)}
    assert PAYLOAD.plausible(settings, parameters)


@pytest.mark.verify
def test_a_removed_load_has_negative_mass(arm):
    carries = Plant(arm, seed=3, effects=[{"effect": "payload", "parameters": {"mass": MASS}}])
    model = estimate(arm, [record(carries, "first", 11), record(carries, "second", 12)])
    bare = Plant(arm, seed=3)
    found = diagnose(arm, [record(bare, "one", 21), record(bare, "two", 22)], model)
    assert found.result["verdict"] == "explained"
    (cause,) = found.result["causes"]
    assert cause["effect"] == "payload"
    assert cause["parameters"]["mass"] == pytest.approx(-MASS, rel=0.1)


def test_names_a_mass_that_only_a_log_claims_if_nothing_explains_the_gap(arm, model):
    """More friction in both motions, and a mass that one of them claims and that nobody mounted."""
    effect = {"effect": "friction_change", "joints": ["joint_2"], "parameters": {"coulomb": 1.6}}
    plant = Plant(arm, seed=3, effects=[effect])
    first, second = (record(plant, name, seed) for name, seed in (("one", 21), ("two", 22)))
    found = diagnose(arm, [first, replace(second, metadata={**second.metadata, SAYS: CLAIMED})], model)
    assert found.result["verdict"] == "unknown"
    (said,) = [text for text in found.warnings if CLAIMED in text]
    assert said == f"two.mcap says that {CLAIMED} were at the flange: if they were not, the gap may be that"
    assert ("mass at the flange", f"{CLAIMED} (two.mcap)") in about_diagnosis(found, [], found.result).identity
