"""Tests for a change in a series of runs are those of least squares with a known covariate."""

import numpy as np
import pytest
from scipy import stats

from agent.runs.changes import Background, find_change, fit_course, line, sizes_of_change

RUNS = 24
TIMES = np.sort(np.random.default_rng(0).uniform(0, 90, RUNS))
NOTHING = Background(np.zeros(RUNS))
#: Residuals whose neighbours differ in sign, so that nothing is widened.
NOISE = 0.1 * (-1.0) ** np.arange(RUNS) * np.random.default_rng(1).uniform(0.5, 1.5, RUNS)


def least_squares(y, *columns):
    """Coefficients, their deviations and p-values of no effect, of a mean and columns."""
    x = np.column_stack([np.ones(len(y)), *columns])
    found = np.linalg.lstsq(x, y, rcond=None)[0]
    freedom = len(y) - x.shape[1]
    deviation = np.sqrt(np.sum((y - x @ found) ** 2) / freedom * np.diag(np.linalg.inv(x.T @ x)))
    return found[1:], deviation[1:], 2 * stats.t.sf(np.abs(found / deviation), freedom)[1:]


@pytest.mark.parametrize("covariate", [None, np.sin(TIMES)])
def test_a_change_is_that_of_least_squares(covariate):
    y = 5 + 0.3 * line(TIMES) + NOISE + (0 if covariate is None else 2 * covariate)
    shapes = np.vstack([line(TIMES), line(np.arange(RUNS)), (np.arange(RUNS) >= 7) - 0.5])
    background = NOTHING if covariate is None else Background(covariate)
    found = zip(*sizes_of_change(y, background, shapes), strict=True)
    for (size, deviation, probability), shape in zip(found, shapes, strict=True):
        expected = least_squares(y, shape, *([] if covariate is None else [covariate]))
        assert size == pytest.approx(expected[0][0])
        assert deviation == pytest.approx(expected[1][0], rel=0.05)
        assert probability == pytest.approx(expected[2][0], rel=0.3)
        parameters, design = fit_course(y, background, shape)
        assert design @ parameters == pytest.approx(y - (y - design @ np.linalg.lstsq(design, y, rcond=None)[0]))


def test_what_is_known_of_the_covariates_coefficient_is_taken_off_before():
    """Surely known, it counts as given; from its own noise alone nothing is learned of it."""
    covariate = line(TIMES) + 0.01 * np.sin(TIMES)
    y = 0.5 * line(TIMES) + 0.7 * covariate + NOISE
    for background in (Background(covariate, 0.7, 1e-6), Background(covariate, 0.7, 0.2, noise=1.0)):
        (size,), (deviation,), _ = sizes_of_change(y, background, line(TIMES)[None])
        expected = least_squares(y - 0.7 * covariate, line(TIMES))
        assert size == pytest.approx(expected[0][0], rel=1e-3)
        along = np.polyfit(line(TIMES), covariate, 1)[0]
        assert deviation == pytest.approx(np.hypot(expected[1][0], along * background.std), rel=0.05)
    (size,), (deviation,), (probability,) = sizes_of_change(y, Background(covariate, noise=1.0), line(TIMES)[None])
    assert (size, deviation, probability) == (0.0, np.inf, 1.0)
    parameters, _ = fit_course(y, Background(covariate, 0.7, 1e-6), None)
    assert parameters[1] == pytest.approx(0.7, abs=1e-4)


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.8, 1.0])
def test_autocorrelated_noise_widens_the_test(memory):
    """By (1 + ρ) / (1 − ρ) of the variance, with ρ of the residuals between 0 and 0.9."""
    rng, shape = np.random.default_rng(2), line(np.arange(60.0))
    noise = np.array([float(rng.normal())])
    while len(noise) < 60:
        noise = np.append(noise, memory * noise[-1] + rng.normal() * (0.1 if memory == 1.0 else 1.0))
    (size,), (deviation,), (probability,) = sizes_of_change(noise, Background(np.zeros(60)), shape[None])
    (slope,), (plain,), _ = least_squares(noise, shape)
    left = noise - noise.mean() - slope * shape
    rho = np.clip(left[1:] @ left[:-1] / (left @ left), 0, 0.9)
    assert (size, deviation) == (pytest.approx(slope), pytest.approx(plain * np.sqrt((1 + rho) / (1 - rho))))
    assert probability == pytest.approx(2 * stats.t.sf(abs(size / deviation), 58))


