"""A description without masses, or with made-up ones: the diagnosis works on what the fit says of the links."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agent.estimation import EstimationSettings, estimate
from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects import CATALOGUE
from agent.model.standard_parameters import from_pseudo_inertia, pseudo_inertia
from agent.robot.bodies import rigid_bodies


def fitted(replacement):
    """A nominal model of a three-joint arm whose description has other inertials or none, and a motion of it."""
    from tests.estimation.conftest import _arm, _links, _log, _multisine

    robot = _arm(3)
    t = np.arange(3000) / 250
    q, qd, qdd = _multisine(3, t)
    torque = _links(robot, q, qd, qdd) + 3 * np.tanh(qd / 0.01) + 0.5 * np.random.default_rng(1).normal(size=q.shape)
    bare = replace(robot, urdf=re.sub(r"<inertial>.*?</inertial>", replacement, robot.urdf))
    model = estimate(bare, [_log(bare, t, q, torque)], EstimationSettings.create(cutoff=10, method="weighted"))
    return NominalModel(model), MotionSignals(NominalModel(model), t, q, qd, qdd)


@pytest.fixture(scope="module")
def massless():
    return fitted("")


def test_placeholder_links_are_physical_bodies(massless):
    nominal, signals = massless
    for block in nominal.solid.standard_parameters().reshape(-1, 10):
        assert np.linalg.eigvalsh(pseudo_inertia(block)).min() > 0
        assert np.allclose(from_pseudo_inertia(pseudo_inertia(block)), block)
    assert np.all(np.diagonal(signals.mass, axis1=1, axis2=2) > 0)


@pytest.mark.parametrize("name", ["joint_elasticity", "backlash"])
def test_a_link_on_a_spring_has_finite_columns(massless, name):
    _, signals = massless
    settings = {"stiffness": 1e4, "damping": 0.1, **({"gap": 1e-3} if name == "backlash" else {})}
    with np.errstate(all="raise"):
        columns = CATALOGUE[name].columns(signals, (1,), settings)
    assert all(np.isfinite(block).all() for block in columns.values())


def placeholder(kilograms):
    moment = 0.01 * kilograms
    inertia = f'<inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>'
    return f'<inertial><mass value="{kilograms}"/>{inertia}</inertial>'


def deviation(nominal):
    """[kg] that each link may weigh otherwise."""
    context, effect = SimpleNamespace(reference=nominal), CATALOGUE["inertial_mismatch"]
    return [1 / np.sqrt(effect.prior_precision(context, (), place)[0, 0]) for place in effect.settings(context, ())]


def test_known_links_may_deviate_by_half_their_mass():
    nominal, _ = fitted(r"\g<0>")
    described = rigid_bodies(nominal.robot).dynamics.standard_parameters()[::10]
    assert deviation(nominal) == pytest.approx(0.5 * described)


@pytest.mark.parametrize("kilograms", [None, 0.01, 1.0, 3.0])
def test_unknown_links_may_deviate_by_the_weight_the_arm_carries(massless, kilograms):
    """By as much as what the arm holds up, which is all that is known of their size: links that stand in for unknown
    ones say nothing of it."""
    nominal, signals = massless if kilograms is None else fitted(placeholder(kilograms))
    weight = np.abs(nominal.links.inverse_dynamics(signals.q, 0 * signals.q, 0 * signals.q)).max()
    for mass in deviation(nominal):
        assert 0.1 < mass * 9.81 / weight < 10, "a lever of a tenth of a metre to ten metres"
