"""Standard deviations and intervals mean what they say."""

from dataclasses import replace

import numpy as np
import pytest

from agent.estimation import EstimationSettings, FilterSettings, estimate
from agent.estimation.estimators import weighted
from agent.estimation.partition import partition
from agent.estimation.prior import link_prior
from agent.estimation.problem import Problem
from agent.estimation.selection import paper_terms
from agent.estimation.signals.observation import observe
from agent.estimation.uncertainty import covariance, jackknife, parameter_prior, unobserved_directions
from agent.model.friction_terms import AxleMotion, Reversal, axle_columns
from agent.robot.bodies import rigid_bodies
from agent.validation import predict_log


def _correlated(rng, shape, memory):
    """Noise of variance 1 whose value at one sample keeps `memory` of the one before."""
    from scipy.signal import lfilter

    return lfilter([np.sqrt(1 - memory**2)], [1, -memory], rng.normal(size=shape), axis=0)


def _covered(arm, multisine, make_log, runs: range, dof: int, seconds: float, memory: float, friction: str):
    """(runs, b) bool: whether 95 % intervals of the base parameters, and (runs,) shares of 95 % prediction bounds."""
    robot = arm(dof)
    t = np.arange(int(seconds * 500)) / 500
    q, qd, qdd = multisine(dof, t)
    rigid = rigid_bodies(robot)
    mean, deviation = link_prior(observe(rigid, [make_log(robot, t, q, 20 * qd)], FilterSettings()))
    terms = paper_terms([Reversal()] * dof)
    brake = axle_columns(terms, AxleMotion.of(robot, q, qd)) * np.tile([3.0, 2.0, 0.5], dof)
    brake = brake @ robot.coupling[[term.axle for term in terms]]
    hits, shares = [], []
    for run in runs:
        rng = np.random.default_rng(run)
        standard = rng.normal(mean, deviation)
        standard[10 * dof :] = 1e-4 * rng.uniform(0.5, 1.5, dof)
        truth = rigid.projection @ standard
        torque = rigid.torque(q, qd, qdd, truth) + brake
        fit = make_log(robot, t, q, torque + 0.3 * _correlated(rng, torque.shape, memory))
        model = estimate(robot, [fit], EstimationSettings.create(method="weighted", friction=friction))
        base = slice(0, rigid.count)
        hits.append(np.abs(model.base_values - truth) < 1.96 * model.standard_deviations[base])
        again = make_log(robot, t, q, torque + 0.3 * _correlated(rng, torque.shape, memory))
        seen = predict_log(model, again)
        shares.append(np.mean(np.abs(seen.error) < seen.half_width))
    return np.array(hits), np.array(shares)


def test_intervals_cover_in_correlated_noise(arm, multisine, make_log):
    hits, shares = _covered(arm, multisine, make_log, range(15), 3, 10, 0.96, "paper")
    assert 0.90 <= hits.mean() <= 0.99
    assert 0.90 <= shares.mean() <= 0.99


@pytest.mark.verify
@pytest.mark.parametrize(("memory", "friction"), [(0.0, "paper"), (0.96, "paper"), (0.99, "paper"), (0.96, "selected")])
def test_intervals_cover_over_two_hundred_runs(arm, multisine, make_log, measured, memory, friction):
    hits, shares = _covered(arm, multisine, make_log, range(200), 3, 20, memory, friction)
    for what, share in (("parameters", hits.mean()), ("predictions", shares.mean())):
        name = f"95 % intervals of {what} cover, 200 runs, noise memory {memory:g} a sample, {friction} friction"
        measured(name, 100 * share, "%", "90 to 98 %", 0.90 <= share <= 0.98)
    assert 0.90 <= hits.mean() <= 0.98
    assert 0.90 <= shares.mean() <= 0.98


def test_intervals_cover_with_more_trust_in_the_prior(arm, multisine, make_log):
    """Truths are drawn from the prior, so an estimate that trusts it too much is off by what the prior is."""
    robot = arm(2)
    t = np.arange(4000) / 500
    q, qd, qdd = multisine(2, t)
    rigid = rigid_bodies(robot)
    mean, deviation = link_prior(observe(rigid, [make_log(robot, t, q, 20 * qd)], FilterSettings()))
    hits = []
    for run in range(12):
        rng = np.random.default_rng(run)
        truth = rigid.projection @ rng.normal(mean, deviation)
        torque = rigid.torque(q, qd, qdd, truth) + rng.normal(size=q.shape)
        observation = observe(rigid, [make_log(robot, t, q, torque)], FilterSettings())
        problem = Problem.pose(observation, partition(observation.segments), paper_terms([Reversal()] * 2))
        found = weighted(replace(problem, prior_weight=1000 * problem.with_own_prior_weight().prior_weight))
        deviations = np.sqrt(np.diag(covariance(problem, found)))
        error = np.abs(found.parameters - np.append(truth, np.zeros(6)))[: len(truth)]
        hits.append(error < 1.96 * deviations[: len(truth)])
    assert 0.90 <= np.mean(hits) <= 1


