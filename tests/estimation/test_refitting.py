"""Friction estimated again while base parameters are kept: its deviations, and what it shares with them."""

from dataclasses import replace

import numpy as np
import pytest

from agent.estimation import EstimationSettings, FilterSettings, conditional_covariance, estimate, refit
from agent.estimation.partition import partition
from agent.estimation.problem import Problem
from agent.estimation.signals.observation import observe
from agent.model import FrictionTerm, ModelEffect, Reversal
from agent.robot import Tool, rigid_bodies

DOF = 2
CYCLE = 8.0  # s
PAPER_TERMS = EstimationSettings.create(method="weighted", friction="paper", cutoff=18.0, order=6)


def torque_of(robot, q, qd, qdd, rubs=lambda q: 1.0):
    """(S, n) of the described links with Coulomb and viscous friction, the former times `rubs` of the position."""
    rigid = rigid_bodies(robot)
    standard = np.random.default_rng(3).normal(1.0, 0.2, rigid.projection.shape[1])
    return rigid.torque(q, qd, qdd, rigid.projection @ standard) + 4 * rubs(q) * np.tanh(qd / 0.01) + 2 * qd


@pytest.fixture(scope="module")
def robot(arm):
    return arm(DOF)


@pytest.fixture(scope="module")
def model(robot, multisine, make_log):
    """Of noisy logs of one motion."""
    t = np.arange(20 * 500) / 500
    q, qd, qdd = multisine(DOF, t, seed=1)
    noise = np.random.default_rng(1).normal(size=q.shape)
    return estimate(robot, [make_log(robot, t, q, torque_of(robot, q, qd, qdd) + noise)], PAPER_TERMS)


@pytest.fixture(scope="module")
def later(robot, multisine, make_log):
    """`later(cycles, rubs, noise)`: a log of another motion, the same for every cycle."""

    def made(cycles=1, rubs=lambda q: 1.0, noise=1.0, seed=2):
        t = np.arange(int(CYCLE * 500)) / 500
        q, qd, qdd = multisine(DOF, t, seed=2, rest=True)
        torque = np.tile(torque_of(robot, q, qd, qdd, rubs), (cycles, 1))
        torque = torque + noise * np.random.default_rng(seed).normal(size=torque.shape)
        starts = tuple(CYCLE * k for k in range(cycles)) if cycles > 1 else ()
        time = np.arange(len(torque)) / 500
        return make_log(robot, time, np.tile(q, (cycles, 1)), torque, cycle_starts=starts)

    return made


def test_friction_follows_an_error_of_the_base_parameters_as_the_covariance_says(model, later):
    """A step along Σ_β v moves friction by G Σ_β v, which is the covariance of both times v."""
    base, log = len(model.independent), later()
    found = refit(model, [log]).model
    cross = found.covariance[base:, :base]
    rng = np.random.default_rng(5)
    for _ in range(3):
        along = rng.normal(size=base) / np.sqrt(np.diag(model.covariance)[:base])
        moved = replace(model, values=model.values + np.append(model.covariance[:base, :base] @ along, 0 * cross[:, 0]))
        answer = refit(moved, [log]).model.values[base:] - found.values[base:]
        assert answer == pytest.approx(cross @ along, rel=0.1, abs=0.05 * np.abs(cross @ along).max())


def test_a_refit_keeps_what_it_does_not_estimate(model, later):
    """Base parameters, their covariance and prior, the bodies of the earlier fit, and how it was made."""
    base, bodies = len(model.independent), np.arange(11.0 * DOF)
    found = refit(replace(model, standard=bodies), [later()]).model
    assert found.values[:base] == pytest.approx(model.values[:base], rel=1e-12)
    assert found.covariance[:base, :base] == pytest.approx(model.covariance[:base, :base])
    assert found.covariance == pytest.approx(found.covariance.T)
    assert np.linalg.eigvalsh(found.covariance / np.outer(*2 * [np.sqrt(np.diag(found.covariance))])).min() > -1e-9
    for name in ("mean", "standard_deviation", "data_share"):
        before, after = getattr(model.prior, name), getattr(found.prior, name)
        assert after.shape == before.shape
        assert after[:base] == pytest.approx(before[:base], rel=1e-12)
    assert np.any(found.prior.data_share[base:] != model.prior.data_share[base:])
    assert refit(replace(model, prior=None), [later()]).model.prior is None
    assert found.standard == pytest.approx(bodies)
    assert (found.method, found.cutoff, found.order) == (model.method, 18.0, 6)
    assert (found.names, found.condition_number) == (model.names, model.condition_number)
    assert found.combinations == model.combinations
    held_out, again = found.notes
    assert held_out.startswith("Held-out errors: 5 folds")
    assert again == "Friction estimated again; base parameters are those of the model before."


