"""What the search for a motion reaches: pairs that differ only at low speed, by speed, by posture, by load, or warm."""

from dataclasses import replace

import numpy as np
import pytest

from agent.core import InputError
from agent.diagnosis import diagnose
from agent.experiment.pieces import GridMotion
from agent.experiment.questions import Alternative, OpenPair
from agent.experiment.scorer import ExperimentScorer
from agent.model import CATALOGUE, PAYLOAD, NominalModel, carrying, payload_of, payload_text
from agent.robot import Dynamics
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

LOAD = payload_of("4 kg, 0 mm, 20 mm, 60 mm")
HEAVY = payload_of("20 kg, 250 mm, 0 mm, 0 mm")


@pytest.fixture(scope="module")
def healthy():
    """A diagnosis of an arm as its model has it."""
    arm = make_arm("RR")
    return diagnose(arm, [record(Plant(arm, seed=3), name, seed) for name, seed in (("a", 21), ("b", 22))], learn(arm))


def swing(amplitude: float, period: float, seconds: float = 8.0, joint: int = 1) -> GridMotion:
    """One joint to and fro."""
    time = np.arange(0, seconds, 0.01)
    w, a = 2 * np.pi / period, np.zeros(2)
    a[joint] = amplitude
    phase = w * time[:, None]
    return GridMotion(time, a * np.sin(phase), a * w * np.cos(phase), -a * w**2 * np.sin(phase))


def evidence(found, truth, rival, motion: GridMotion, payload=None) -> float:
    """Log evidence that a motion adds for a form taken for true, (name, joint, settings, values), over its rival."""
    fit, sides = found.dataset.fit, []
    for name, joint, settings, values in (truth, rival):
        (candidate,) = fit.candidates([(CATALOGUE[name], (joint,), settings)])
        sides.append(Alternative(name, (f"joint_{joint + 1}",), candidate, np.asarray(values, dtype=float)))
    scorer = ExperimentScorer(found.dataset, found.selected.evidence, [OpenPair(*sides)], payload)
    after, before = (scorer.evidence(told)[0, 0] for told in (scorer.information_of(motion), scorer.nothing))
    return float(after - before)


CHANGED = ("friction_change", 1, {"coulomb": 1.0, "viscous": 1.0}, (1.0, 0.0))
PAIRS = {
    "slow": (("stribeck", 1, {"speed": 0.05, "shape": 1.0}, (1.0,)), CHANGED, swing(0.1, 8.0), swing(0.4, 1.0)),
    "speeds": (
        ("asymmetric_friction", 1, {"coulomb": 1.0, "viscous": 1.0}, (0.0, 1.0)),
        ("torque_offset", 1, {}, (1.0,)),
        swing(0.05, 8.0),
        swing(0.25, 2.0),
    ),
    "posture": (
        ("gravity_spring", 1, {"harmonics": 1.0}, (1.0, 1.0)),
        ("torque_offset", 1, {}, (1.0,)),
        swing(1.2, 8.0),
        swing(0.05, 8.0),
    ),
    "reversals": (("presliding", 1, {"travel": 0.02}, (1.0,)), CHANGED, swing(0.05, 2.0), swing(1.2, 16.0)),
}


@pytest.mark.parametrize("kind", PAIRS)
def test_a_motion_that_separates_two_effects_gains_evidence(healthy, kind):
    truth, rival, telling, other = PAIRS[kind]
    assert evidence(healthy, truth, rival, telling) > 2 * evidence(healthy, truth, rival, other)


def test_a_known_mass_separates_load_dependent_friction(healthy):
    truth = ("load_dependent_friction", 1, {}, (0.1,))
    motion = swing(0.05, 4.0)  # in one posture
    assert evidence(healthy, truth, CHANGED, motion, HEAVY) > 2 * evidence(healthy, truth, CHANGED, motion)


def test_a_planned_motion_starts_at_the_last_logs_temperature(healthy):
    warm = ("thermal_friction", 1, {"time_constant": 2.0, "session": 1.0}, (0.0, 1.0, 0.0, 0.0))
    cold = ("thermal_friction", 1, {"time_constant": 2.0}, (0.0, 1.0, 0.0, 0.0))
    motion = swing(0.3, 2.0)
    nothing = ("torque_offset", 0, {}, (1.0,))
    assert evidence(healthy, warm, nothing, motion) < 0.01 * evidence(healthy, cold, nothing, motion)


def test_the_model_carries_a_known_mass():
    arm = make_arm("RRR")
    model = learn(arm)
    rng = np.random.default_rng(1)
    q, qd, qdd = rng.uniform(-1, 1, (3, 20, 3))
    before, after = (one.rigid.torque(q, qd, qdd, one.base_values) for one in (model, carrying(model, LOAD)))
    bare, loaded = (Dynamics(arm, tool).inverse_dynamics(q, qd, qdd) for tool in (None, LOAD))
    assert after - before == pytest.approx(loaded - bare, abs=1e-9)
    assert NominalModel(model, LOAD).model.base_values == pytest.approx(carrying(model, LOAD).base_values)
    assert payload_text(payload_of(payload_text(LOAD))) == payload_text(LOAD)


@pytest.mark.parametrize(
    "text", ["5 kg", "5 kg, 0, 0", "0 kg, 0, 0, 0", "-1 kg, 0, 0, 0", "5 m, 0, 0, 0", "5 kg, 0, 0, 90 m"]
)
def test_refuses_an_invalid_payload(text):
    with pytest.raises(InputError, match="payload"):
        payload_of(text)


def test_a_stated_payload_is_not_a_gap_but_an_unstated_one_is(healthy):
    arm, model = healthy.dataset.robot, healthy.dataset.model
    x, y, z = LOAD.centre_of_mass
    mass = {"effect": "payload", "parameters": {"mass": LOAD.mass, "centre": [x, y, z]}}
    bare = record(Plant(arm, seed=3), "bare", 31)
    silent = record(Plant(arm, seed=3, effects=[mass]), "loaded", 32)
    said = replace(silent, metadata={**silent.metadata, PAYLOAD: payload_text(LOAD)})
    assert diagnose(arm, [bare, said], model).result["verdict"] == "no_gap"
    assert diagnose(arm, [bare, silent], model).result["verdict"] != "no_gap"
    with pytest.raises(InputError, match="name one with --model"):
        diagnose(arm, [bare, said])
