"""The gap in held-out error: the part that a cause explains, the repeatability, and no influence of standstill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis.gap.torque_gap import held_out_gap
from agent.diagnosis.rows.dataset import stiction
from agent.model.effects import CATALOGUE


@pytest.fixture(scope="module")
def dataset(diagnosed):
    """The diagnosis of the run with an effect; its cause was found."""
    found = diagnosed(1)
    assert found.finding.causes
    return found


def test_the_true_cause_closes_the_gap(dataset):
    assert held_out_gap(dataset.dataset, dataset.finding.fit).closure > 0.75


def test_a_cause_on_another_joint_does_not_close_the_gap(dataset):
    fit = dataset.dataset.fit
    (wrong,) = {c.joints for c in dataset.finding.causes}
    other = tuple((joint + 1) % fit.reference.robot.dof for joint in wrong)
    candidate = fit.candidate(CATALOGUE["torque_offset"], other, {})
    chosen = fit.with_chosen([candidate])
    gap = held_out_gap(dataset.dataset, chosen)
    alone = gap.closure_without(chosen.out_of_fold(chosen.once, 0))
    assert alone < 0.25


def test_without_causes_no_gap_is_closed(dataset):
    gap = held_out_gap(dataset.dataset, dataset.dataset.fit).unclosed
    assert gap.closure == 0.0


def test_repeatability_is_the_difference_between_cycles(dataset):
    """Independent noise far above stiction is the repeatability; an error that repeats with every cycle is not."""
    data, rng, size = dataset.dataset, np.random.default_rng(4), 1e5
    for repeats in (0.0, 5.0):
        noise = rng.normal(size=data.residual.shape) + repeats * np.sin(2 * np.pi * data.time / 5.0)[:, None]
        fit = data.fit.with_residual(size * noise / data.fit.sigma)
        noisy = replace(data, residual=size * noise, fit=fit, given=False)
        gap = held_out_gap(noisy, fit, np.full(data.robot.dof, size))
        assert gap.floor == pytest.approx(np.ones(data.robot.dof), rel=0.05)


def test_stiction_of_either_sign_at_standstill_is_not_a_gap(dataset):
    """Twice the level from what is predicted: other joints stand while one of them is turned to and fro."""
    data, fit = dataset.dataset, dataset.dataset.fit
    level = stiction(fit.reference)
    assert np.all(level > 0)
    for part, most in ((1.9, 0.1), (4.0, 10.0)):
        fit = fit.with_residual(np.where(fit.near_rest, part * level / fit.sigma, 0.0))
        gap = held_out_gap(replace(data, fit=fit, residual=fit.near_rest * part * level), fit)
        assert np.all(gap.before * gap.unit < most * level)
    assert np.any(gap.before * gap.unit > 0.5 * level), "beyond that it is one"


def test_a_cause_is_scored_in_units_of_its_own_joint(dataset):
    """A hundredth of the torque, and of the gap, where no nominal torque says what a joint is for."""
    data, fit = dataset.dataset, dataset.finding.fit
    (own,) = {joint for candidate in fit.chosen for joint in candidate.blocks}
    unit = np.full(data.robot.dof, 1.0)
    unit[own] = 100.0
    small, large = (held_out_gap(data, fit, one) for one in (unit, 1 / unit))
    assert large.closure > 0.9
    assert not small.closure, "what the other joints do not repeat is larger"
    np.testing.assert_allclose(large.before, held_out_gap(data, fit, np.ones(len(unit))).before * unit)