def test_the_conditional_covariance_is_what_is_left_at_known_base_parameters(model):
    """The inverse of the block of the inverse, whatever units the parameters have."""
    base, size = len(model.independent), len(model.values)
    rng = np.random.default_rng(6)
    for units in (np.ones(size), 10.0 ** (9 * np.cos(np.arange(size)))):
        root = rng.normal(size=(size, 3 * size)) * units[:, None]
        covariance = root @ root.T
        expected = np.linalg.inv(np.linalg.inv(covariance)[base:, base:])
        found = conditional_covariance(replace(model, covariance=covariance))
        scale = np.outer(units[base:], units[base:])
        assert found / scale == pytest.approx(expected / scale, rel=1e-6, abs=1e-9)


def test_friction_determined_by_base_parameters_has_no_conditional_variance(model):
    """But round-off, which never leaves a variance below zero."""
    base, size = len(model.independent), len(model.values)
    root = np.random.default_rng(7).normal(size=(size, base))
    left = np.diag(conditional_covariance(replace(model, covariance=root @ root.T)))
    whole = np.sum(root**2, axis=1)[base:]
    assert np.all((left > 0.9e-12 * whole) & (left < 1e-9 * whole))


def test_base_parameter_uncertainty_propagates_to_friction(model, later):
    """Σ_φ = S + G Σ_β Gᵀ, so a hundred times Σ_β adds 99 times the second term."""
    base, log = len(model.independent), later()
    doubted = model.covariance.copy()
    doubted[:base, :base] *= 100
    before, after = (
        refit(replace(model, covariance=each), [log]).model.covariance for each in (model.covariance, doubted)
    )
    passed_on = before[base:, :base] @ np.linalg.pinv(before[:base, :base], rcond=1e-14) @ before[:base, base:]
    added = np.diag(after - before)[base:]
    assert np.all(added > 0)
    assert added == pytest.approx(99 * np.diag(passed_on), rel=1e-3)


def test_errors_are_computed_per_joint_from_moving_samples(model, later):
    log = later(2, noise=np.array([1.0, 4.0]))
    found = refit(model, [log])
    passed = np.sqrt(2 * model.cutoff / 500)  # of white noise at 500 Hz
    for error in (found.before, found.held_out):
        assert error[1] == pytest.approx(4 * passed, rel=0.1)
        assert 0.9 * passed < error[0] < 2 * passed


@pytest.mark.parametrize("parameters", ["friction", "all"])
def test_torque_of_an_effect_is_not_fitted_as_friction(model, later, parameters):
    """A torque offset that the model has is taken off the measured torque, and stays in the model."""
    effect = ModelEffect("torque_offset", ("joint_1",), {"offset": 7.0})
    log = later()
    bare = refit(model, [log], parameters).model
    shifted = replace(log, effort=log.effort + [7.0, 0.0])
    found = refit(replace(model, effects=(effect,)), [shifted], parameters).model
    assert found.effects == (effect,)
    assert np.all(np.abs(found.values - bare.values) < 0.01 * bare.standard_deviations)


def test_the_conditional_covariance_matches_the_observed_scatter(model, later):
    """Fresh noise on the same motion, far above what the base parameters are off by."""
    base = len(model.independent)
    found = [refit(model, [later(noise=20.0, seed=seed)]).model for seed in range(10, 30)]
    scatter = np.std([each.values[base:] for each in found], axis=0, ddof=1)
    said = np.median([np.sqrt(np.diag(conditional_covariance(each))) for each in found], axis=0)
    assert np.all((scatter / said > 0.6) & (scatter / said < 1.25))


