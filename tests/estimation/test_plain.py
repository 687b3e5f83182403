"""Plain weighted least squares: one of the estimators that are compared, and no better than what is chosen."""

from dataclasses import replace

import numpy as np

from agent.estimation import EstimationSettings, estimate
from agent.estimation.problem import Estimate
from agent.estimation.selection import best_estimate
from agent.validation import validate
from tests.estimation.conftest import _links

FRICTION = np.array([40.0, 80.0, 50.0, 20.0, 12.0, 6.0, 3.0])  # N·m


def _recorded(robot, multisine, make_log, seed: int, seconds: float, noise: float, width: float = 0.01):
    """An arm at 50 Hz, with friction that the plain terms describe, if it reverses within a small `width` [rad/s]."""
    n = robot.dof
    t = np.arange(int(50 * seconds)) / 50
    q, qd, qdd = multisine(n, t, seed=seed)
    relative = 0.15 * np.tanh(qd / width) + 0.1 * qd + 0.05 + noise * np.random.default_rng(seed).normal(size=q.shape)
    torque = _links(robot, q, qd, qdd) + FRICTION[:n] * relative
    return make_log(robot, t, q, torque, name=f"{seed}.mcap")


def _errors(robot, fitted, held_out, method=None):
    """The model by a method and that by `plain`, and their errors on a log held out."""
    models = [estimate(robot, [fitted], EstimationSettings.create(cutoff=10, method=one)) for one in (method, "plain")]
    return models, [validate(model, [held_out], 10).overall.relative_error_all_joints for model in models]


def test_an_arm_logged_slowly_and_briefly_is_predicted_as_well_as_by_plain_least_squares(arm, multisine, make_log):
    robot = arm(7, seed=1)
    fitted = _recorded(robot, multisine, make_log, 1, 8, 0.02)
    held_out = _recorded(robot, multisine, make_log, 101, 12, 0.0)
    unknown = replace(robot, urdf=robot.urdf.replace('mass value="', 'mass value="1'))  # its links say nothing true
    (ours, _), errors = _errors(unknown, fitted, held_out)
    assert errors[0] <= errors[1]
    assert any("plain " in note for note in ours.notes if note.startswith("Method"))  # it was compared


def test_motions_at_other_postures_are_predicted_no_worse_than_by_plain_least_squares(arm, multisine, make_log):
    """Small arms, short motions: what these leave open is a matter of luck, in which two of ten may be worse."""
    ratios = []
    for seed in range(600, 610):
        robot = arm(3, seed=seed)
        fitted = _recorded(robot, multisine, make_log, seed, 8, 0.02, 1e-4 if seed % 2 else 0.01)
        elsewhere = _recorded(robot, multisine, make_log, 50_000 + seed, 8, 0.0, 1e-4 if seed % 2 else 0.01)
        _, errors = _errors(robot, fitted, elsewhere)
        ratios.append(errors[0] / errors[1])
    assert sorted(ratios)[-3] < 1.03
    assert np.median(ratios) < 0.7


def test_keeps_coulomb_and_viscous_friction_if_the_data_show_no_more(arm, multisine, make_log):
    robot = arm(3, seed=5)
    settings = EstimationSettings.create(cutoff=10, method="weighted")
    sharp, smooth = (
        estimate(robot, [_recorded(robot, multisine, make_log, 5, 10, 0.02, width)], settings) for width in (1e-4, 0.03)
    )
    assert [term.form for term in sharp.terms] == ["coulomb", "viscous", "offset"] * 3
    assert {term.reversal.scale for term in sharp.terms if term.reversal} == {0.0}
    assert any("Friction: Coulomb, viscous and an offset" in note for note in sharp.notes)
    assert all(term.reversal.scale > 0 for term in smooth.terms if term.form == "coulomb")


def test_an_offset_in_a_small_motion_is_not_fitted_as_gravity(arm, multisine, make_log):
    robot = arm(7, seed=911)
    fitted = _recorded(robot, multisine, make_log, 911, 30, 0.02)
    elsewhere = _recorded(robot, multisine, make_log, 50911, 12, 0.0)
    (ours, _), errors = _errors(robot, fitted, elsewhere, "weighted")
    assert errors[0] < errors[1]
    assert {term.axle for term in ours.terms if term.form == "offset"} == set(range(7))


def test_the_plain_estimator_has_its_own_terms_and_no_prior(arm, multisine, make_log):
    robot = arm(7, seed=1)
    model = estimate(
        robot,
        [_recorded(robot, multisine, make_log, 1, 8, 0.02)],
        EstimationSettings.create(cutoff=10, method="plain"),
    )
    assert [(term.axle, term.form) for term in model.terms] == [
        (axle, form) for axle in range(7) for form in ("coulomb", "viscous", "offset")
    ]
    assert any(note.startswith("Plain weighted least squares") for note in model.notes)
    assert not any("prior" in note and "near" in note for note in model.notes)


def _folds(*errors: float) -> Estimate:
    return Estimate(np.zeros(1), np.ones((2, 1)), None, np.array(errors)[:, None, None], None, 0.0, "")


def test_changes_the_estimator_only_for_a_gain_above_the_scatter_between_folds():
    usual = {"weighted": _folds(1, 1, 1, 1, 1), "consistent": _folds(1, 1, 1, 1, 1)}
    name, chosen = best_estimate({**usual, "huber": _folds(0.9, 0.92, 0.91, 0.93, 0.9), "plain": _folds(*5 * [0.95])})
    assert name == "huber"
    assert "segments clearly better than weighted (held-out error relative to weighted:" in chosen.note
    assert best_estimate({**usual, "huber": _folds(0.5, 0.9, 1.1, 1.1, 1.0)})[0] == "weighted"  # one fold decides
    assert best_estimate({**usual, "huber": _folds(0.99, 0.985, 0.99, 0.985, 0.99)})[0] == "weighted"  # too little
    scattered = np.linspace(0.99, 1.01, 4)
    usual = {name: _folds(*scattered) for name in ("weighted", "consistent")}
    assert best_estimate({**usual, "plain": _folds(*0.8 * scattered)})[0] == "plain"
    assert best_estimate({**usual, "plain": _folds(*0.995 * scattered)})[0] == "weighted"
