"""A description that lies: placeholder inertials must not spoil the estimate, nor must its absence."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from agent.estimation import EstimationSettings, estimate, placeholders
from agent.robot.bodies import rigid_bodies


def test_drops_and_reports_a_wrong_link_prior(arm, multisine, make_log):
    robot = arm(3)
    t = np.arange(10_000) / 500
    q, qd, qdd = multisine(3, t)
    rigid = rigid_bodies(robot)
    weights = 40 * rigid.dynamics.inverse_dynamics(q, qd, qdd) + 20 * qd  # forty times as heavy as it is described
    model = estimate(robot, [make_log(robot, t, q, weights)])
    assert model.provenance["link_prior"] != "description"
    assert any("left out of the prior" in note and "Gravity torque" in note for note in model.notes)
    assert model.held_out_rmse.max() < 0.02 * np.abs(weights).max()


@pytest.mark.parametrize(("factor", "believed"), [(1.0, True), (0.05, False)])
def test_a_description_confirmed_by_the_motion_is_used_as_a_prior(arm, multisine, make_log, factor, believed):
    robot = arm(6, seed=3002)
    t = np.arange(1000) / 50
    q, qd, qdd = multisine(6, t, seed=3002)
    sizes = np.array([40.0, 80, 50, 20, 12, 6])
    torque = rigid_bodies(robot).dynamics.inverse_dynamics(q, qd, qdd) + sizes * (0.1 * qd + 0.15 * np.sign(qd))
    torque += 0.02 * sizes * np.random.default_rng(1).normal(size=q.shape)
    said = re.sub(r'(mass value|i[xyz]{2})="([^"]*)"', lambda m: f'{m[1]}="{factor * float(m[2])}"', robot.urdf)
    model = estimate(replace(robot, urdf=said), [make_log(robot, t, q, torque)], EstimationSettings.create(cutoff=10))
    assert (model.provenance["link_prior"] == "description") == believed


def test_links_of_equal_mass_are_placeholders():
    def links(*masses: float) -> np.ndarray:
        return np.concatenate([[mass, *[0.1 * mass] * 9] for mass in masses])

    assert placeholders(links(0, 0, 0))
    assert placeholders(links(3, 3, 3, 3, 3, 3.2))
    assert not placeholders(links(3.7, 8.4, 2.3, 1.2, 1.2, 0.2))
    assert not placeholders(links(5.0))
