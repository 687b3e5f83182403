"""A force on the arm pulls at all joints below it: what only one joint shows is none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from agent.diagnosis.excess import put_elsewhere
from agent.diagnosis.finding import Step
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


class Two(Search):
    """A search that knows a hose and friction on one joint, and nothing else."""

    def scan(self, fit):
        self.null = SimpleNamespace(threshold=0.0, p_value=lambda gain: 0.005)
        known = [hose(fit), fit.candidate(CATALOGUE["friction_change"], (4,), {"coulomb": 1.0})]
        scores = tuple(sorted(fit.score(known), key=lambda score: -score.gain))
        return Step(fit.chosen, fit.error(), scores, () if fit.chosen else scores[:1])


@pytest.mark.parametrize(("beside", "verdict"), [(0.6, "ambiguous"), (1.7, "unknown")])
def test_a_cause_that_closes_most_of_a_gap_but_not_three_quarters_is_one_of_two(diagnosed, beside, verdict):
    """Beside a hose something that is in no catalogue, with so many times its energy."""
    fit = diagnosed(0).dataset.fit
    seen = redrawn(fit, np.random.default_rng(4), hose(fit), np.array([0.0, 0.0, 60.0]))
    of_hose = np.mean((hose(fit).blocks[4] @ [0.0, 0.0, 60.0]) ** 2)
    unknown = np.sign(np.sin(np.arange(len(seen.rows[4])) / 17.0))
    seen.rows[4][:, -1] += np.sqrt(beside * of_hose) * unknown
    found = Two(redrawn_from(seen)).run()
    assert found.verdict == verdict
    assert [candidate.effect.name for candidate in found.causes] == ["dress_pack"] * (verdict == "ambiguous")
    assert all(rivals == (("friction_change", (4,)),) for rivals in found.rivals)