def test_an_error_that_every_cycle_repeats_is_not_averaged_away(model, later):
    """Friction that depends on the position is no noise: ten cycles say no more of it than two."""
    deviations = [
        np.sqrt(np.diag(conditional_covariance(refit(model, [later(cycles, lambda q: 1 + np.sin(2 * q), 0.01)]).model)))
        for cycles in (2, 10)
    ]
    coulomb = [k for k, term in enumerate(model.terms) if term.form == "coulomb"]
    assert coulomb
    assert np.all(deviations[1][coulomb] > 0.75 * deviations[0][coulomb])


@pytest.mark.parametrize("tool", [None, Tool(np.eye(4), 50.0, np.array([0.1, 0.0, 0.2]))])
def test_refitting_all_parameters_keeps_the_terms_and_renews_the_values(robot, model, later, tool):
    found, fresh = refit(model, [later()], "all", tool), estimate(robot, [later()], PAPER_TERMS, tool)
    for name in ("terms", "method", "combinations", "standard_names", "notes"):
        assert getattr(found.model, name) == getattr(fresh, name)
    for name in ("values", "covariance"):
        assert getattr(found.model, name) == pytest.approx(getattr(fresh, name), rel=1e-9)
    assert found.model.prior.mean == pytest.approx(fresh.prior.mean)
    assert np.all(found.model.base_values != model.base_values)
    assert np.all(found.held_out > 0)
    assert np.all(found.held_out < 1.2 * found.before)


def test_friction_is_the_least_squares_solution_with_a_prior_that_counts_as_rows_do(model, later):
    """In noise of 3000 N·m data and prior say about as much; rows are not independent, so the prior counts for more.

    Friction solves Xᵀ W (y - X θ) = k Λ φ. At given base parameters its variance is that of stationary noise,
    (Xᵀ W X / k + Λ)⁻¹, or that of the jackknife where this is larger.
    """
    base, log = len(model.independent), later(noise=3000.0)
    found = refit(model, [log]).model
    observation = observe(rigid_bodies(model.robot), [log], FilterSettings(model.cutoff, model.order))
    problem = Problem.pose(observation, partition(observation.segments), model.terms, model.base_values)
    times, total = problem.autocorrelation_times(found.values), problem.moments.weighted(found.weights)
    pull = total[:-1, -1] - total[:-1, :-1] @ found.values
    precision = problem.prior.precision[base:, base:]
    assert times == pytest.approx(times[0], rel=0.3)
    counted = pull[base:] / (precision @ found.values[base:])
    assert counted == pytest.approx(np.median(times), rel=0.02)
    follows = -np.linalg.solve(total[base:-1, base:-1] + np.median(times) * precision, total[base:-1, :base])
    passed_on = follows @ model.covariance[:base, :base]
    np.testing.assert_allclose(found.covariance[base:, :base], passed_on, atol=0.02 * np.abs(passed_on).max())
    stationary = np.linalg.inv(problem.moments.weighted(found.weights / times)[base:-1, base:-1] + precision)
    left = np.diag(conditional_covariance(found)) / np.diag(stationary)
    assert np.all(left > 1 - 1e-6)
    assert left.min() == pytest.approx(1.0, rel=1e-6), "some are as certain as the noise alone makes them"


def test_load_dependent_friction_follows_the_base_parameters_of_the_model(robot, model, later, multisine):
    """Not those of the description, which are far off here."""
    log, (q, qd, qdd) = later(), multisine(DOF, np.arange(int(CYCLE * 500)) / 500, seed=2, rest=True)
    load = rigid_bodies(robot).torque(q, qd, qdd, model.base_values)
    log = replace(log, effort=log.effort + 0.2 * np.abs(load) * np.sign(qd) * [0, 1])
    terms, size = (*model.terms, FrictionTerm(1, "load", Reversal())), len(model.values)
    wider = np.pad(model.covariance, (0, 1)), np.append(model.values, 0.0)
    found = refit(replace(model, terms=terms, covariance=wider[0], values=wider[1], prior=None), [log]).model
    assert found.values[size] == pytest.approx(0.2, rel=0.03)