def _white(arm, multisine, make_log, cycles=1, rubs=0.0, noise=1.0):
    """Problem and weighted estimate of a motion of 8 s in `cycles` equal cycles, friction by `rubs` off its form."""
    robot, cycle = arm(2), 8.0
    t = np.arange(int(cycle * 500)) / 500
    q, qd, qdd = multisine(2, t, rest=True)
    rigid = rigid_bodies(robot)
    standard = np.random.default_rng(3).normal(1.0, 0.2, rigid.projection.shape[1])
    torque = rigid.torque(q, qd, qdd, rigid.projection @ standard) + 4 * np.tanh(qd / 0.01) * (1 + rubs * np.sin(2 * q))
    torque = np.tile(torque, (cycles, 1))
    torque = torque + noise * np.random.default_rng(cycles).normal(size=torque.shape)
    starts = tuple(cycle * k for k in range(cycles)) if cycles > 1 else ()
    log = make_log(robot, np.arange(len(torque)) / 500, np.tile(q, (cycles, 1)), torque, cycle_starts=starts)
    observation = observe(rigid, [log], FilterSettings(20.0))
    problem = Problem.pose(observation, partition(observation.segments), paper_terms([Reversal()] * 2))
    return problem, weighted(problem)


def test_noise_is_taken_between_that_of_the_fit_and_that_held_out(arm, multisine, make_log):
    """Sixteen times the squared error held out: four times the variance of what the data decide."""
    problem, found = _white(arm, multisine, make_log)
    within = np.sum(found.weights * problem.moments.energy(found.parameters), axis=0)
    large, larger = (replace(found, held_out=found.held_out * k * within.max()) for k in (1.0, 16.0))
    before, after = (np.diag(covariance(problem, one)) for one in (large, larger))
    seen = before > 10 * np.diag(covariance(problem, replace(found, held_out=0 * found.held_out)))
    assert seen.sum() > 5, "those that the prior does not decide"
    assert after[seen] / before[seen] == pytest.approx(4.0, rel=0.1)


def test_a_small_held_out_error_does_not_narrow_intervals(arm, multisine, make_log):
    problem, found = _white(arm, multisine, make_log)
    nothing, tenth = (covariance(problem, replace(found, held_out=k * found.held_out)) for k in (0.0, 0.1))
    assert np.diag(nothing) == pytest.approx(np.diag(tenth))


def test_an_error_that_every_cycle_repeats_is_not_averaged_away(arm, multisine, make_log):
    """Ten cycles of a model error say no more than two; ten of noise say five times as much."""
    for rubs, noise, least, most in ((1.0, 0.01, 0.75, 1.3), (0.0, 30.0, 0.3, 0.65)):
        deviations = [
            np.sqrt(np.diag(covariance(*_white(arm, multisine, make_log, cycles, rubs, noise)))) for cycles in (2, 10)
        ]
        problem, _ = _white(arm, multisine, make_log)
        at = [len(problem.load) + k for k, term in enumerate(problem.terms) if term.form == "coulomb"]
        ratio = deviations[1][at] / deviations[0][at]
        assert np.all((least < ratio) & (ratio < most)), ratio


@pytest.fixture(scope="module")
def white(arm, multisine, make_log):
    """One cycle with white noise: the problem, its estimate, and the estimate with a large held-out error.

    That error is 9 times the error of the fit on every joint, so the jackknife widens nothing.
    """
    problem, found = _white(arm, multisine, make_log)
    return problem, found, replace(found, held_out=9 * problem.moments.energy(found.parameters)[None])


def test_the_covariance_is_that_of_least_squares_with_a_prior(white):
    """Whatever the prior counts: A cov A - k² Λ is what the noise alone does, and A is Xᵀ W X + k Λ."""
    problem, _, found = white
    information, precision = found.moments.weighted(found.weights)[:-1, :-1], problem.prior.precision
    noises = []
    for weight in (0.5, 2.0, 20.0):
        bread = information + weight * precision
        cov = covariance(problem, replace(found, prior_weight=weight))
        noises.append(bread @ cov @ bread - weight**2 * precision)
    scale = np.sqrt(np.outer(np.diag(noises[0]), np.diag(noises[0])))
    for other in noises[1:]:
        assert other / scale == pytest.approx(noises[0] / scale, abs=0.02)


