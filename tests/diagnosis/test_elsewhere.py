"""A force on the arm pulls at all joints below it: what only one joint shows is none."""

from __future__ import annotations

import numpy as np
import pytest

from agent.diagnosis.excess import closed_excess, joint_energy, put_elsewhere
from agent.diagnosis.finding import Step
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.procedure import Search
from agent.model.effects import CATALOGUE
from tests.diagnosis.test_evidence import redrawn

FORCE = np.array([30.0, -20.0, 40.0])  # N
PUSH = {"log_1": 0.0, "link_1": 6.0, "start_1": 4.0, "duration_1": 0.4}


@pytest.mark.parametrize("joint", [None, 4])
def test_a_push_takes_away_on_every_joint_and_a_joint_alone_is_none(diagnosed, joint):
    """All joints, or what a torque sensor of one that holds its value shows."""
    fit = diagnosed(0).dataset.fit
    push = fit.candidate(CATALOGUE["contact"], (), PUSH)
    seen = redrawn(fit, np.random.default_rng(3), push, FORCE)
    if joint is not None:
        alone = redrawn(fit, np.random.default_rng(3))
        for other in range(6):
            if other != joint:
                seen.rows[other] = alone.rows[other]
        seen = redrawn_from(seen)
    (score,) = seen.score([push])
    assert score.gain > 0
    assert (put_elsewhere(seen, score) > 0.02 * float(seen.count.sum())) == (joint is not None)


def test_rows_that_are_in_no_fit_take_nothing_away(diagnosed):
    fit = diagnosed(0).dataset.fit
    push = fit.candidate(CATALOGUE["contact"], (), PUSH)
    seen = redrawn(fit, np.random.default_rng(3), push, FORCE)
    guards = (seen.signals[0].time[seen.signals[0].kept] > 4.1) & (seen.signals[0].time[seen.signals[0].kept] < 4.2)
    seen.cell = np.where(np.pad(guards, (0, len(seen.cell) - len(guards))), -1, seen.cell)
    seen = redrawn_from(seen)
    (score,) = seen.score([push])
    before = put_elsewhere(seen, score)
    for joint, rows in enumerate(seen.rows):
        rows[seen.cell < 0, -1] += 1000.0 * (-1) ** joint
    assert put_elsewhere(redrawn_from(seen), score) == pytest.approx(before, rel=1e-9)


def test_what_moved_numbers_gain_between_other_folds_is_not_the_effects(diagnosed):
    """A push where none was closes nothing, though it is judged by other folds than a fit without it."""
    fit = diagnosed(0).dataset.fit
    seen = redrawn(fit, np.random.default_rng(5), hose(fit), np.array([0.0, 0.0, 40.0]))
    nothing = seen.candidate(CATALOGUE["contact"], (), {**PUSH, "log_1": 99.0})
    assert abs(joint_energy(seen, True) - joint_energy(seen, False)).max() > 1e-3
    assert closed_excess(LIMITS, seen, seen.with_chosen((nothing,))) == pytest.approx(0.0, abs=1e-6)


def test_a_force_that_turns_no_joint_is_small(diagnosed):
    """Along the first axis nothing is seen of it: without a size of its own it would be anything."""
    fit = diagnosed(0).dataset.fit
    push = fit.candidate(CATALOGUE["contact"], (), {**PUSH, "link_1": 1.0})
    deviation = np.sqrt(np.linalg.inv(fit.with_chosen((push,)).prior[-3:, -3:]).diagonal())
    assert deviation.max() < 10 * fit.reference.scale.max() / fit.reference.reach


def test_a_score_does_not_depend_on_what_is_scored_beside_it(diagnosed):
    fit = diagnosed(0).dataset.fit
    names = ("stribeck", "gravity_spring", "torque_offset")
    wanted = [(CATALOGUE[name], (k,), CATALOGUE[name].settings(fit, (k,))[0]) for name in names for k in (1, 4)]
    forms = [*fit.candidates(wanted), fit.candidate(CATALOGUE["contact"], (), PUSH)]
    beside = fit.with_chosen([forms[0]])
    for together, form in zip(beside.score(forms[1:]), forms[1:], strict=True):
        (alone,) = beside.score([form])
        assert together.candidate is form
        np.testing.assert_allclose(together.values, alone.values, rtol=1e-9)
        assert together.error == pytest.approx(alone.error, rel=1e-12)
        assert alone.gain == pytest.approx(beside.error(form.effect.once) - alone.error)


def redrawn_from(fit):
    """The fit with its moments made anew of its rows."""
    return type(fit)(
        fit.reference, fit.signals, fit.rows, fit.index, fit.sigma, fit.precision, fit.shift,
        fit.cell, fit.block, fit.folds, fit.single,
    )  # fmt: skip


class Left(Search):
    """A search that is told what is left."""

    def scan(self, fit):
        found = [] if len(fit.chosen) > 1 else fit.score([hose(fit)])
        return Step(fit.chosen, fit.error(), tuple(found), tuple(found))


def hose(fit):
    return fit.candidate(CATALOGUE["dress_pack"], (4,), {"travel": 0.02})


@pytest.mark.parametrize("rubs", [40.0, -40.0])
def test_a_further_effect_that_only_turns_against_the_first_is_none(diagnosed, rubs):
    """A hose that drives, where friction is taken too high."""
    fit = diagnosed(0).dataset.fit
    seen = redrawn(fit, np.random.default_rng(4), hose(fit), np.array([0.0, 0.0, rubs]))
    search = Left(seen)
    friction = seen.candidate(CATALOGUE["friction_change"], (3,), {"coulomb": 1.0})
    assert len(search._forward((friction,), [])) == (2 if rubs > 0 else 1)