@pytest.mark.parametrize("place", [3, 11, RUNS - 3])
def test_a_step_is_dated_and_pays_for_all_alternatives(place):
    step = (np.arange(RUNS) >= place) - 0.5
    found = find_change(2 + 0.8 * step + NOISE, TIMES, NOTHING)
    assert (found.kind, found.place) == ("step", place)
    size, deviation, probability = (part[0] for part in least_squares(2 + 0.8 * step + NOISE, step))
    assert (found.size, found.deviation) == (pytest.approx(size), pytest.approx(deviation, rel=0.05))
    places = RUNS - 5  # three runs on either side
    assert np.log10(found.probability) == pytest.approx(np.log10(2 * places * probability), abs=0.3)
    alone = sizes_of_change(2 + 0.8 * step + NOISE, NOTHING, step[None])[2][0]
    assert found.probability == pytest.approx(2 * places * alone)
    assert np.array_equal(found.shape, step)


@pytest.mark.parametrize("along", [TIMES, np.arange(RUNS)])
def test_a_drift_goes_along_time_or_use(along):
    found = find_change(1 + 0.9 * line(along) + 0.1 * NOISE, TIMES, NOTHING)
    size, _, probability = (part[0] for part in least_squares(1 + 0.9 * line(along) + 0.1 * NOISE, line(along)))
    assert (found.kind, found.place, found.size) == ("drift", 1, pytest.approx(size))
    assert np.array_equal(found.shape, line(along))
    assert np.log10(found.probability) == pytest.approx(np.log10(4 * probability), abs=0.5)
    alone = sizes_of_change(1 + 0.9 * line(along) + 0.1 * NOISE, NOTHING, line(along)[None])[2][0]
    assert found.probability == pytest.approx(4 * alone)
    assert found.drift == pytest.approx(least_squares(1 + 0.9 * line(along) + 0.1 * NOISE, line(TIMES))[0][0])
    assert (found.drift_deviation == found.deviation) is (along is TIMES)


def test_nothing_is_found_where_nothing_changes():
    assert find_change(np.full(RUNS, 3.0), TIMES, NOTHING).probability == 1.0
    assert (line(TIMES).sum(), np.ptp(line(TIMES))) == (pytest.approx(0), pytest.approx(1))
    assert np.ptp(line(0.01 * TIMES / 90)) == pytest.approx(1)
    assert not line(np.full(5, 2.0)).any()


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_prior_and_data_share_the_coefficient_of_the_covariate_by_their_precision(noise):
    covariate, shape = np.sin(TIMES), line(TIMES)
    y, background = 3 + 0.4 * shape + 1.5 * covariate + NOISE, Background(covariate, 0.7, 0.05, noise)
    (size,), (deviation,), _ = sizes_of_change(y, background, shape[None])
    common, rest = (part - part.mean() - shape * (shape @ part) / (shape @ shape) for part in (covariate, y))
    seen = common @ common - RUNS * noise
    slope = common @ rest / seen
    variance = np.sum((rest - slope * common) ** 2) / (RUNS - 3)
    precision, before = seen / variance, 0.05**-2
    coefficient = (precision * slope + before * 0.7) / (precision + before)
    along = shape @ covariate / (shape @ shape)
    assert size == pytest.approx(shape @ y / (shape @ shape) - coefficient * along)
    left = y - y.mean() - coefficient * (covariate - covariate.mean()) - size * shape
    rho = np.clip(left[1:] @ left[:-1] / (left @ left), 0, 0.9)
    own = left @ left / (RUNS - 3) * (1 + rho) / (1 - rho) / (shape @ shape)
    assert deviation == pytest.approx(np.sqrt(own + along**2 / (precision + before)))
    found, design = fit_course(y, background, shape)
    free = np.linalg.lstsq(design, y, rcond=None)[0]
    weight = np.diag([0, np.sum((y - design @ free) ** 2) / (RUNS - 3) / 0.05**2, 0])
    right = design.T @ y + weight @ [0, 0.7, 0]
    assert found == pytest.approx(np.linalg.solve(design.T @ design + weight, right))
