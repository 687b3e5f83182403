"""A rehearsal of a motion, what it promises, and which of several motions it chooses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agent.diagnosis import Fit, complexity, diagnose
from agent.diagnosis.folds import folds_of, part_borders
from agent.diagnosis.limits import LIMITS
from agent.experiment import open_pairs
from agent.experiment.choice import _shortened, best_rehearsed, rehearsed
from agent.experiment.rehearsal import _ALIKE, Rehearsal, Said
from agent.model import CATALOGUE
from agent.model.effects.effect import friction_levels
from agent.recording import PARTS
from fake_controller.plant import Plant
from tests.experiment.examples import wave
from tests.small_arms import record

SIDES = {"asymmetric_friction", "torque_offset"}


def test_friction_by_direction_is_taken_to_differ_at_speed_too(arm, ambiguous):
    """Slow logs show a constant only; as a rule as large a part of viscous friction differs as of the Coulomb level."""
    pair = next(pair for pair in open_pairs(ambiguous) if set(pair.names) == SIDES)
    (true,) = next(side for side in (pair.first, pair.second) if side.effect == "asymmetric_friction").truths
    levels = friction_levels(ambiguous.dataset.fit.reference, 1)
    assert true.candidate.names == ("coulomb_asymmetry", "viscous_asymmetry")
    assert np.sqrt(true.covariance[1, 1]) < 1.01 * abs(true.values[0]) * levels["viscous"] / levels["coulomb"]
    rehearsal = Rehearsal(ambiguous, [pair], [wave(arm, [0.5, 0.5], 8.0)])
    (form,) = rehearsal._forms(("asymmetric_friction", (1,)), rehearsal._dataset.fit)
    assert form.names == true.candidate.names


def test_of_forms_that_logs_tell_no_better_apart_several_are_taken_for_true(arm, ambiguous):
    """A warm-up over seconds or over minutes: a motion that comes later does not show the same of both."""
    rehearsal = Rehearsal(ambiguous, open_pairs(ambiguous), [wave(arm, [0.5, 0.5], 8.0)])
    forms = rehearsal._forms(("thermal_friction", (1,)), rehearsal._dataset.fit)
    simplest = [form for form in forms if complexity(form) == complexity(forms[0])]
    assert len({tuple(form.settings.items()) for form in forms}) == len(forms)
    assert 2 <= len(simplest) <= _ALIKE
    assert all(complexity(form) >= complexity(forms[0]) for form in forms)


@pytest.fixture(scope="module")
def said(arm, ambiguous):
    """What a rehearsal of a wide motion says where each of two is true."""
    pairs = [pair for pair in open_pairs(ambiguous) if set(pair.names) == SIDES]
    rehearsal = Rehearsal(ambiguous, pairs, [wave(arm, [0.5, 0.5], 8.0)])
    return rehearsal, rehearsal.said(1)


def test_a_rehearsal_asks_the_diagnosis_itself_with_each_rival_taken_for_true(said):
    _, answers = said
    assert set(answers) == {("asymmetric_friction", (1,)), ("torque_offset", (1,))}
    for place, (answer,) in answers.items():
        assert answer.verdict in ("ambiguous", "explained"), "half of the torque is measured, and either explains it"
        assert place in answer.classes[0]
        assert answer.settles(place) == (answer.verdict == "explained" and answer.classes == ((place,),))


def test_of_a_pair_what_is_in_the_class_is_the_answer_where_its_rival_is_not():
    offset, one_sided, spring, hose = ((name, (1,)) for name in ("torque_offset", "asymmetric_friction", "s", "h"))
    answer = Said("ambiguous", ((offset, one_sided), (hose,)))
    assert answer.names(one_sided, spring), "which of two equals comes first says nothing of a third"
    assert answer.names(offset, spring)
    assert not answer.names(one_sided, offset)
    assert not answer.names(one_sided, hose)
    assert not answer.names(spring, hose)


def test_a_rehearsal_repeats_itself(said):
    rehearsal, answers = said
    assert rehearsal.said(1) == answers


def test_another_residual_of_the_same_motions_is_fitted_as_if_it_had_been_measured(ambiguous):
    fit = ambiguous.dataset.fit
    left = np.random.default_rng(4).standard_normal(fit.sigma.shape)
    (offset,) = fit.candidates([(CATALOGUE["torque_offset"], (1,), {})])
    known = fit.score([offset])[0].gain
    rows = [np.column_stack([block[:, :-1], one]) for block, one in zip(fit.rows, left.T, strict=True)]
    anew = Fit(
        fit.reference, fit.signals, rows, fit.index, fit.sigma, fit.precision, fit.shift,
        fit.cell, fit.block, fit.folds, fit.single,
    )  # fmt: skip
    other = fit.with_residual(left)
    assert other.gram == pytest.approx(anew.gram, rel=1e-9, abs=1e-9)
    for mine, theirs in zip(other.score([offset]), anew.score([offset]), strict=True):
        assert (mine.gain, mine.values) == (pytest.approx(theirs.gain), pytest.approx(theirs.values))
    assert fit.score([offset])[0].gain == known


def test_the_only_log_in_which_a_joint_moves_is_held_out_in_halves(ambiguous):
    """No other log tells of what that joint has, so held out whole it would be predicted from nothing."""
    log = ambiguous.dataset.logs[0]
    stands = log.position.copy()
    stands[:, 0] = stands[0, 0] + 1e-4 * np.sin(log.t)  # servo
    other = replace(log, position=stands, path=log.path.with_name("other.mcap"))
    time, number = np.concatenate([log.t, log.t]), np.repeat([0, 1], len(log.t))

    def names(*logs):
        return [fold.name.partition(" ")[0] for fold in folds_of(time, number, logs, LIMITS)[1]]

    assert names(log, other) == [log.name, log.name, other.name]
    assert names(log, replace(log, path=other.path)) == [log.name, other.name]


def test_a_planned_motion_is_held_out_in_parts_of_equal_motion(ambiguous):
    log = ambiguous.dataset.logs[0]
    planned = replace(log, metadata={PARTS: "2"}, path=log.path.with_name("planned.mcap"))
    (border,) = part_borders(planned)
    assert len(part_borders(log)) == 0
    assert len(part_borders(replace(log, metadata={PARTS: "two"}))) == 0
    time = np.concatenate([log.t, log.t])
    number = np.repeat([0, 1], len(log.t))
    cell, folds, _ = folds_of(time, number, (log, planned), LIMITS)
    assert [fold.name for fold in folds[1:]] == [
        f"planned.mcap {a}" for a in (f"0.0-{border:.1f} s", f"{border:.1f}-{log.t[-1]:.1f} s")
    ]
    rows = [np.isin(cell, np.flatnonzero(fold.test)) for fold in folds]
    assert not np.any(np.sum(rows, axis=0) > 1)
    way = [np.abs(np.diff(log.position[here[len(log.t) :]], axis=0)).sum() for here in rows[1:]]
    assert min(way) > 0.25 * sum(way)


def test_a_settled_diagnosis_asks_nothing_of_causes(arm, ambiguous):
    model = ambiguous.dataset.model
    plant = Plant(arm, seed=3, effects=[{"effect": "payload", "parameters": {"mass": 3.0}}])
    found = diagnose(arm, [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))], model)
    assert found.result["verdict"] == "explained"
    assert all(pair.second.forms == () for pair in open_pairs(found)), "only sizes that these logs would not show"


def test_a_motion_is_no_longer_than_its_rehearsals_need():
    """The longest pieces are tried without first, and one that is needed stays."""
    slow, fast, idle = (SimpleNamespace(duration=seconds) for seconds in (20.0, 5.0, 12.0))

    def settled(design):
        return 0.5 * (slow in design) + 0.4 * (fast in design)

    assert _shortened([slow, idle, fast], 0.9, settled, lambda text: None) == [slow, fast]
    assert _shortened([idle], 0.0, settled, lambda text: None) == [idle], "something of it has to be run"
    (only,) = _shortened([idle, fast], 0.4, settled, lambda text: None)
    assert only is fast


def test_of_designs_that_rehearsals_cannot_tell_apart_the_first_is_taken_and_a_lucky_one_is_not():
    hedged, exact, lucky, poor = ([SimpleNamespace(duration=float(k))] for k in range(4))
    first = {id(hedged): 0.52, id(exact): 0.52, id(lucky): 0.90, id(poor): 0.0}
    more = {id(hedged): 0.50, id(lucky): 0.10}
    asked = []

    def settled(design, draws, seed):
        asked.append((id(design), seed))
        return (first if seed == 3 else more)[id(design)]

    designs = [hedged, exact, lucky, poor]
    assert best_rehearsed(designs, settled, 3, lambda text: None) == hedged
    assert not {(id(exact), 4), (id(poor), 4)} & set(asked), "what is behind, or no better than one before it, is left"
    more[id(lucky)] = 0.9
    assert best_rehearsed(designs, settled, 3, lambda text: None) == lucky, "it was no luck"
    more[id(hedged)] = 1.0
    assert best_rehearsed(designs, settled, 3, lambda text: None) == hedged, "those are alike"


def test_a_few_rehearsals_that_all_name_the_truth_are_no_certainty(arm, ambiguous, problem):
    pieces = [SimpleNamespace(motion=wave(arm, [0.5, 0.5], 8.0))]
    pairs = open_pairs(ambiguous)
    before, after = rehearsed(ambiguous, pairs, pieces, SimpleNamespace(load=None), 3, lambda text: None)  # type: ignore[arg-type]
    asked = np.isfinite(after)
    assert asked.any()
    new = asked & (before == 0)
    assert np.all((after[new] > 0.05) & (after[new] < 0.95))
    assert np.all(after[asked & (before == 1)] > 0.05)
