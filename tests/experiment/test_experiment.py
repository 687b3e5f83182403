"""The motion that separates what a diagnosis leaves open, and what it is expected to tell."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.diagnosis import Excursions, diagnose
from agent.experiment import LOOPS, as_drawn, d_optimal, open_pairs, pieces_otherwise, plan_experiment, questions
from agent.experiment.motion import GridMotion, background_on
from agent.experiment.outlook import Outlook
from agent.experiment.pieces import Pieces
from agent.experiment.plan import _at_best, _doubtful, _named
from agent.experiment.questions import Form, Hypothesis, OpenPair
from agent.model import CATALOGUE, MotionSignals
from agent.robot import kinematics_for
from fake_controller.plant import Plant
from tests.experiment.examples import one_sided, wave
from tests.small_arms import learn, record

NOTHING = Hypothesis("none", (), ())
SIDES = {"asymmetric_friction", "torque_offset"}


def test_what_is_ambiguous_is_what_is_asked(ambiguous):
    assert ambiguous.result["verdict"] == "ambiguous"
    pairs = open_pairs(ambiguous)
    assert SIDES in [set(pair.names) for pair in pairs]
    assert pairs[0].first.joints == ("joint_2",)
    sides = {side for pair in pairs for side in (pair.first, pair.second)}
    assert len(pairs) == len(sides) * (len(sides) - 1) / 2, "the truth may be any of them"


@settings(max_examples=12, deadline=None)
@given(
    st.lists(st.floats(0.01, 0.5), min_size=2, max_size=2),
    st.lists(st.floats(0.01, 0.5), min_size=2, max_size=2),
    st.floats(2, 8),
)
def test_a_further_motion_never_brings_rivals_nearer(arm, ambiguous, first, second, seconds):
    outlook = Outlook(ambiguous.dataset, open_pairs(ambiguous))
    one = outlook.told(wave(arm, first, seconds))
    together = one + outlook.told(wave(arm, second, seconds))
    now, after, both = (outlook.distances(added) for added in (outlook.nothing, one, together))
    assert np.all(after >= now * (1 - 1e-6))
    assert np.all(both >= after * (1 - 1e-6))
    chances = outlook.probabilities(together)
    assert np.all((chances >= 0) & (chances <= 1))


def test_a_standstill_tells_nothing(arm, ambiguous):
    outlook = Outlook(ambiguous.dataset, open_pairs(ambiguous))
    time = np.arange(0, 8, 0.02)
    zero = np.zeros((len(time), arm.dof))
    told = outlook.told(GridMotion(time, zero + 0.3, zero, zero))
    assert not told.moments.any()
    assert np.all(outlook.probabilities(told) <= outlook.probabilities(outlook.nothing)), "only the margin grows"


@pytest.mark.parametrize("seconds", [10.0, 40.0, 160.0])
def test_however_slow_a_motion_an_offset_is_friction_by_direction(arm, ambiguous, seconds):
    """It is one while the joint slides, and how slow is standing depends on the logs, not on the motion alone."""
    pair = next(pair for pair in open_pairs(ambiguous) if set(pair.names) == SIDES)
    outlook = Outlook(ambiguous.dataset, [pair])
    alike = [k for k, one in enumerate(outlook.comparisons) if one.truth.candidate.effect.name == "torque_offset"]
    time = np.arange(0, seconds, 0.02)[:, None]
    w = 2 * np.pi / seconds * np.arange(1, arm.dof + 1)
    slow = GridMotion(time[:, 0], -np.cos(w * time) / 3, w * np.sin(w * time) / 3, w**2 * np.cos(w * time) / 3)
    before, after = (outlook.distances(added) for added in (outlook.nothing, outlook.told(slow)))
    assert alike
    assert np.all(after[alike] - before[alike] < 1.0)


@pytest.mark.parametrize("rate", [30.0, 500.0])
def test_a_joint_that_turns_back_between_two_samples_stands_there(arm, ambiguous, rate):
    fit = ambiguous.dataset.fit
    time = np.arange(0, 4, 1 / rate) + 0.3 / rate
    q, qd = np.stack([np.sin(4 * time)] * arm.dof, axis=1), np.stack([4 * np.cos(4 * time)] * arm.dof, axis=1)
    motion = MotionSignals(fit.reference, time, q, qd, -16 * q)
    still = background_on(ambiguous.dataset, fit.reference, motion) > 1.01 * fit.sigma.min(axis=0)
    for turn in np.arange(np.pi / 8, 3.9, np.pi / 4):
        assert still[np.abs(time - turn) < 0.04].all()
    assert np.mean(still) < 0.25


def test_pieces_begin_and_end_at_rest_in_the_sub_region(problem):
    arm = problem.robot
    pieces = Pieces(problem, [1, 4], 30.0, np.random.default_rng(5))
    found = [piece for piece in (pieces.draw() for _ in range(20)) if piece is not None]
    assert {piece.draw.kind for piece in found} == {"loop", "stops", "reversals"}
    tips = kinematics_for(arm, None)
    middle = problem.regions.poses(np.full(problem.genes, 0.5))[0, :3, 3]
    for piece in found:
        motion = piece.motion
        assert np.allclose(motion.q[[0, -1]], piece.start, atol=1e-6)
        assert np.allclose(motion.qd[[0, -1]], 0, atol=1e-6)
        assert np.all(np.abs(motion.qd) <= arm.max_velocity * (1 + 1e-6))
        away = np.abs(tips.forward(motion.q)[:, :3, 3] - middle)
        assert away.max() < 0.1 + 2 * problem.settings.fly_distance, piece.text(arm)
        speed = np.gradient(tips.forward(motion.q)[:, :3, 3], motion.time, axis=0)
        assert np.linalg.norm(speed, axis=1).max() < 1.02 * problem.settings.linear_speed, piece.text(arm)


def test_a_joint_turns_no_further_than_its_range(problem):
    """The turn is made smaller rather than given up."""
    free = Pieces(problem, [3], 20.0, np.random.default_rng(1))
    narrow = (-0.2, 0.9)
    kept = Pieces(replace(problem, joint_ranges={"joint_4": narrow}), [3], 20.0, np.random.default_rng(1))
    drawn = [[one for _ in range(60) if (one := pieces.draw()) is not None] for pieces in (free, kept)]
    turned, turned_less = ([one for one in some if one.draw.kind == "reversals"] for some in drawn)
    assert max(np.ptp(one.motion.q[:, 3]) for one in turned) > narrow[1] - narrow[0]
    assert turned_less
    for one in turned_less:
        assert narrow[0] <= one.motion.q[:, 3].min() <= one.motion.q[:, 3].max() <= narrow[1]


def test_what_the_criterion_tells_and_the_verdict_does_not_stays_open(ambiguous):
    """The verdict may leave too much of a gap; of the cause alone, and not of one that it tells from its rival."""
    pairs = open_pairs(ambiguous)
    sure, unsure = np.ones((len(pairs), 2)), np.zeros((len(pairs), 2))
    asked = _doubtful(ambiguous, pairs, sure)
    assert asked[[set(pair.names) == SIDES for pair in pairs].index(True)]
    assert not asked[[pair.first is not pairs[0].first for pair in pairs]].any()
    assert not _doubtful(ambiguous, pairs, unsure).any(), "it is open by the criterion already"
    said = _named(ambiguous, pairs)
    assert said[[set(pair.names) == SIDES for pair in pairs].index(True)], "that a motion does not tell it is said too"
    assert not said.all()


def test_an_effect_is_larger_on_a_motion_that_shows_it(arm, ambiguous):
    pairs = open_pairs(ambiguous)
    outlook, (form, *_) = Outlook(ambiguous.dataset, pairs), pairs[0].first.truths
    turning, other = (outlook.told(wave(arm, reach, 6.0)) for reach in ((0.0, 0.4), (0.4, 0.0)))
    assert outlook.energy(turning, form) > 10 * outlook.energy(other, form)


def test_a_spring_that_was_straight_is_one_between_pivots(ambiguous):
    fit, spring = ambiguous.dataset.fit, CATALOGUE["gravity_spring"]
    (straight,) = fit.candidates([(spring, (1,), {})])
    usual = questions.as_usual(fit, straight, np.array([5.0, 20.0]))
    assert usual is not None
    assert usual.settings == {"harmonics": 2.0}
    assert np.diag(usual.prior)[:2] == pytest.approx(0.0), "its sine is as large as it was seen to be"
    assert 0.1 * 20.0 < np.diag(usual.prior)[2] ** -0.5 < 0.3 * 20.0
    (bent,) = fit.candidates([(spring, (1,), {"harmonics": 3.0})])
    assert questions.as_usual(fit, bent, np.ones(6)) is None, "what was shown is enough"


@pytest.mark.verify
def test_the_motion_that_is_planned_tells_more_and_repeats(problem):
    found = one_sided(problem.robot)
    first, again = (plan_experiment(found, open_pairs(found), problem, 20.0, seed=3) for _ in range(2))
    assert first.duration <= 20.0
    assert [e.after for e in first.expected] == [e.after for e in again.expected]
    for expected in first.expected:
        assert expected.after >= expected.before
    if not first.pieces:
        assert first.expected == ()


def test_places_that_explain_nearly_as_much_are_asked_about_too(ambiguous, monkeypatch):
    """The truth may be none of the two that a verdict names: forms that are alike on little motion hide each other."""

    def places() -> set[tuple[str, tuple[str, ...]]]:
        return {(pair.second.effect, pair.second.joints) for pair in open_pairs(ambiguous)}

    monkeypatch.setattr(questions, "_NEAR", 2.0)
    named = places()
    monkeypatch.setattr(questions, "_NEAR", 0.1)
    assert named < places()
    assert len(places()) <= len(named) + questions._NEAREST


def test_other_shapes_of_its_kind_are_asked_about_at_about_the_size_of_the_cause(ambiguous):
    """On little motion a spring is an offset: what a fit says of it there may be of any size."""
    (cause, *_), fit = ambiguous.finding.causes, ambiguous.dataset.fit
    by_effect = {pair.second.effect: pair.second for pair in open_pairs(ambiguous)}
    kin = by_effect["gravity_spring"]
    assert kin.joints == ("joint_2",)
    for form in kin.forms:
        torque, usual = (
            np.sqrt(np.mean((candidate.blocks[1] @ values) ** 2))
            for candidate, values in ((form.candidate, form.values), (cause, ambiguous.finding.fit.values[0]))
        )
        assert torque < 2 * usual
        assert np.all(np.linalg.eigvalsh(form.covariance) > 0)
    assert fit.chosen == ()


def test_pieces_that_only_together_tell_are_within_reach():
    """Each is too short to pass the margin, and all there are together have too many rows."""
    tells = {0: 0.0, 1: 0.2, 2: 0.9, 3: 0.4}
    outlook = SimpleNamespace(
        nothing=0, chances=lambda told: np.array([[tells.get(told, 0.0) if told < 10 else 0.1, np.nan]])
    )
    piece = SimpleNamespace(duration=10.0)
    pool = [(piece, 1), (piece, 1), (piece, 10)]
    assert _at_best(outlook, pool, 25.0)[0, 0] == 0.9
    assert _at_best(outlook, pool, 15.0)[0, 0] == 0.2
    assert _at_best(outlook, [], 15.0)[0, 0] == 0.0


def test_a_form_whose_joint_does_not_travel_far_enough_is_not_told(arm, ambiguous):
    """A diagnosis does not try it: that counts as not known where it is true, and as no rival where it is not."""
    fit = ambiguous.dataset.fit
    sides = []
    for name, scale in (("gravity_spring", 100.0), ("torque_offset", 100.0)):
        candidate = fit.candidates([(CATALOGUE[name], (1,), CATALOGUE[name].settings(fit, (1,))[0])])[0]
        values = np.full(len(candidate.names), scale)
        form = Form(candidate, values, np.zeros((len(values),) * 2))
        sides.append(Hypothesis(name, ("joint_2",), (form,)))
    outlook = Outlook(ambiguous.dataset, [OpenPair(*sides, fit, 1e-6), OpenPair(sides[0], NOTHING, fit, 1e-6)])
    wide = outlook.told(wave(arm, [0.4, 0.4], 8.0))
    assert outlook.chances(wide)[0, 0] > 0.5
    assert outlook.minimum_detectable_sizes(wide)[1] is not None
    short = Excursions(
        ("joint_1", "joint_2"), np.ones(2, bool), np.zeros(2), np.full(2, 0.1), np.ones(2), np.full(2, 9)
    )
    outlook._reached, little = short, replace(wide, excursions=short)
    assert outlook.chances(little)[0, 0] == 0.0
    assert outlook.chances(little)[0, 1] == pytest.approx(1.0)
    assert outlook.minimum_detectable_sizes(little)[1] is None


def test_loops_at_random_fill_the_time_with_nothing_else(problem):
    """Every use of the robot's time gets the same of it: of short pieces there are more."""
    loops = pieces_otherwise(as_drawn, problem, 60.0, 7, lambda pieces: True, LOOPS)
    assert {piece.draw.kind for piece in loops} == {"loop"}
    assert len(loops) > 5
    assert 50.0 < sum(piece.duration for piece in loops) <= 60.0


