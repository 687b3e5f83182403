"""The motion that separates what a diagnosis leaves open, and what it is expected to tell."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.diagnosis import MotionCoverage, diagnose
from agent.experiment import Deadline, d_optimal, open_pairs, plan_experiment
from agent.experiment.pieces import GridMotion, Pieces
from agent.experiment.questions import Alternative, OpenPair
from agent.experiment.scorer import ExperimentScorer, noise_level_on
from agent.model import CATALOGUE, MotionSignals
from agent.robot import kinematics_for
from benchmarks.active.baselines import as_drawn, pieces_otherwise
from fake_controller.plant import Plant
from tests.experiment.examples import one_sided, wave
from tests.small_arms import learn, record

NOTHING = Alternative("none", (), None, np.empty(0))
SIDES = {"asymmetric_friction", "torque_offset"}


def scorer_of(found, pairs) -> ExperimentScorer:
    return ExperimentScorer(found.dataset, found.selected.evidence, pairs)


def test_asks_about_the_ambiguous_causes(ambiguous):
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
def test_a_further_motion_never_reduces_the_separation(arm, ambiguous, first, second, seconds):
    exact = copy(ambiguous.selected.evidence)
    exact.law = replace(exact.law, form_error=0.0)  # of a form that is wrong, a rival follows more the more it shows
    scorer = ExperimentScorer(ambiguous.dataset, exact, open_pairs(ambiguous))
    one = scorer.information_of(wave(arm, first, seconds))
    together = one + scorer.information_of(wave(arm, second, seconds))
    now, after, both = (scorer.evidence(added) for added in (scorer.nothing, one, together))
    assert np.all(after >= now * (1 - 1e-6))
    assert np.all(both >= after * (1 - 1e-6))
    chances = scorer.chances(together)
    assert np.all((chances >= 0) & (chances <= 1))


def test_a_stationary_motion_has_no_information(arm, ambiguous):
    scorer = scorer_of(ambiguous, open_pairs(ambiguous))
    time = np.arange(0, 8, 0.02)
    zero = np.zeros((len(time), arm.dof))
    told = scorer.information_of(GridMotion(time, zero + 0.3, zero, zero))
    assert not told.information.any()
    assert np.array_equal(scorer.chances(told), scorer.chances(scorer.nothing))


@pytest.mark.parametrize("seconds", [10.0, 40.0, 160.0])
def test_slow_motion_does_not_separate_an_offset_from_asymmetric_friction(arm, ambiguous, seconds):
    """It is one while the joint slides. The speed threshold depends on the logs, not on the motion alone."""
    pair = next(pair for pair in open_pairs(ambiguous) if set(pair.names) == SIDES)
    scorer = scorer_of(ambiguous, [pair])
    alike = pair.names.index("torque_offset")
    time = np.arange(0, seconds, 0.02)[:, None]
    w = 2 * np.pi / seconds * np.arange(1, arm.dof + 1)
    slow = GridMotion(time[:, 0], -np.cos(w * time) / 3, w * np.sin(w * time) / 3, w**2 * np.cos(w * time) / 3)
    before, after = (scorer.evidence(added)[0, alike] for added in (scorer.nothing, scorer.information_of(slow)))
    assert after - before < 1.0


@pytest.mark.parametrize("rate", [30.0, 500.0])
def test_counts_a_reversal_between_two_samples_as_standstill(arm, ambiguous, rate):
    fit = ambiguous.dataset.fit
    time = np.arange(0, 4, 1 / rate) + 0.3 / rate
    q, qd = np.stack([np.sin(4 * time)] * arm.dof, axis=1), np.stack([4 * np.cos(4 * time)] * arm.dof, axis=1)
    motion = MotionSignals(fit.reference, time, q, qd, -16 * q)
    still = noise_level_on(ambiguous.dataset, fit.reference, motion) > 1.01 * fit.sigma.min(axis=0)
    for turn in np.arange(np.pi / 8, 3.9, np.pi / 4):
        assert still[np.abs(time - turn) < 0.04].all()
    assert np.mean(still) < 0.25


def test_pieces_begin_and_end_stationary_in_the_sub_region(problem):
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


def test_planned_joints_stay_within_their_range(problem):
    """The turn is made smaller rather than given up."""
    free = Pieces(problem, [3], 20.0, np.random.default_rng(1))
    narrow = (-0.1, 0.7)
    kept = Pieces(replace(problem, joint_ranges={"joint_4": narrow}), [3], 20.0, np.random.default_rng(1))
    drawn = [[one for _ in range(60) if (one := pieces.draw()) is not None] for pieces in (free, kept)]
    turned, turned_less = ([one for one in some if one.draw.kind == "reversals"] for some in drawn)
    assert max(np.ptp(one.motion.q[:, 3]) for one in turned) > narrow[1] - narrow[0]
    assert turned_less
    for one in turned_less:
        assert narrow[0] <= one.motion.q[:, 3].min() <= one.motion.q[:, 3].max() <= narrow[1]


def test_an_effect_has_more_energy_on_a_motion_of_its_joint(arm, ambiguous):
    pairs = open_pairs(ambiguous)
    scorer = scorer_of(ambiguous, pairs)
    turning, other = (scorer.information_of(wave(arm, reach, 6.0)) for reach in ((0.0, 0.4), (0.4, 0.0)))
    assert scorer.energy(turning, pairs[0].first) > 10 * scorer.energy(other, pairs[0].first)


@pytest.mark.verify
def test_the_planned_motion_separates_more_and_is_reproducible(problem):
    found = one_sided(problem.robot)
    first, again = (plan_experiment(found, open_pairs(found), problem, 20.0, seed=3) for _ in range(2))
    assert first.duration <= 20.0
    assert [e.after for e in first.expected] == [e.after for e in again.expected]
    for expected in first.expected:
        assert expected.after >= expected.before
    if not first.pieces:
        assert first.expected == ()


def test_does_not_predict_a_separation_for_too_short_a_travel(arm, ambiguous):
    """A diagnosis does not try it: that counts as not known where it is true, and as no rival where it is not."""
    fit = ambiguous.dataset.fit
    sides = []
    for name, scale in (("gravity_spring", 100.0), ("torque_offset", 100.0)):
        candidate = fit.candidates([(CATALOGUE[name], (1,), CATALOGUE[name].settings(fit, (1,))[0])])[0]
        values = np.full(len(candidate.names), scale)
        sides.append(Alternative(name, ("joint_2",), candidate, values))
    scorer = scorer_of(ambiguous, [OpenPair(*sides), OpenPair(sides[0], NOTHING)])
    wide = scorer.information_of(wave(arm, [0.4, 0.4], 8.0))
    assert scorer.chances(wide)[0, 0] > 0.5
    assert scorer.minimum_detectable_sizes(wide)[1] is not None
    short = MotionCoverage(
        ("joint_1", "joint_2"), np.ones(2, bool), np.zeros(2), np.full(2, 0.05), np.ones(2), np.full(2, 9)
    )
    scorer._reached, little = short, replace(wide, coverage=short)
    assert scorer.chances(little)[0, 0] == 0.0
    assert scorer.chances(little)[0, 1] == pytest.approx(1.0)
    assert scorer.minimum_detectable_sizes(little)[1] is None


def test_random_loops_fill_the_time(problem):
    """Every use of the robot's time gets the same of it."""
    loops = pieces_otherwise(as_drawn, problem, 60.0, 7, lambda pieces: True, ["loop"])
    assert {piece.draw.kind for piece in loops} == {"loop"}
    assert 50.0 < sum(piece.duration for piece in loops) <= 60.0


