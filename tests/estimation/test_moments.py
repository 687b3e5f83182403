"""Sums over rows do what the rows would: weights, energies, folds, estimates, evidence and ranks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

import agent.estimation.normal_equations as sums
from agent.estimation.partition import partition
from agent.estimation.prior import Prior
from agent.estimation.problem import Problem
from agent.estimation.selection import paper_terms
from agent.estimation.signals.filtering import FilterSettings
from agent.estimation.signals.observation import observe
from agent.model import Reversal, standstill_speed
from agent.robot.bodies import rigid_bodies
from tests.estimation.conftest import _arm, _links, _log, _multisine

WEIGHTS = np.array([[1.0, 3.0], [0.2, 0.5]])


@pytest.fixture(scope="module")
def problem():
    """Two coupled joints, the second of which stands now and then."""
    robot = _arm(2, coupling=np.array([[1.0, 0.0], [0.5, 1.0]]))
    t = np.arange(3000) / 500
    q, qd, qdd = _multisine(2, 0.5 * t + 0.3 * np.sin(t))
    noise = np.random.default_rng(0).normal(size=q.shape) * [1.0, 4.0]
    log = _log(robot, t, np.where(t[:, None] > 4, q[2000], q), _links(robot, q, qd, qdd) + 3 * np.sign(qd) + noise)
    observation = observe(rigid_bodies(robot), [log], FilterSettings(20.0))
    return Problem.pose(observation, partition(observation.segments), paper_terms([Reversal()] * 2))


@pytest.fixture(scope="module")
def rows(problem):
    """Of each joint: rows (S, p + 1) of columns and torque, whether it stands, and their cells."""
    (segment,), (friction,), (still,) = (
        problem.observation.segments,
        problem.friction(),
        sums.standstill(problem.observation),
    )
    found = []
    for joint, (index, block) in enumerate(problem.observation.joint_rows(segment, problem.terms, friction)):
        full = np.zeros((len(block), problem.moments.parameters + 1))
        full[:, [*index, -1]] = block
        found.append((full, still[:, joint], problem.partition.labels[0]))
    return found


def summed(rows, cells=None, trusted=None):
    total = 0.0
    for joint, (block, still, label) in enumerate(rows):
        weight = np.where(still, WEIGHTS[1, joint], WEIGHTS[0, joint]) * (1.0 if trusted is None else trusted[:, joint])
        weight = weight * (True if cells is None else cells[label])
        total = total + block.T @ (weight[:, None] * block)
    return total


def test_sums_are_those_of_the_rows(problem, rows):
    moments, cells = problem.moments, problem.partition.fold != 1
    speed, robot = problem.observation.segments[0].speed, problem.observation.robot
    slowest = standstill_speed([speed], robot.max_velocity, 0.005)
    assert np.array_equal(np.stack([still for _, still, _ in rows], axis=1), np.abs(speed) <= slowest)
    assert 0.2 < np.mean(rows[1][1]) < 0.5, "it stands now and then"
    scale = np.sqrt(np.outer(*2 * [np.diag(summed(rows))]))
    for chosen in (None, cells, *(problem.partition.cluster == k for k in range(problem.partition.clusters))):
        found = moments.weighted(WEIGHTS) if chosen is None else moments.weighted(WEIGHTS, chosen)
        np.testing.assert_allclose(found / scale, summed(rows, chosen) / scale, atol=1e-12)
    counted = [[np.sum(still == group) for _, still, _ in rows] for group in (False, True)]
    assert np.array_equal(moments.rows.sum(axis=0), counted)
    values = np.random.default_rng(1).normal(size=moments.parameters)
    for chosen in (np.ones_like(cells), cells):
        left = [[block[(still == g) & chosen[at]] @ [*values, -1] for block, still, at in rows] for g in (False, True)]
        energy = [[part @ part for part in group] for group in left]
        np.testing.assert_allclose(moments.energy(values, chosen), energy, rtol=1e-9)
    torque = [[np.sum(block[still == g, -1] ** 2) for block, still, _ in rows] for g in (False, True)]
    np.testing.assert_allclose(moments.torque_energy(), torque)
    best = moments.energy(solve(rows))
    assert np.all(best >= 1e-15 * moments.torque_energy())
    assert np.all(best[0] < 0.5 * moments.torque_energy()[0])


def solve(rows):
    total = summed(rows)
    return np.linalg.lstsq(total[:-1, :-1], total[:-1, -1], rcond=None)[0]


def test_some_parameters_have_the_sums_of_their_columns_in_the_order_given(problem):
    chosen = np.array([5, 0, problem.moments.parameters - 1, 2])
    places = np.append(chosen, problem.moments.parameters)
    for known in (False, True):
        fresh = replace(problem.moments, _totals={} if not known else dict(problem.moments._totals))
        found = fresh.select(chosen)
        np.testing.assert_allclose(found.weighted(WEIGHTS), fresh.weighted(WEIGHTS)[np.ix_(places, places)])
        assert (found.parameters, found.rows) == (4, pytest.approx(fresh.rows))


def test_rows_may_be_trusted_in_part(problem, rows):
    trusted = np.random.default_rng(2).uniform(size=(len(rows[0][0]), 2))
    found = sums.collect_moments(problem.observation, problem.partition, problem.terms, problem.friction(), [trusted])
    np.testing.assert_allclose(found.weighted(WEIGHTS), summed(rows, trusted=trusted), rtol=1e-9, atol=1e-6)


def test_weights_are_inverse_variances_and_no_less_certain_in_motion(problem):
    moments, values = problem.moments, np.zeros(problem.moments.parameters)
    variance = moments.energy(values) / moments.rows.sum(axis=0)
    expected = np.where(moments.rows.sum(axis=0) > 0, variance, variance[::-1])
    expected[1] = np.maximum(expected[1], expected[0])
    np.testing.assert_allclose(1 / sums.reweight(moments, values), expected)
    for group in (0, 1):
        only = replace(moments, rows=moments.rows * (np.arange(2) == group)[:, None])
        np.testing.assert_allclose(1 / sums.reweight(only, values), variance[[group, group]])
    silent = replace(moments, sums=(0 * moments.sums[0], moments.sums[1]), _totals={})
    weights = sums.reweight(silent, values)
    assert np.all(weights[:, 0] < 1e-9 * weights[:, 1]), "rows of a joint on its brake say nothing"
    settled = replace(problem, prior_weight=2.0).weights()
    again = sums.reweight(moments, sums.solve_sum(moments.weighted(settled), problem.prior, 2.0))
    np.testing.assert_allclose(again, settled, rtol=0.02)
    perfect = replace(moments, sums=tuple(0 * part for part in moments.sums), _totals={})
    assert np.all(np.isfinite(sums.reweight(perfect, values)))


@pytest.mark.parametrize("units", [np.ones(3), np.array([1e-4, 1.0, 1e4])])
def test_estimate_and_evidence_are_those_of_normal_distributions(units):
    rng = np.random.default_rng(3)
    x, k = rng.normal(size=(30, 3)) / units, 2.5
    roots = rng.normal(size=(2, 3, 5)) * units[:, None]
    priors = [Prior(rng.normal(size=3) * units, np.linalg.inv(root @ root.T)) for root in roots]
    y = x @ (rng.normal(size=3) * units) + rng.normal(size=30)
    total = np.column_stack([x, y]).T @ np.column_stack([x, y])
    found = sums.solve_sum(total, priors[0], k)
    pull = x.T @ (y - x @ found) - k * priors[0].precision @ (found - priors[0].mean)
    np.testing.assert_allclose(pull * units, 0, atol=1e-8)
    said = [sums.log_evidence(total, prior, k) for prior in priors]
    spreads = [k * np.eye(30) + x @ np.linalg.inv(prior.precision) @ x.T for prior in priors]
    true = [multivariate_normal.logpdf(y, x @ p.mean, spread) for p, spread in zip(priors, spreads, strict=True)]
    assert said[0] - said[1] == pytest.approx(true[0] - true[1], rel=1e-6)
    normal = x.T @ x
    scale = np.outer(units, units)
    np.testing.assert_allclose(sums.inverse(normal) / scale, np.linalg.inv(normal * scale), rtol=1e-8)
    np.testing.assert_allclose(sums.pseudo_inverse(normal) / scale, np.linalg.inv(normal * scale), rtol=1e-8)
    twice = np.column_stack([x, x[:, 0] * 1e3, 0 * x[:, 0]])
    assert (sums.scaled_rank(normal), sums.scaled_rank(twice.T @ twice)) == (3, 3)
    again = sums.pseudo_inverse(twice.T @ twice)
    together = twice @ again @ twice.T
    np.testing.assert_allclose(together @ together, together, atol=1e-8)
    assert np.trace(together) == pytest.approx(3)


def test_a_direction_is_determined_from_a_trillionth_of_the_largest_on():
    """Also of the unknowns, whatever their units."""
    apart = 1 - np.eye(2)
    for normal, rank in ((np.ones((3, 3)), 1), (1 - 1e-12 * apart, 1), (1 - 4e-12 * apart, 2)):
        assert sums.scaled_rank(normal) == rank
    assert [sums.scaled_rank(np.diag(one)) for one in ([1e20, 1e-5], [1.0, 1e-20])] == [1, 2]


def test_energy_is_not_below_round_off():
    block = np.array([[1.0, 2.0, 1.0], [2.0, 1.0, 5.0], [0.0, 1.0, -1.0]])
    exact = sums.Moments(2, (np.arange(2),), (np.array([[block.T @ block] * 2]),), np.ones((1, 2, 1)))
    assert exact.energy(np.array([3.0, -1.0])) == pytest.approx(np.full((2, 1), 27e-15), rel=1e-6, abs=0)


def test_a_gain_is_clear_beyond_its_scatter_between_folds():
    gains = np.array([[1.0, 100.0], [2.0, -300.0], [3.0, 100.0]])
    assert sums.clear_gain(gains).tolist() == [True, False]
    spread = np.std([1.0, 2.0, 3.0], ddof=1) * np.sqrt(3)
    for shift, expected in ((-0.01, False), (0.01, True)):
        assert sums.clear_gain(np.array([-1.0, 0.0, 1.0]) + spread / 3 + shift) == expected


def test_errors_are_clearly_better_by_a_share_and_by_two_standard_errors():
    before = np.ones(4)
    for after, least, expected in (
        ([0.9] * 4, 0.05, True),
        ([0.9] * 4, 0.15, False),
        ([0.5, 0.9, 0.95, 0.93], 0.05, False),
        ([0.5, 0.6, 0.55, 0.58], 0.05, True),
        ([0.5, 0.0, 0.0, 0.0], 0.05, False),
        ([0.5, 0.5, 0.0, 0.0], 0.05, True),
        ([1.2, 1.2, 1.2, 1.2], 0.05, False),
    ):
        assert sums.clearly_better(before, np.array(after), least) is expected
    scatter = 0.1 * np.sqrt(0.75) * np.array([-1, -1, 1, 1])  # of logarithms: 0.1, so 0.05 of their mean
    for mean, expected in ((0.11, True), (0.09, False)):
        assert sums.clearly_better(before, np.exp(-mean - scatter), 0.05) is expected
    assert sums.clearly_better(np.array([0.0, 1.0, 1.0]), np.full(3, 0.5), 0.05)
    assert not sums.clearly_better(np.array([0.0, 0.0, 1.0]), np.full(3, 0.5), 0.0)


def test_a_joint_that_is_fitted_closely_does_not_pay_for_what_others_lose():
    before, weights = np.ones((4, 2, 2)), np.array([[100.0, 1.0], [100.0, 1.0]])
    for other, expected in ((1.4, True), (1.6, False)):
        after = before * [0.5, other]  # of a joint with much weight, and one with little
        assert sums.clearly_better(*(np.sum(weights * e, axis=(1, 2)) for e in (before, after)), 0.1)
        assert sums.predicts_better(before, after, weights, 0.1) is expected
    assert not sums.predicts_better(before, 0.99 * before, weights, 0.1)


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.98])
def test_autocorrelation_time(memory):
    """Of the noise, whatever it is about, also in parts; rows that never change count as one each."""
    rows = lfilter([np.sqrt(1 - memory**2)], [1, -memory], np.random.default_rng(0).normal(size=(100_000, 1)), axis=0)
    rows = 1e-4 * np.column_stack([0 * rows, 3 * rows + 7])
    quiet = 1e-9 * np.random.default_rng(1).normal(size=(100_000, 2)) * [0, 1]
    for parts in ([rows], [rows[:60_000], rows[60_000:]], [rows, quiet]):
        expected = [1.0, (1 + memory) / (1 - memory)]
        assert sums.autocorrelation_time(parts) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("size", [30, 31])
def test_autocorrelations_are_summed_in_pairs_until_one_is_negative(size):
    part = np.convolve(np.random.default_rng(5).normal(size=size + 4), np.ones(5), "valid")
    away = part - part.mean()
    rho = np.array([away[k:] @ away[: size - k] for k in range(size)]) / (away @ away)
    time, lag = 1.0, 1
    while lag + 1 < size and rho[lag] + rho[lag + 1] > 0:
        time, lag = time + 2 * (rho[lag] + rho[lag + 1]), lag + 2
    assert sums.autocorrelation_time([part[:, None]])[0] == pytest.approx(time, rel=1e-9)