def test_pieces_at_random_use_the_time_and_can_be_run(problem):
    def fits(pieces):
        return len(pieces) < 3  # as if the way to a third were in the way of something

    found = pieces_otherwise(as_drawn, problem, 60.0, 7, fits)
    assert 1 <= len(found) <= 2
    assert sum(piece.duration for piece in found) <= 60.0
    again = pieces_otherwise(as_drawn, problem, 60.0, 7, fits)
    assert [piece.duration for piece in again] == [piece.duration for piece in found]
    assert pieces_otherwise(as_drawn, problem, 60.0, 7, lambda pieces: False) == ()


@pytest.mark.verify
def test_d_optimal_pieces_say_more_of_the_model_than_pieces_at_random(problem):
    found = one_sided(problem.robot)
    outlook = Outlook(found.dataset, ())
    known = found.dataset.fit.gram.sum(axis=0)[:-1, :-1] / found.dataset.fit.repeat + found.dataset.fit.precision

    def worth(pieces):
        total = known + sum(outlook.information(piece.motion) for piece in pieces)
        return np.linalg.slogdet(total / np.sqrt(np.outer(np.diag(known), np.diag(known))))[1]

    picks = d_optimal(found.dataset), as_drawn
    best, drawn = (pieces_otherwise(pick, problem, 40.0, 3, lambda pieces: True) for pick in picks)
    assert worth(best) > worth(drawn)


def test_where_no_rivals_are_open_the_time_that_a_question_leaves_is_filled(problem):
    """Sizes fall with what all motions say of everything; a question about one effect alone takes seconds."""
    plant, slow = Plant(problem.robot, seed=3), 0.3
    found = diagnose(
        problem.robot, [record(plant, "one", 21, slow), record(plant, "two", 22, slow)], learn(problem.robot)
    )
    assert found.result["verdict"] == "no_gap"
    pairs = open_pairs(found)
    assert pairs
    assert not any(pair.second.forms for pair in pairs)
    planned = plan_experiment(found, pairs, problem, 40.0, seed=3)
    assert planned.pieces
    assert planned.duration > 20.0