def test_noise_of_one_joint_held_out_widens_its_own_friction_alone(white):
    """Nine times the squared error is three times the variance, joint by joint."""
    problem, found, _ = white
    energy = problem.moments.energy(found.parameters)
    coulomb = [len(problem.load) + k for k, term in enumerate(problem.terms) if term.form == "coulomb"]
    same, first = (replace(found, held_out=energy[None] * factor) for factor in (1.0, np.array([9.0, 1.0])))
    narrow = replace(problem, partition=replace(problem.partition, cluster=0 * problem.partition.cluster))
    before, after = (np.diag(covariance(narrow, one))[coulomb] for one in (same, first))
    assert after[0] / before[0] == pytest.approx(3.0, rel=0.1)
    assert after[1] / before[1] == pytest.approx(1.0, rel=0.1)


def test_the_jackknife_leaves_out_one_cluster_after_the_other(white):
    problem, found, _ = white
    cells = problem.partition
    assert cells.clusters > 10
    left = [
        problem.solver(found.moments.weighted(found.weights, cells.cluster != cluster))
        for cluster in range(cells.clusters)
    ]
    expected = np.var(left, axis=0, ddof=1) * (cells.clusters - 1) ** 2 / cells.clusters
    assert jackknife(problem, found) == pytest.approx(expected, rel=1e-6)


def test_deviations_are_widened_to_the_jackknife_beyond_its_own_scatter_alone(white):
    """Twice the relative deviation of a variance from C clusters, √(2 / (C - 1))."""
    problem, found, _ = white
    limit = 1 + 2 * np.sqrt(2 / (problem.partition.clusters - 1))
    energy, repeated = problem.moments.energy(found.parameters), jackknife(problem, found)
    seen = np.concatenate(
        [
            repeated / np.diag(covariance(problem, replace(found, held_out=part**2 * energy[None])))
            for part in np.geomspace(1.0, 3.0, 120)
        ]
    )
    narrower = seen[seen > 1 + 1e-9]
    assert narrower.max() <= limit
    assert narrower.max() > 0.995 * limit


def test_reports_the_prior_and_the_share_of_the_data(white):
    problem, found, _ = white
    deviation = np.sqrt(np.diag(np.linalg.inv(problem.prior.precision)))
    information = problem.moments.weighted(found.weights)[:-1, :-1]
    for weight in (found.prior_weight, 1e6, 1e18):
        said = parameter_prior(problem, replace(found, prior_weight=weight))
        assert said.mean == pytest.approx(problem.prior.mean)
        assert said.standard_deviation == pytest.approx(deviation, rel=1e-6)
        after = np.diag(np.linalg.inv(information / weight + problem.prior.precision))
        assert said.data_share == pytest.approx(1 - after / deviation**2, abs=1e-6)
    assert said.data_share.max() < 1e-3
    assert parameter_prior(problem, replace(found, prior_weight=0.0)) is None


def test_more_data_leave_fewer_directions_to_the_prior(white):
    """Fewer independent rows decide fewer directions; none has more than one unit of information."""
    problem, found, _ = white
    covariance_before = np.linalg.inv(problem.prior.precision)
    counts = []
    for times in np.geomspace(1.0, 1e18, 73):
        silent = unobserved_directions(problem.moments, found.weights, problem.prior, np.full(2, times))
        information = problem.moments.weighted(found.weights / times)[:-1, :-1]
        values = np.linalg.eigvals(information @ covariance_before).real
        assert len(silent) == np.sum(values < 1)
        counts.append(len(silent))
    assert counts == sorted(counts)
    assert counts[0] < counts[-1] == len(problem.prior.mean)


def test_deviations_shrink_with_the_square_root_of_data(arm, multisine, make_log):
    robot = arm(2)
    settings = EstimationSettings.create(method="weighted", friction="paper")
    ratios = []
    for seed in range(5):
        deviations = []
        for seconds in (20, 80):
            t = np.arange(seconds * 500) / 500
            q, qd, _ = multisine(2, t)
            torque = 3 * np.sign(qd) + qd + np.random.default_rng(seed).normal(size=q.shape)
            deviations.append(estimate(robot, [make_log(robot, t, q, torque)], settings).standard_deviations)
        ratios.append(deviations[0] / deviations[1])
    assert np.median(ratios) == pytest.approx(2, rel=0.25)


def test_held_out_error_is_larger_than_the_fit_s_where_data_are_few(arm, multisine, make_log):
    robot = arm(3)
    t = np.arange(1500) / 500
    q, qd, _ = multisine(3, t)
    torque = np.sign(qd) + _correlated(np.random.default_rng(0), q.shape, 0.9)
    model = estimate(robot, [make_log(robot, t, q, torque)], EstimationSettings.create(friction="paper"))
    assert np.all(model.held_out_rmse > model.residual_rmse)
