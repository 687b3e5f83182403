"""The gap in held-out error: the part that a cause explains, the repeatability, and no influence of standstill."""

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis.gap.torque_gap import held_out_gap
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.standstill import stiction
from agent.model.effects import CATALOGUE
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

OFFSET = {"effect": "torque_offset", "joints": ["joint_2"], "parameters": {"offset": 6.0}}


@pytest.fixture(scope="module")
def case():
    """Logs of a small arm with an effect against the model of the healthy one; and the fit with its cause."""
    robot = make_arm("RR")
    plant = Plant(robot, seed=3, effects=[OFFSET])
    data = assemble(robot, learn(robot), [record(plant, f"judged_{seed}", seed) for seed in (21, 22)], None)
    return data, with_offset(data, 1)


def with_offset(data, joint):
    return data.fit.with_chosen([data.fit.candidate(CATALOGUE["torque_offset"], (joint,), {})])


def test_the_true_cause_closes_the_gap(case):
    assert held_out_gap(*case).closure > 0.75


def test_a_cause_on_another_joint_does_not_close_the_gap(case):
    data, _ = case
    chosen = with_offset(data, 0)
    gap = held_out_gap(data, chosen)
    alone = gap.closure_without(chosen.held_out(without=0))
    assert alone < 0.25


def test_without_causes_no_gap_is_closed(case):
    gap = held_out_gap(case[0], case[0].fit).unclosed
    assert gap.closure == 0.0


def test_repeatability_is_the_difference_between_cycles(case):
    """Independent noise far above stiction is the repeatability; an error that repeats with every cycle is not."""
    (data, _), rng, size = case, np.random.default_rng(4), 1e5
    for repeats in (0.0, 5.0):
        noise = rng.normal(size=data.residual.shape) + repeats * np.sin(2 * np.pi * data.time / 5.0)[:, None]
        fit = data.fit.with_residual(size * noise / data.fit.sigma)
        noisy = replace(data, residual=size * noise, fit=fit, has_reference=False)
        gap = held_out_gap(noisy, fit, np.full(data.robot.dof, size))
        assert gap.floor == pytest.approx(np.ones(data.robot.dof), rel=0.05)


def test_stiction_of_either_sign_at_standstill_is_not_a_gap(case):
    """Twice the level from what is predicted: other joints stand while one of them is turned to and fro."""
    data, fit = case[0], case[0].fit
    level = stiction(fit.reference)
    assert np.all(level > 0)
    for part, most in ((1.9, 0.1), (4.0, 10.0)):
        fit = fit.with_residual(np.where(fit.near_rest, part * level / fit.sigma, 0.0))
        gap = held_out_gap(replace(data, fit=fit, residual=fit.near_rest * part * level), fit)
        assert np.all(gap.before * gap.unit < most * level)
    assert np.any(gap.before * gap.unit > 0.5 * level), "beyond that it is one"


def test_a_cause_is_scored_in_units_of_its_own_joint(case):
    """Of joints with far larger units hardly anything counts, where no nominal torque says what a joint is for."""
    data, fit = case
    (own,) = {joint for candidate in fit.chosen for joint in candidate.blocks}
    unit = np.full(data.robot.dof, 1.0)
    unit[own] = 1e4
    small, large = (held_out_gap(data, fit, one) for one in (unit, 1 / unit))
    assert large.closure > 0.9
    assert not small.closure, "what the other joints do not repeat is larger"
    np.testing.assert_allclose(large.before, held_out_gap(data, fit, np.ones(len(unit))).before * unit)