def test_random_pieces_fill_the_time_and_are_feasible(problem):
    def fits(pieces):
        return len(pieces) < 3  # as if the way to a third were in the way of something

    found = pieces_otherwise(as_drawn, problem, 60.0, 7, fits)
    assert 1 <= len(found) <= 2
    assert sum(piece.duration for piece in found) <= 60.0
    again = pieces_otherwise(as_drawn, problem, 60.0, 7, fits)
    assert [piece.duration for piece in again] == [piece.duration for piece in found]
    assert pieces_otherwise(as_drawn, problem, 60.0, 7, lambda pieces: False) == ()


@pytest.mark.verify
def test_d_optimal_pieces_have_more_information_than_random_ones(problem):
    found = one_sided(problem.robot)
    scorer = scorer_of(found, ())
    known = (
        found.dataset.fit.gram.sum(axis=0)[:-1, :-1] / found.dataset.fit.rows_per_independent
        + found.dataset.fit.precision
    )

    def worth(pieces):
        total = known + sum(scorer.model_information(piece.motion) for piece in pieces)
        return np.linalg.slogdet(total / np.sqrt(np.outer(np.diag(known), np.diag(known))))[1]

    picks = d_optimal(found.dataset, scorer.model_information), as_drawn
    best, drawn = (pieces_otherwise(pick, problem, 40.0, 3, lambda pieces: True) for pick in picks)
    assert worth(best) > worth(drawn)


@pytest.fixture(scope="module")
def healthy(problem):
    """A diagnosis of motions too slow to show every effect."""
    plant, slow = Plant(problem.robot, seed=3), 0.3
    logs = [record(plant, "one", 21, slow), record(plant, "two", 22, slow)]
    return diagnose(problem.robot, logs, learn(problem.robot))


def test_the_motion_search_stops_at_its_deadline_and_reports_it(healthy, problem):
    now, said = [0.0], list[str]()

    def progress(text: str) -> None:
        said.append(text)
        now[0] += 4.0

    deadline = Deadline(progress, 20.0, lambda: now[0])
    planned = plan_experiment(healthy, open_pairs(healthy), problem, 40.0, 3, deadline)
    assert planned.cut_short
    assert planned.weighed < 5
    assert len(said) == 5, "nothing begins after the time is up"


def test_fills_the_time_if_no_pair_is_open(healthy, problem):
    """Sizes fall with what all motions say of everything; a question about one effect alone takes seconds."""
    assert healthy.result["verdict"] == "no_gap"
    pairs = open_pairs(healthy)
    assert pairs
    assert all(pair.second.form is None for pair in pairs)
    planned = plan_experiment(healthy, pairs, problem, 10.0, seed=3)
    assert planned.pieces
    assert planned.duration > 5.0
